"""Conjugated phases, and whole bodies, runs and frequencies under a wrong label, told by the ligament."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.kinematics.faults.judges.phase_convention import phase_notice
from legacy.kinematics.faults.proposals.two_bodies import Pair
from legacy.kinematics.points2dof import points2dof
from legacy.stapeskit.frames import rotation_from_vector
from legacy.stapeskit.records.motion import RigidMotion
from legacy.stapeskit.spatial import DOF_NAMES
from tests.kinematics.ligament import base_motion, stapes_motion, study, with_lines

FREQ = np.linspace(400.0, 5000.0, 90)
CASES = [(("y",), 0.0, 1.0), (("y", "x"), 0.3, 1.5), (("y", "x", "z"), 0.1, 0.5), (("y", "x"), 0.0, 0.02)]


def moved(seed, runs=("y",), loss=0.0, scale=1.0, noise=0.01, freq=FREQ):
    """Motion of stapes and base, with noise on every degree of freedom."""
    rng = np.random.default_rng([seed, 17])
    bases = [base_motion(freq, main, rng) for main in runs]
    clean = np.array([[stapes_motion(freq, b, scale=scale, loss=loss), b] for b in bases])
    sd = noise * np.sqrt(np.mean(np.abs(clean) ** 2, axis=2, keepdims=True))
    q = clean + sd * (rng.normal(size=(*clean.shape, 2)) @ [1.0, 1j])
    covariance = np.zeros((*q.shape, 6), dtype=complex)
    covariance[..., range(6), range(6)] = 2.0 * sd**2
    names = tuple(str(1 + k) for k in range(len(runs)))
    chi2 = np.ones(q.shape[:3])
    return RigidMotion(names, ("stapes", "base"), DOF_NAMES, freq, q, covariance, chi2, chi2.astype(int))


def changed(motion, body, change):
    q = motion.q.copy()
    q[:, body] = change(q[:, body])
    return replace(motion, q=q)


def told(motion):
    return [(notice.code, notice.text) for notice in phase_notice(motion)]


@pytest.mark.parametrize(("runs", "loss", "scale"), CASES)
def test_conjugated_data_are_told_for_any_damping_number_of_runs_and_noise(runs, loss, scale):
    for seed, noise in enumerate((0.003, 0.01, 0.05)):
        motion = moved(seed, runs, loss, scale, noise)
        assert told(motion) == []
        ((code, text),) = told(replace(motion, q=motion.q.conj()))
        assert (code, "alone" in text) == ("phase_convention", False)


@pytest.mark.parametrize("body", [0, 1])
def test_one_body_in_rms_and_the_other_in_peak_is_a_slip_of_units(body):
    for seed in range(3):
        motion = moved(seed, ("y", "x"))
        ((code, text),) = told(changed(motion, body, lambda q: q / np.sqrt(2.0)))
        assert code == "unit_slip"
        assert f"{motion.bodies[body]} looks given in rms" in text


def test_a_stiff_ligament_shows_its_lag_as_far_as_it_has_any():
    motion = moved(3, ("y", "x"), 0.3, 8.0, 0.003)
    assert told(motion) == []
    assert [code for code, _ in told(replace(motion, q=motion.q.conj()))] == ["phase_convention"]


def test_right_data_raise_nothing_whatever_the_damping_and_the_resonance():
    rng = np.random.default_rng(5)
    for seed in range(60):
        runs = (("y",), ("y", "x"), ("y", "x", "z"))[seed % 3]
        freq = np.linspace(400.0, 5000.0, int(rng.integers(40, 150)))
        noise, scale = np.exp(rng.uniform(np.log([0.003, 0.01]), np.log([0.05, 30.0])))
        motion = moved(seed, runs, float(rng.choice([0.0, 0.1, 0.3])), scale, noise, freq)
        assert told(motion) == []


def conjugated_velocity(q):
    """Return displacements whose velocities i w q are the conjugates of the right ones."""
    return -q.conj()


@pytest.mark.parametrize("change", [np.conj, conjugated_velocity])
@pytest.mark.parametrize(("body", "name"), [(0, "stapes"), (1, "base")])
def test_one_conjugated_body_is_named(body, name, change):
    for seed in range(3):
        ((code, text),) = told(changed(moved(seed), body, change))
        assert code == "phase_convention"
        assert f"the data of {name} alone look like amplitudes of e^{{-iwt}}" in text


@pytest.mark.parametrize(("runs", "loss", "scale"), CASES)
def test_exchanged_names_of_both_bodies_are_told_from_conjugated_phases(runs, loss, scale):
    motion = moved(7, runs, loss, scale)
    ((code, text),) = told(replace(motion, q=motion.q[:, ::-1]))
    assert code == "label_swap"
    assert "exchanged" in text


def test_runs_of_one_body_under_each_other_are_named():
    motion = moved(8, ("y", "x", "z"))
    ((code, text),) = told(changed(motion, 1, lambda q: q[[0, 2, 1]]))
    assert code == "label_swap"
    assert "runs of base look exchanged (3 as 2, 2 as 3), or those of stapes" in text


def test_a_sign_is_told_beside_the_phase():
    for scale in (1.0, 0.03):
        assert [code for code, _ in told(changed(moved(9, scale=scale), 0, np.negative))] == ["body_sign"]


@pytest.mark.parametrize("derivatives", [0, 1, 2])
def test_a_shifted_column_of_frequencies_is_told(derivatives):
    """The rows that are read at one frequency stand at the third line above."""
    freq = np.linspace(400.0, 5000.0, 60)
    motion = moved(10, ("y", "x", "z"), noise=0.003, freq=freq)
    rate = freq[:, None] ** derivatives
    wrong = changed(motion, 1, lambda q: np.roll(q * rate, 3, axis=1) / rate)
    (notice,) = phase_notice(wrong, derivatives=derivatives)
    assert notice.code == "label_swap"
    assert "the frequencies of base look shifted against those of stapes by about 234 Hz" in notice.text


def test_frequencies_with_a_constant_offset_are_named():
    data = study(11, lines=40)
    step = 7.0
    freq = np.sort(np.concatenate([data.freq_hz, data.freq_hz + step]))
    bodies = []
    for number, body in enumerate(data.bodies):
        place = np.searchsorted(freq, data.freq_hz + number * step)
        value = np.full((1, len(body.points), len(freq)), np.nan, dtype=complex)
        value[:, :, place] = body.displacement
        sd = np.full(value.shape, body.sd.mean())
        bodies.append(replace(body, displacement=value, sd=sd))
    notices = points2dof(replace(data, freq_hz=freq, bodies=tuple(bodies))).notices
    text = next(notice.text for notice in notices if notice.code == "frequencies_differ")
    assert text.endswith("The frequencies of base are those of stapes plus 7 Hz throughout: check freq_hz.")


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("channels", [[4], [3, 4, 5]])
def test_two_lines_of_a_channel_that_were_exchanged_are_named(channels, order):
    data = replace(study(13), order=order)
    freq, lines = data.freq_hz, np.arange(len(data.freq_hz))
    lines[[30, 80]] = [80, 30]
    result = points2dof(with_lines(data, 0, channels, lines))
    wrong = [c for c, verdict in enumerate(result.channels) if verdict.verdict != "ok"]
    assert wrong == channels
    expected = f"rows of point 2 of body stapes at {freq[30]:.6g} and {freq[80]:.6g} Hz exchanged"
    assert {(result.channels[c].verdict, result.channels[c].estimate) for c in wrong} == {
        ("label_swap", expected)
    }


def test_a_body_alone_says_what_its_phase_can_show():
    motion = moved(14)
    alone = replace(
        motion, bodies=("stapes",), q=motion.q[:, :1], covariance=motion.covariance[:, :1],
        chi2=motion.chi2[:, :1], n_dof=motion.n_dof[:, :1],
    )  # fmt: skip
    assert told(alone) == []
    ((code, text),) = told(replace(alone, q=alone.q.conj()))
    assert code == "phase_convention"
    assert "or the reference signal comes late" in text


def test_a_turned_frame_and_shifted_points_raise_no_phase_warning():
    rng = np.random.default_rng(3)
    for seed in range(4):
        data = study(40 + seed, lines=60, scale=10.0, loss=0.1)
        turn = rotation_from_vector(np.radians(1.0) * rng.normal(size=3)).T
        bodies = tuple(
            replace(
                b, positions_mm=b.positions_mm + 0.05 * rng.normal(size=3), directions=b.directions @ turn
            )
            for b in data.bodies
        )
        codes = {notice.code for notice in points2dof(replace(data, bodies=bodies)).notices}
        assert not codes & {"phase_convention", "label_swap", "body_sign"}


@pytest.mark.parametrize("body", [0, 1])
def test_ten_lines_show_one_body_in_rms(body):
    few = np.geomspace(400.0, 5000.0, 10)
    right = [moved(seed, ("y", "x"), 0.1, freq=few, noise=0.003) for seed in range(12)]
    assert [told(motion) for motion in right] == [[]] * 12
    slipped = [changed(motion, body, lambda q: q / np.sqrt(2.0)) for motion in right]
    named = [[code for code, _ in told(motion)] for motion in slipped]
    assert named.count(["unit_slip"]) >= 9
    assert {code for codes in named for code in codes} == {"unit_slip"}


@pytest.mark.parametrize("factor", [2.0, 0.4, 10.0])
def test_another_range_of_one_body_in_one_run_is_named_or_nothing_is(factor):
    named = 0
    for seed in range(8):
        motion = moved(300 + seed, ("y", "x", "z"), freq=np.geomspace(400.0, 5000.0, 30))
        q, body = motion.q.copy(), seed % 2
        q[1, body] *= factor
        found = told(replace(motion, q=q))
        expected = factor if body == 0 else 1.0 / factor
        assert [code for code, _ in found] in ([], ["unit_slip"])
        assert all(f"with base {expected:.4g} times as large in run 2 alone" in text for _, text in found)
        named += bool(found)
    assert named >= 6


def test_too_few_lines_are_not_judged():
    pair = Pair.of(moved(15, freq=np.linspace(400.0, 900.0, 8)), "stapes", "base")
    assert pair.misfit() is None


@pytest.mark.parametrize("seed", range(6))
def test_a_base_that_hardly_moves_is_not_taken_for_the_structure(seed):
    """Each body moves in one degree of freedom, alike at all lines, which no ligament makes."""
    rng = np.random.default_rng([seed, 23])
    clean = np.zeros((1, 2, len(FREQ), 6), dtype=complex)
    clean[0, 0, :, rng.integers(6)] = 1e-5
    clean[0, 1, :, rng.integers(6)] = 1e-7
    sd = 0.01 * np.sqrt(np.mean(np.abs(clean) ** 2, axis=(2, 3), keepdims=True)) * np.ones(clean.shape)
    q = clean + sd * (rng.normal(size=(*clean.shape, 2)) @ [1.0, 1j])
    covariance = np.zeros((*q.shape, 6), dtype=complex)
    covariance[..., range(6), range(6)] = 2.0 * sd**2
    assert not phase_notice(replace(moved(0), q=q, covariance=covariance))
