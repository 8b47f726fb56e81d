"""The fit of many lines against plain least squares of single lines, and what it keeps in memory."""

from __future__ import annotations

import tracemalloc
from itertools import combinations

import numpy as np
import pytest

from legacy.kinematics.fit import symmetric_batches
from legacy.kinematics.fit.beams import beam_set
from legacy.kinematics.fit.body_noise import largest_rate
from legacy.kinematics.fit.line_noise import LineNoise
from legacy.kinematics.fit.rigid_fit import fit_lines, refit
from legacy.kinematics.fit.robust_fit import TOLERANCE, robust_weight
from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import from_arrays
from legacy.kinematics.points2dof import points2dof
from legacy.stapeskit.spatial import DOF_NAMES
from tests.kinematics.simulated import (
    body,
    measurement,
    readings,
    scene,
    smooth_motion,
    stapes_points,
    three_beams,
)

SUBSETS = [dof for size in range(1, 7) for dof in combinations(DOF_NAMES, size)]


def plain(beams, value, sd):
    """Weighted least squares of one line at a time, with numpy's own solver."""
    q, covariance, chi2 = [], [], []
    for line in range(value.shape[1]):
        use = np.isfinite(value[:, line]) & np.isfinite(sd[:, line])
        root = 1.0 / sd[use, line]
        scale = np.linalg.norm(beams.rows, axis=0)
        matrix = root[:, None] * beams.rows[use] / scale
        found = np.linalg.lstsq(matrix, root * value[use, line], rcond=None)[0]
        q.append(found / scale)
        covariance.append(2.0 * np.linalg.inv(matrix.T @ matrix) / np.outer(scale, scale))
        chi2.append(np.sum(np.abs(root * value[use, line] - matrix @ found) ** 2))
    return np.array(q), np.array(covariance), np.array(chi2)


def holes(made, kind):
    """Noise and missing values in all the forms that are solved differently."""
    rng = np.random.default_rng(4)
    value, sd = made.value.copy(), made.sd.copy()
    if "channel" in kind:
        value[5] = np.nan
    if "stretch" in kind:
        value[[2, 11], 30:] = np.nan
    if "single" in kind:
        value[rng.random(value.shape) < 0.05] = np.nan
    if "split" in kind:
        sd = sd * 10.0 ** rng.uniform(-1.0, 1.0, (27, 1)) * 10.0 ** rng.uniform(-1.0, 1.0, value.shape[1])
    if "uneven" in kind:
        sd = sd * 10.0 ** rng.uniform(-1.0, 1.0, sd.shape)
    if "unknown" in kind:
        sd[rng.random(sd.shape) < 0.05] = np.nan
    if "infinite" in kind:
        sd[7, ::3] = np.inf
    return value, sd


@pytest.mark.parametrize(
    "kind",
    [
        "",
        "channel",
        "stretch",
        "single",
        "split",
        "split channel",
        "split stretch single",
        "uneven",
        "uneven channel single",
        "uneven unknown",
        "infinite",
    ],
)
def test_every_way_to_solve_is_least_squares_of_each_line(kind):
    made = scene(5, lines=70)
    value, sd = holes(made, kind)
    beams = beam_set("stapes", made.positions_mm, made.directions, DOF_NAMES)
    fit = fit_lines(beams, value, sd)
    q, covariance, chi2 = plain(beams, value, sd)
    assert np.allclose(fit.q, q, rtol=1e-11, atol=1e-13 * np.max(np.abs(q), axis=0))
    size = np.sqrt(np.einsum("faa->fa", covariance))
    assert np.allclose(
        fit.covariance / size[:, :, None] / size[:, None],
        covariance / size[:, :, None] / size[:, None],
        atol=1e-9,
    )
    assert np.allclose(fit.chi2, chi2, rtol=1e-9)
    used = np.isfinite(value) & np.isfinite(sd)
    assert np.array_equal(fit.n_dof, 2 * (used.sum(axis=0) - 6))
    residual = np.where(used, value - beams.rows @ q.T, 0.0)
    assert np.allclose(fit.residual, residual, atol=1e-12 * np.max(np.abs(made.value)))
    number = used.sum(axis=1)
    rms = np.sqrt(np.sum(np.abs(residual) ** 2, axis=1)[number > 0] / number[number > 0])
    assert np.allclose(fit.channel_rms[number > 0], rms)
    freedom = 2.0 * np.sum(np.where(used, 1.0 - fit.leverage(), 0.0), axis=1)
    energy = np.sum(np.abs(residual / np.where(used, sd, 1.0)) ** 2, axis=1)
    assert np.allclose((fit.channel_energy * freedom)[number > 0], energy[number > 0])
    assert np.sum(freedom) == pytest.approx(np.sum(fit.n_dof))


@pytest.mark.parametrize("kind", ["", "split", "uneven single"])
@pytest.mark.parametrize("robust", ["none", "huber"])
def test_pieces_are_the_whole(kind, robust):
    made = scene(6, lines=60)
    value, sd = holes(made, kind)
    beams = beam_set("stapes", made.positions_mm, made.directions, DOF_NAMES)
    fit = fit_lines(beams, value, sd, robust)
    chosen = np.arange(27) % 4 == 1
    parts = list(fit.blocks(chosen))
    for place, whole in enumerate((fit.residual, fit.sd, fit.weights)):
        joined = np.hstack([part[1 + place] for part in parts])
        assert np.array_equal(joined, whole[chosen])
    assert np.array_equal(fit.at(np.array([3, 50]))[0], fit.residual[:, [3, 50]])


def test_energies_of_channels_say_one_where_the_noise_is_as_stated():
    made = scene(7, lines=3000)
    beams = beam_set("s", made.positions_mm, made.directions, DOF_NAMES)
    assert np.all(np.abs(fit_lines(beams, made.value, made.sd).channel_energy - 1.0) < 0.1)
    loud = made.value.copy()
    loud[4] += 3.0 * made.sd[4] * (np.random.default_rng(0).normal(size=(3000, 2)) @ [1.0, 1j])
    energy = fit_lines(beams, loud, made.sd).channel_energy
    assert np.argmax(energy) == 4
    assert 5.0 < energy[4] < 10.5


@pytest.mark.parametrize("dof", SUBSETS, ids=",".join)
def test_any_subset_is_fitted_exactly(dof):
    q = np.zeros((3, 6), dtype=complex)
    places = [DOF_NAMES.index(name) for name in dof]
    rng = np.random.default_rng(len(dof))
    size = np.array([1e-7] * 3 + [1e-4] * 3)
    q[:, places] = ((rng.normal(size=(3, 6)) + 1j * rng.normal(size=(3, 6))) * size)[:, places]
    made = scene(3, lines=3, snr=np.inf, q=q)
    fit = fit_lines(beam_set("s", made.positions_mm, made.directions, dof), made.value, np.array(1e-10))
    assert np.max(np.abs(fit.q - q[:, places]) / np.max(np.abs(q[:, places]), axis=0)) < 1e-10


def test_beams_of_every_kind_mix():
    """A scanner along y on the footplate, three beams at the head, and two oblique ones."""
    rng = np.random.default_rng(8)
    places = stapes_points(rng, 9)
    oblique = np.array([[0.6, 0.8, 0.0], [0.0, 0.8, -0.6]])
    positions = np.vstack([places[:4], np.repeat(places[-1:], 3, axis=0), places[5:7]])
    directions = np.vstack([np.tile([0.0, 1.0, 0.0], (4, 1)), np.eye(3), oblique])
    q = smooth_motion(rng, np.linspace(400.0, 5000.0, 20))
    sd = np.repeat([1e-9, 3e-9, 5e-10], [4, 3, 2])[:, None]
    value = readings(positions, directions, q)
    fit = fit_lines(beam_set("s", positions, directions, DOF_NAMES), value, sd)
    assert np.max(np.abs(fit.q - q) / np.max(np.abs(q), axis=0)) < 1e-10
    assert np.all(fit.n_dof == 6)


def test_base_motion_is_carried_to_the_footplate_centre():
    """Points on bone 8 mm away: motion about their middle, moved by v + omega x r, with its covariance."""
    made = scene(9, lines=40)
    away = np.array([5.0, -6.0, 2.0])
    value = readings(made.positions_mm + away, made.directions, made.q) + made.sd * 0.3
    here = fit_lines(beam_set("base", made.positions_mm + away, made.directions, DOF_NAMES), value, made.sd)
    there = fit_lines(beam_set("base", made.positions_mm, made.directions, DOF_NAMES), value, made.sd)
    arm = -away * 1e-3
    carry = np.eye(6)
    carry[:3, 3:] = np.array([[0.0, arm[2], -arm[1]], [-arm[2], 0.0, arm[0]], [arm[1], -arm[0], 0.0]])
    assert np.allclose(here.q, there.q @ carry.T, rtol=1e-9)
    assert np.allclose(here.covariance, carry @ there.covariance @ carry.T, rtol=1e-8, atol=1e-30)


def test_singular_lines_are_told_whichever_way_they_are_solved():
    made = scene(10, lines=12)
    value, sd = made.value.copy(), made.sd.copy()
    value[9:, 4] = np.nan
    value[:, 7] = np.nan
    beams = beam_set("s", made.positions_mm, made.directions, DOF_NAMES)
    for weights in (sd, sd * np.random.default_rng(0).uniform(0.5, 2.0, sd.shape)):
        fit = fit_lines(beams, value, weights)
        assert np.flatnonzero(np.isnan(fit.q[:, 0])).tolist() == [7]
        assert fit.n_dof[7] == 0
        assert np.all(np.isfinite(fit.residual))
    alone = fit_lines(beams, value[:, 7:8], sd[:, 7:8])
    assert np.isnan(alone.q).all()


@pytest.mark.parametrize("robust", ["huber", "t4"])
@pytest.mark.parametrize(("share", "missing"), [(0.0, 0.0), (0.1, 0.0), (0.1, 0.3), (0.5, 0.0), (0.5, 0.2)])
def test_robust_fits_settle_where_their_equations_hold(robust, share, missing):
    made = scene(11, lines=300)
    rng = np.random.default_rng(1)
    hit = rng.random(made.value.shape) < share
    made.value[hit] += 20.0 * made.sd[hit] * (rng.normal(size=(int(hit.sum()), 2)) @ [1.0, 1j])
    made.value[rng.random(made.value.shape) < missing] = np.nan
    beams = beam_set("s", made.positions_mm, made.directions, DOF_NAMES)
    fit = fit_lines(beams, made.value, made.sd, robust)
    assert fit.unsettled == 0
    assert 2 < fit.iterations < 100
    residual = np.nan_to_num(fit.residual)
    weight = robust_weight(np.abs(residual) / made.sd, robust)[0]
    left = beams.basis.T @ (weight * residual / made.sd**2)
    step = np.sqrt(np.sum(np.abs(np.einsum("fab,bf->af", fit.inverse, left)) ** 2, axis=0))
    sd = np.sqrt(np.einsum("faa->f", fit.inverse))
    assert np.max(step / sd) < 10.0 * TOLERANCE


def test_contradicting_channels_are_told_when_a_robust_fit_does_not_settle(monkeypatch):
    monkeypatch.setattr("legacy.kinematics.fit.robust_fit._MOST", 1)
    made = scene(11, lines=20)
    result = points2dof(
        measurement(body("stapes", made), freq_hz=made.freq_hz), options=Options(robust="huber")
    )
    text = next(n.text for n in result.notices if n.code == "robust_unsettled")
    assert "had not settled at 20 lines after 1 iterations" in text


def test_the_same_noise_serves_another_subset():
    made = scene(12, lines=30)
    beams = beam_set("s", made.positions_mm, made.directions, DOF_NAMES)
    few = beam_set("s", made.positions_mm, made.directions, ("y", "alpha", "gamma"))
    fit = fit_lines(few, made.value, made.sd)
    assert np.array_equal(refit(beams, fit).q, fit_lines(beams, made.value, made.sd).q)
    assert fit.complete
    assert fit.common is not None


def test_noise_splits_into_channels_and_lines_only_where_it_does():
    share, line = np.array([0.5, 1.0, 0.2]), np.array([1.0, 3.0, 2.0, 5.0])
    product = share[:, None] * line
    channel, level = LineNoise(product).common()
    assert np.allclose(channel[:, None] * level, product)
    assert np.max(channel) == 1.0
    bent = product.copy()
    bent[1, 2] *= 1.0 + 1e-9
    assert LineNoise(bent).common() is None
    assert LineNoise(product, floor=np.full(4, 0.3)).common() is None
    assert LineNoise(np.where(product == 1.0, np.nan, product)).common() is None
    assert np.array_equal(
        LineNoise(product, line, np.full(4, 0.3)).at(slice(1, 3)), product[:, 1:3] * line[1:3]
    )


def test_the_largest_reading_is_found_beside_missing_ones():
    value = np.array([[1.0 + 1j, np.nan, -3.0j], [2.0, np.inf, 1.0]])
    assert largest_rate(value, np.ones(3)) == 3.0
    assert largest_rate(value.T.copy().T, np.array([2.0, 1.0, 1.0])) == 4.0
    assert largest_rate(value[:, 1:2], np.ones(1)) == 0.0


def test_packed_matrices_are_those_of_numpy():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(30, 6, 9))
    matrices = root @ root.transpose(0, 2, 1)
    entries = symmetric_batches.pack(matrices)
    assert np.array_equal(symmetric_batches.unpack(entries, 6), matrices)
    inverses = symmetric_batches.inverse(entries, 6)
    assert np.allclose(symmetric_batches.unpack(inverses, 6), np.linalg.inv(matrices), rtol=1e-8)
    turn = rng.normal(size=(4, 6))
    assert np.allclose(
        symmetric_batches.unpack(symmetric_batches.congruence(turn) @ entries, 4), turn @ matrices @ turn.T
    )
    norms = np.linalg.norm(matrices, axis=(1, 2)) * np.linalg.norm(np.linalg.inv(matrices), axis=(1, 2))
    assert np.allclose(symmetric_batches.condition(entries, inverses, 6), norms)


def test_the_fit_takes_little_more_memory_than_its_data():
    made = scene(13, lines=1500, count=60)
    beams = beam_set("s", made.positions_mm, made.directions, DOF_NAMES)
    uneven = made.sd * np.random.default_rng(0).uniform(0.5, 2.0, made.sd.shape)
    for sd, share in ((np.full((1, 1500), 1e-9), 0.6), (made.sd, 0.6), (uneven, 1.6)):
        fit_lines(beams, made.value[:, :100], sd[:, :100])
        tracemalloc.start()
        fit_lines(beams, made.value, sd)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert most < share * made.value.nbytes


def test_readings_become_displacements_in_place_on_request():
    made = scene(14, lines=5)
    parts = {"points": made.points, "positions_mm": made.positions_mm, "directions": made.directions}
    rate = 2j * np.pi * made.freq_hz
    velocity = made.value * rate
    kept = velocity.copy()
    copied = from_arrays({"s": {**parts, "value": velocity}}, made.freq_hz)
    assert np.array_equal(velocity, kept)
    taken = from_arrays({"s": {**parts, "value": velocity}}, made.freq_hz, overwrite=True)
    assert np.array_equal(taken.bodies[0].displacement, copied.bodies[0].displacement)
    assert np.shares_memory(taken.bodies[0].displacement, velocity)
    assert np.allclose(velocity, made.value)


@pytest.mark.parametrize("where", ["one value", "one channel", "single values"])
def test_values_that_are_nearly_exact_cost_no_line(where):
    rng = np.random.default_rng(5)
    places, beams = np.repeat(stapes_points(rng), 3, axis=0), np.tile(three_beams(20.0), (9, 1))
    q = smooth_motion(rng, np.linspace(400.0, 5000.0, 300))
    sd = np.full((27, 300), 1e-9)
    exact = {"one value": (3, 7), "one channel": 3, "single values": rng.random(sd.shape) < 0.05}[where]
    sd[exact] *= 1e-9
    noise = rng.normal(size=(27, 600)).view(complex)
    value = readings(places, beams, q) + sd * noise
    fit = fit_lines(beam_set("s", places, beams, DOF_NAMES), value, sd)
    assert np.all(fit.solution.good)
    error = np.abs(fit.q - q) ** 2 / np.diagonal(fit.covariance, axis1=1, axis2=2)
    assert np.mean(error) == pytest.approx(1.0, abs=0.08)
    assert np.sum(fit.chi2) / np.sum(fit.n_dof) == pytest.approx(1.0, abs=0.05)
    assert np.max(np.abs(fit.residual[exact])) < 1e-4 * 1e-9 or where == "single values"
