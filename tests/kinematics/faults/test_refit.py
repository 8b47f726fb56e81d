"""Faults are fitted next to the errors of all positions, and skipped only where they explain little."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fault_scenes import scene as drawn
from benchmarks.points_faults import judged
from legacy.kinematics.faults.catalogue import Fault
from legacy.kinematics.faults.laser_scatter import LaserScatter
from legacy.kinematics.faults.nuisance import Marginal, Nuisance, estimate_nuisance
from legacy.kinematics.faults.packed_readings import Source, initial
from legacy.kinematics.faults.refit import Refit
from legacy.kinematics.faults.score_information import State, model_of
from legacy.kinematics.faults.search import Search
from legacy.kinematics.fit.beams import beam_set
from legacy.kinematics.fit.rigid_fit import fit_lines
from legacy.kinematics.measurement import BodyChannels
from tests.kinematics.faults.test_catalogue import CHANNELS, data_of
from tests.kinematics.simulated import scene

SD_M = 3e-5
FAULTS = [
    Fault(kind, owner, CHANNELS[owner])
    for kind, owner in [
        ("gain", "channel"), ("direction", "channel"), ("delay", "channel"), ("position", "point"),
        ("gain", "laser"), ("drift", "point"),
    ]
]  # fmt: skip


def refit_of(spoiled, factor, noisy=True):
    """Return the refit of a scene with a factor on some channels, next to errors of positions."""
    made = scene(31)
    made.value = made.value if noisy else scene(31, snr=np.inf).value
    made.value[spoiled] *= factor
    data = data_of(made)
    nuisance = Nuisance.of(data, np.full(27, SD_M))
    flat = data.merged(State.of(data).z)
    return Refit(Marginal.at(data, nuisance, estimate_nuisance(flat, nuisance).x), flat)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: f"{fault.kind} of a {fault.owner}")
@pytest.mark.parametrize("factor", [1.02, -1.0])
def test_no_fault_lowers_the_objective_further_than_leaving_its_channels_out(fault, factor):
    refit = refit_of(CHANNELS["point"], factor)
    assert refit.fit(fault).drop <= 1.01 * refit.most(fault.channels) + 1e-3


@pytest.mark.parametrize("fault", FAULTS[:4], ids=lambda fault: fault.kind)
def test_a_fit_next_to_errors_of_positions_ends_where_its_objective_is_least(fault):
    refit = refit_of([4], 1.02)
    data = refit.data if fault.entry.varies else refit.flat
    now = refit._try(data, fault, np.zeros(fault.size), np.zeros_like(refit.start))
    now, inverse = refit._improve(data, fault, now)
    rng = np.random.default_rng(1)
    scale = np.concatenate([np.sqrt(np.diag(inverse)), refit.near.nuisance.sd])
    for _ in range(20):
        step = 0.05 * scale * rng.normal(size=len(scale))
        other = refit._try(data, fault, now.theta + step[: fault.size], now.near.x + step[fault.size :])
        assert other.value > now.value - 1e-3


def test_the_covariance_of_a_fault_holds_what_errors_of_positions_add():
    refit = refit_of([4], 1.02, noisy=False)
    fault = FAULTS[0]
    now = refit._try(refit.flat, fault, np.zeros(1), np.zeros_like(refit.start))
    now, inverse = refit._improve(refit.flat, fault, now)
    size = np.concatenate([[1e-4], 1e-2 * refit.near.nuisance.sd])
    count = len(size)

    def value(*steps):
        moved = sum(sign * size[k] * np.eye(count)[k] for k, sign in steps)
        return refit._try(refit.flat, fault, now.theta + moved[:1], now.near.x + moved[1:]).value

    hessian = np.zeros((count, count))
    for i in range(count):
        for j in range(i + 1):
            around = [a * b * value((i, a), (j, b)) for a in (1, -1) for b in (1, -1)]
            hessian[i, j] = hessian[j, i] = sum(around) / (4.0 * size[i] * size[j])
    # The objective is a sum of squares: its second derivatives are twice the information.
    assert inverse[0, 0] == pytest.approx(np.linalg.inv(0.5 * hessian)[0, 0], rel=1e-3)


@pytest.mark.parametrize("correlation", [0.0, 0.4])
@pytest.mark.parametrize("scatter", [None, LaserScatter(np.arange(27) % 3, 0.01, 0.01, 1e-6)])
def test_score_and_information_on_nuisance_parameters_are_those_of_the_objective(correlation, scatter):
    data = data_of(scene(31))
    points = np.array(data.points)
    if correlation:
        alike = np.where(points[:, None] == points, correlation, 0.0)
        data = data.under(replace(data.assumed, correlation=alike + (1.0 - correlation) * np.eye(27)))
    nuisance = Nuisance.of(data, np.full(27, SD_M), scatter)
    count = len(nuisance.sd)
    assert count == (27 if scatter is None else 36)
    base, size = model_of(data), 0.1 * nuisance.sd

    def energy(*steps):
        x = sum((sign * size[k] * np.eye(count)[k] for k, sign in steps), np.zeros(count))
        return State.of(data, nuisance.applied(base, x, data.ratio)).energy

    slope, hessian = np.zeros(count), np.zeros((count, count))
    for i in range(count):
        slope[i] = (energy((i, 1)) - energy((i, -1))) / 0.2
        for j in range(i + 1):
            around = [a * b * energy((i, a), (j, b)) for a in (1, -1) for b in (1, -1)]
            hessian[i, j] = hessian[j, i] = sum(around) / (4.0 * 0.1**2)
    near = Marginal(State.of(data), nuisance)
    # The energy is a sum of squares: its first derivatives are minus twice the score, its second ones twice
    # the information, but for what noise adds.
    root = np.sqrt(np.diag(near.information))
    np.testing.assert_allclose(-0.5 * slope / nuisance.sd / root, near.score / root, atol=0.05)
    hessian = 0.5 * hessian / np.outer(nuisance.sd * root, nuisance.sd * root)
    np.testing.assert_allclose(hessian, near.information / np.outer(root, root), atol=0.02)


def test_groups_of_lines_with_the_same_rows_hold_what_they_hold_one_by_one():
    data = data_of(scene(32))
    nuisance = Nuisance.of(data, np.full(27, SD_M))
    near, plain = (Marginal(State.of(data), nuisance) for _ in range(2))
    plain.__dict__["turn"] = None
    assert near.turn is not None
    np.testing.assert_allclose(near.score, plain.score, atol=1e-9 * np.max(np.abs(plain.score)))
    np.testing.assert_allclose(near.information, plain.information, atol=1e-9 * np.max(plain.information))
    groups = np.array([CHANNELS["point"], [0, 1, 2]])
    tangents = near.state.tangents(groups.ravel(), [0, 1]).reshape(2, len(data.y), 2, 3, -1)
    taken = near.state.sums(groups, tangents).taken
    made, expected = (one.common(groups, tangents, taken) for one in (near, plain))
    np.testing.assert_allclose(made, expected, atol=1e-9 * np.max(np.abs(expected)))


def test_what_is_skipped_would_have_been_no_rival():
    made = scene(33)
    made.value[4] *= 1.05
    data = data_of(made)
    frame = (np.zeros((27, 3)), np.eye(3))
    search = Search(data, np.full(27, SD_M), frame, True)
    fitted = {(fit.fault.kind, tuple(fit.channels)): fit for fit in search._suspects()}
    faults = [Fault(test.kind, test.owner, list(own)) for test in search.tested for own in test.sets]
    best = max(search._evidence(fit, search.noise_variance) for fit in fitted.values())
    for fault in faults:
        if (fault.kind, tuple(fault.channels)) not in fitted and 4 in fault.channels:
            assert search._evidence(search.refit.fit(fault), search.noise_variance) < best - 3.0


@pytest.mark.parametrize("seed", range(8))
def test_a_turn_that_is_motion_as_well_is_left_at_zero(seed):
    """Beams along x, y, z at one point that moves along x and y: a turn about z is a turn of the motion."""
    rng = np.random.default_rng(seed)
    beams, arms = np.eye(3), np.tile(rng.normal(size=3), (3, 1))
    value = 1e-7 * rng.normal(size=(3, 24)).view(complex)
    value[2] = 3e-8 + 1e-9 * rng.normal(size=24).view(complex)
    held = BodyChannels("stapes", ("1",) * 3, arms, beams, value[None], np.full((1, *value.shape), 1e-9))
    fit = fit_lines(beam_set("stapes", arms, beams, ("x", "y")), value, held.sd[0])
    data = initial(Source.of(fit, held, np.linspace(400.0, 5000.0, 12), True), held)
    state = State.of(data)
    refit = Refit(Marginal(state, Nuisance.of(data, np.zeros(3))), data.merged(state.z))
    assert np.max(np.abs(refit.fit(Fault("axes", "body", [0, 1, 2])).parameters)) < 1.0


@pytest.mark.parametrize("seed", [52001, 52004, 52007, 52009])
def test_a_shift_along_parallel_beams_is_left_at_zero(seed):
    """It changes no reading: only rounding could move it, and then without bound."""
    made = drawn(seed, "1D, 40 points", "position 200 um")
    found = judged(made, seed)
    (finding,) = found.diagnoses[0, 0].findings
    assert (finding.kind, finding.channels) == ("position", made.culprits)
    assert abs(finding.parameters[1]) < 1e-9
