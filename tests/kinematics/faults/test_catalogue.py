"""Every kind of the catalogue: its tangents, what undoes it, its fit, and its place in the search."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.kinematics.faults.alternatives import proposed
from legacy.kinematics.faults.catalogue import ADVICE, KINDS, Fault
from legacy.kinematics.faults.findings import Finding
from legacy.kinematics.faults.nuisance import Marginal, Nuisance, estimate_nuisance
from legacy.kinematics.faults.packed_readings import Source, initial, packed
from legacy.kinematics.faults.proposals.exchanges import Layout
from legacy.kinematics.faults.refit import Refit
from legacy.kinematics.faults.score_information import State, model_of
from legacy.kinematics.faults.score_tests import score_tests
from legacy.kinematics.fit.beams import beam_set
from legacy.kinematics.fit.rigid_fit import fit_lines
from legacy.stapeskit.spatial import DOF_NAMES
from legacy.stapeskit.warnings import table
from tests.kinematics.simulated import body, scene

PLACES = [(name, owner) for name, kind in KINDS.items() for owner in kind.owners]
CHANNELS = {"channel": [4], "point": [3, 4, 5], "laser": list(range(1, 27, 3)), "body": list(range(27))}


def data_of(made, known=True):
    """Return a scene packed."""
    fit = fit_lines(beam_set("stapes", made.positions_mm, made.directions, DOF_NAMES), made.value, made.sd)
    some = body("stapes", made)
    return initial(Source.of(fit, some, made.freq_hz, known), some)


def small(name):
    """Return parameters of a fault of a kind."""
    rng = np.random.default_rng(3)
    return 0.1 * KINDS[name].scale(1.5e-3) * rng.uniform(0.5, 1.0, len(KINDS[name].tangents))


def test_every_verdict_has_a_warning_of_the_table_and_a_step():
    for verdict, (code, step) in ADVICE.items():
        assert step.endswith(".")
        assert code in table() or verdict in ("zeros", "unused")


@pytest.mark.parametrize(("name", "owner"), PLACES)
@pytest.mark.parametrize("sd", [1e-3, 1.0])
def test_every_kind_is_told_as_a_verdict_that_has_a_warning(name, owner, sd):
    described = body("stapes", scene(20))
    for size in (0.1, -2.0, np.pi):
        parameters = size / 0.1 * small(name)
        fault, covariance = Fault(name, owner, CHANNELS[owner]), sd**2 * np.eye(len(parameters))
        fit = Finding(name, fault.channels, fault=fault, parameters=parameters, covariance=covariance)
        verdict, estimate = KINDS[name].sentence(fit, described)
        assert ADVICE[verdict][0] in table()
        assert estimate


@pytest.mark.parametrize(("name", "owner"), PLACES)
def test_tangents_are_the_derivatives_of_the_readings(name, owner):
    data = data_of(scene(20))
    fault = Fault(name, owner, CHANNELS[owner])
    state = State.of(data)
    beam = model_of(data).directions[fault.channels[0]] if owner == "laser" else None
    made = state.tangents(np.array(fault.channels), KINDS[name].tangents, beam)
    base = model_of(data)
    for k, size in enumerate(KINDS[name].scale(1.5e-3)):
        step = np.zeros(len(KINDS[name].tangents))
        step[k] = 1e-5 * size
        reads = []
        for sign in (1.0, -1.0):
            own = State.of(data, fault.applied(base, sign * step, data)).own[:, fault.channels]
            reads.append(own @ state.z)
        numerical = (reads[0] - reads[1]) / (2.0 * step[k])
        np.testing.assert_allclose(made[k], numerical, atol=1e-4 * np.max(np.abs(made[k])))


@pytest.mark.parametrize(("name", "owner"), PLACES)
def test_what_undoes_a_fault_leaves_nothing(name, owner):
    made = scene(21, snr=np.inf)
    clean = data_of(replace(made, sd=np.full_like(made.sd, 1e-10)))
    fault, p = Fault(name, owner, CHANNELS[owner]), small(name)
    arms, beams = fault.geometry(clean.assumed.arms_m, clean.assumed.directions, p)
    rows = np.hstack([beams, np.cross(arms, beams)])
    factor = np.ones((27, len(made.freq_hz)), dtype=complex)
    if KINDS[name].factor is not None:
        factor[fault.channels] = KINDS[name].factor(p, clean.source.tau, clean.source.ratio)
    spoiled = replace(made, value=(rows @ made.q.T) * factor, sd=np.full_like(made.sd, 1e-10))
    data = data_of(spoiled)
    assert State.of(data).energy > 1.0
    assert State.of(data.under(fault.undone(data.assumed, p))).energy < 1e-6 * State.of(data).energy


@pytest.mark.parametrize("kind", ["gain", "phase", "delay", "direction", "position"])
def test_score_and_refit_agree_on_a_small_fault(kind):
    made = scene(22)
    made.value[4] *= 1.004
    data = data_of(made)
    near = Marginal(State.of(data), Nuisance.of(data, np.zeros(27)))
    owner = KINDS[kind].owners[0]
    found = next(one for one in score_tests(near, {owner: [CHANNELS[owner]]}) if one.kind == kind)
    refit = Refit(near, data.merged(near.state.z))
    fit = refit.fit(Fault(kind, owner, CHANNELS[owner]))
    assert 2.0 * fit.drop == pytest.approx(found.statistic[0], rel=0.1, abs=0.5)


def test_scores_of_clean_data_are_chi_squared_next_to_nuisance_parameters():
    found: dict[str, list[float]] = {}
    for seed in range(6):
        made = scene(740 + seed, lines=60, position_sd_mm=0.02)
        data = data_of(made)
        nuisance = Nuisance.of(data, np.full(27, 2e-5))
        places = {"channel": [[c] for c in range(27)], "point": [CHANNELS["point"]]}
        for one in score_tests(estimate_nuisance(data, nuisance), places):
            found.setdefault(one.kind, []).extend(one.statistic / one.freedom)
    for kind in ("gain", "phase", "direction"):
        assert np.mean(found[kind]) == pytest.approx(1.0, abs=0.3)


def test_steps_next_to_positions_lead_to_the_least_objective():
    made = scene(770, "gain")
    data = data_of(made)
    nuisance = Nuisance.of(data, np.full(27, 2e-5))
    near = estimate_nuisance(data, nuisance)
    refit = Refit(near, data)
    fault = Fault("gain", "channel", made.culprits)
    fit = refit.fit(fault)
    assert fit.parameters[0] == pytest.approx(0.05, abs=0.02)
    step = 0.05 * np.sqrt(fit.covariance[0, 0])
    for sign in (1.0, -1.0):
        model = fault.applied(model_of(data), fit.parameters + sign * step, data)
        best = min(Marginal.at(data, nuisance, y, model).value for y in (near.x, 0.0 * near.x))
        assert near.value - best < fit.drop + 1e-6


def test_packed_lines_hold_all_energy():
    made = scene(20, "gain", lines=84)
    data = data_of(made)
    state = State.of(data)
    fine = State.of(packed(data.source, data.assumed, fine=True))
    both = state.energy + float(np.sum(np.abs(state.rest) ** 2))
    assert both == pytest.approx(fine.energy, rel=1e-9)


def test_missing_values_are_zero_weights():
    made = scene(20)
    made.value[::5, ::7] = np.nan
    data = data_of(made)
    assert np.all(data.y[::7, ::5] == 0.0)
    state = State.of(data)
    assert 2.0 * state.energy == pytest.approx(2.0 * np.sum(state.free()), rel=0.1)


def test_exchanges_are_undone_by_themselves():
    made = scene(20)
    data = data_of(made)
    points = {
        name: [c for c, own in enumerate(made.points) if own == name] for name in dict.fromkeys(made.points)
    }
    lasers = [list(range(k, 27, 3)) for k in range(3)]
    layout = Layout(data, points, lasers, made.positions_mm, np.eye(3), list(points))
    proposals = [found.value for found in proposed("exchange", layout)]
    assert {fault.owner for fault in proposals} == {"points", "beams", "lasers", "point", "body"}
    for fault in proposals[::7]:
        arms, beams = fault.geometry(data.assumed.arms_m, data.assumed.directions, np.zeros(0))
        assert sorted(np.round(arms.ravel(), 12)) == sorted(np.round(data.assumed.arms_m.ravel(), 12))
        assert sorted(np.round(beams.ravel(), 12)) == sorted(np.round(data.assumed.directions.ravel(), 12))
