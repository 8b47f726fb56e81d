"""Noise of unknown size may fall or rise over frequency without being taken for motion that is not rigid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fault_bodies import draw
from benchmarks.fault_scenes import measured, scene
from legacy.kinematics.fit.beams import beam_set
from legacy.kinematics.fit.noise_spectrum import noise_course
from legacy.kinematics.fit.rigid_fit import LineFit, fit_lines
from legacy.kinematics.measurement import from_arrays
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.signals.frf import line_spread
from legacy.stapeskit.spatial import DOF_NAMES
from tests.kinematics.simulated import readings, smooth_motion, stapes_points, three_beams

FREQ = np.linspace(100.0, 4000.0, 60)


def fitted(power: float, seed: int = 1, loud: tuple[int, ...] = ()) -> LineFit:
    """Return a fit with equal stated noise of data whose noise runs as a power of the frequency."""
    rng = np.random.default_rng(seed)
    places, beams = np.repeat(stapes_points(rng), 3, axis=0), np.tile(three_beams(20.0), (9, 1))
    sd = 1e-10 * (FREQ / 500.0) ** power
    sd[list(loud)] *= 30.0
    value = readings(places, beams, smooth_motion(rng, FREQ))
    value = value + sd * rng.normal(size=(27, 2 * len(FREQ))).view(complex)
    return fit_lines(beam_set("s", places, beams, DOF_NAMES), value, np.array(1e-10))


@pytest.mark.parametrize("power", [-2.0, -1.0, 1.0])
def test_the_course_of_noise_is_found_beside_lines_that_stand_out(power: float) -> None:
    course = noise_course(fitted(power, loud=(20, 41)), FREQ)
    assert course is not None
    wanted = (FREQ / 500.0) ** power
    assert np.std(np.log(course / wanted)) < 0.15


def test_noise_without_a_course_has_none() -> None:
    assert [noise_course(fitted(0.0, seed), FREQ) for seed in range(8)] == [None] * 8


@pytest.mark.parametrize("power", [0.0, -1.0, 1.0])
@pytest.mark.parametrize("size", [-2.0, 0.0, 0.3])
@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_a_fault_however_large_is_no_course_of_the_noise(power: float, size: float, missing: float) -> None:
    rng = np.random.default_rng(3)
    places, beams = np.repeat(stapes_points(rng), 3, axis=0), np.tile(np.eye(3), (9, 1))
    value = readings(places, beams, smooth_motion(rng, FREQ))
    value[[7, 8, 20]] *= 1.0 + size * np.array([[1.0], [1j], [0.5]])
    sd = 0.002 * np.std(value) * (FREQ / 500.0) ** power
    value = value + sd * rng.normal(size=(27, 2 * len(FREQ))).view(complex)
    value[rng.random(value.shape) < missing] = np.nan
    course = noise_course(fit_lines(beam_set("s", places, beams, DOF_NAMES), value, np.array(1e-10)), FREQ)
    found = np.ones(len(FREQ)) if course is None else course
    assert np.std(np.log(found * FREQ**-power)) < 0.15


@pytest.mark.parametrize("missing", [0.04, 0.2])
def test_lines_of_a_resonance_with_gaps_are_no_quiet_part_of_the_band(missing: float) -> None:
    rng = np.random.default_rng(6)
    places, beams = np.repeat(stapes_points(rng), 3, axis=0), np.tile(three_beams(20.0), (9, 1))
    resonance = 1.0 / (1.0 - (FREQ / 95.0) ** 2 + 0.1j)
    value = readings(places, beams, smooth_motion(rng, FREQ) * resonance[:, None])
    value = value + 1e-3 * np.median(np.abs(value)) * rng.normal(size=(27, 2 * len(FREQ))).view(complex)
    value[rng.random(value.shape) < missing] = np.nan
    course = noise_course(fit_lines(beam_set("s", places, beams, DOF_NAMES), value, np.array(1e-10)), FREQ)
    assert course is None or np.ptp(np.log(course)) < 0.3


@pytest.mark.parametrize(
    ("body", "fault", "lines", "gaps"),
    [
        ("shell, 12 points, 3 heads", "", 7, 0.0),
        ("shell, 12 points, 3 heads", "sign", 7, 0.1),
        ("rod, 8 points, 2-3 heads", "", 12, 0.25),
        ("shell, 5 points, 3 heads", "head sign", 120, 0.4),
        ("shell, 12 points, 3 heads", "head delay 10 us", 40, 0.2),
    ],
)
def test_few_lines_and_gaps_show_the_course_beside_a_fault(
    body: str, fault: str, lines: int, gaps: float
) -> None:
    off = []
    for seed in range(6):
        made = draw(seed, body, fault, lines=lines, noise=1e-9, gaps=gaps)
        rng = np.random.default_rng(seed)
        sd = 0.007 * np.sqrt(np.nanmean(np.abs(made.value) ** 2)) * (made.freq_hz / 1500.0) ** -1.0
        value = made.value + sd * rng.normal(size=(len(made.value), 2 * lines)).view(complex)
        fit = fit_lines(beam_set("s", made.positions_mm, made.directions, DOF_NAMES), value, np.array(1e-10))
        course = noise_course(fit, made.freq_hz)
        assert course is not None
        log = np.log(course * made.freq_hz)
        off.append(np.max(np.abs(log - np.median(log))))
    assert np.median(off) < np.log(1.5)
    assert np.max(off) < np.log(2.5)  # before, up to 90


def test_a_point_of_the_wrong_sign_among_few_lines_makes_no_course() -> None:
    for seed in range(6):
        made = draw(seed, "shell, 5 points, 3 heads", lines=12, noise=1e-9)
        made.value[:3] *= -1.0
        rng = np.random.default_rng(seed)
        sd = 0.005 * np.sqrt(np.mean(np.abs(made.value) ** 2))
        value = made.value + sd * rng.normal(size=(15, 24)).view(complex)
        fit = fit_lines(beam_set("s", made.positions_mm, made.directions, DOF_NAMES), value, np.array(1e-10))
        course = noise_course(fit, made.freq_hz)
        assert course is None or np.ptp(np.log(course)) < np.log(3.0)


@pytest.mark.parametrize("missing", [0.0, 0.03])
@pytest.mark.parametrize("seed", [5001, 5003])
def test_a_beam_of_the_wrong_sign_is_named_where_no_noise_is_stated(seed: int, missing: float) -> None:
    made = scene(seed, "stapes, 10 points 3D", "sign")
    value = measured(made, seed)
    value[np.random.default_rng(seed).random(value.shape) < missing] = np.nan
    body = {
        "points": list(made.points),
        "positions_mm": made.reported,
        "directions": made.directions,
        "value": value,
    }
    found = points2dof(from_arrays({"stapes": body}, made.freq_hz, order=0)).channels
    assert {c: v.verdict for c, v in enumerate(found) if v.verdict != "ok"} == {made.culprits[0]: "sign"}


@pytest.mark.parametrize("order", [0, 2])
def test_noise_of_velocities_in_other_quantities_is_no_flexible_body(order: int) -> None:
    rng = np.random.default_rng(9)
    places, beams = np.repeat(stapes_points(rng), 3, axis=0), np.tile(np.eye(3), (9, 1))
    rate = 2.0 * np.pi * FREQ
    clean = readings(places, beams, smooth_motion(rng, FREQ))
    noise = 0.003 * np.mean(np.abs(clean) * rate) / rate * rng.normal(size=(27, 2 * len(FREQ))).view(complex)
    body = {
        "points": [str(c // 3) for c in range(27)],
        "positions_mm": places,
        "directions": beams,
        "value": (clean + noise) * (1j * rate) ** order,
    }
    found = points2dof(from_arrays({"stapes": body}, FREQ, order=order))
    assert {channel.verdict for channel in found.channels} == {"ok"}


def test_noise_that_windows_share_between_lines_is_no_fault() -> None:
    window = np.hanning(65)[:64]
    spread = line_spread(window)
    assert spread == pytest.approx(1.0 + 2.0 * (4.0 / 9.0 + 1.0 / 36.0), rel=1e-3)
    assert line_spread(np.ones(64)) == pytest.approx(1.0)
    freq = np.linspace(100.0, 4000.0, 300)
    found, plain = [], []
    for seed in range(3):
        rng = np.random.default_rng([seed, 11])
        places, beams = np.repeat(stapes_points(rng), 3, axis=0), np.tile(three_beams(20.0), (9, 1))
        white = rng.normal(size=(27, 2 * 302)).view(complex)
        noise = white[:, :-2] + 1.46 * white[:, 1:-1] + white[:, 2:]
        noise *= 1e-10 / np.sqrt(2.0 + 1.46**2)
        body = {
            "points": [str(c // 3) for c in range(27)],
            "positions_mm": places,
            "directions": beams,
            "value": readings(places, beams, smooth_motion(rng, freq)) + noise,
            "sd": 1e-10,
        }
        made = from_arrays({"stapes": body}, freq, order=0)
        shared = (2.0 + 1.46) ** 2 / (2.0 + 1.46**2)
        for out, factor in ((plain, 1.0), (found, shared)):
            judged = points2dof(replace(made, line_spread=factor)).channels
            out.append(any(channel.verdict != "ok" for channel in judged))
    assert sum(found) == 0
    assert sum(plain) > 1
