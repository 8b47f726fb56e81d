"""Local factors of K and D: truth recovered, false alarms as stated, the uncertainty of M included."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.fitting.errors import FittingError
from legacy.fitting.examples.paper import PAPER_DAMPING_CORRECTED
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.model.model import simulate
from legacy.fitting.options import USUAL_BANDS, KDOptions
from legacy.fitting.uncertainty.frequency_dependence import fewer_bands, frequency_dependence
from legacy.stapeskit.records.mass_record import MassMatrix
from legacy.stapeskit.spatial import dof_indices, matrix_from_parameters
from sample_volumes.shaken_stapes import driven_base
from tests.fitting.cases import DOF, FREQ, K, M, paper_motion, six_dof_parameters


def grown_motion(growth: float, noise: float, seed: int):
    """A stiffness that grows with the logarithm of the frequency, K = K0 at 2 kHz."""
    motion = paper_motion(noise, seed)
    exact = paper_motion(noise, None)
    base = driven_base(FREQ, DOF)[0]
    q = motion.q - exact.q
    for line, freq in enumerate(FREQ):
        stiffness = K * (1.0 + growth * np.log(freq / 2000.0))
        q[0, 0, line] += simulate(
            M, stiffness, PAPER_DAMPING_CORRECTED, FREQ[line : line + 1], base[line : line + 1]
        )[0]
        q[0, 1, line] += base[line]
    return replace(motion, q=q)


def test_false_alarms_and_spread_are_as_stated() -> None:
    p_values, scores = [], []
    for seed in range(150):
        fit = fit_kd(paper_motion(0.03, seed), M, KDOptions(inplane="ignore"))
        found = fit.frequency
        p_values.append(found.p_value)
        scores.append(
            np.concatenate(
                [(found.stiffness - 1) / found.stiffness_sd, (found.damping - 1) / found.damping_sd]
            )
        )
    assert found.n_dof == 8
    assert np.mean(np.array(p_values) < 0.5) == pytest.approx(0.5, abs=0.12)
    assert np.mean(np.array(p_values) < 0.05) == pytest.approx(0.05, abs=0.05)
    assert np.std(scores, axis=0) == pytest.approx(np.ones(10), abs=0.2)


def test_growing_stiffness_is_seen_and_measured() -> None:
    fit = fit_kd(grown_motion(0.05, 0.02, 1), M)
    found = fit.frequency
    truth = np.array(
        [
            np.mean(1.0 + 0.05 * np.log(FREQ[(low <= FREQ) & (high >= FREQ)] / 2000.0))
            for low, high in zip(found.low_hz, found.high_hz, strict=True)
        ]
    )
    assert found.stiffness / found.stiffness.mean() == pytest.approx(truth / truth.mean(), abs=0.02)
    assert np.all(np.diff(found.stiffness) > 0.0)
    notice = next(one for one in fit.notices if one.code == "frequency_dependent")
    assert "K by factors of" in notice.text
    assert found.lines.sum() == 200


def test_a_noisy_band_does_not_move_the_others() -> None:
    """The last fifth of the lines is 100 times noisier: its own factor is unknown, the others stay."""
    motion, exact = paper_motion(0.005, 4), paper_motion(0.005, None)
    louder = np.where(np.arange(len(FREQ)) >= 160, 100.0, 1.0)
    q = exact.q + (motion.q - exact.q) * louder[:, None]
    noisy = replace(motion, q=q, covariance=motion.covariance * (louder**2)[:, None, None])
    before, found = (fit_kd(one, M).frequency for one in (motion, noisy))
    assert found.stiffness_sd[4] > 10.0 * before.stiffness_sd[4]
    assert np.all(found.stiffness_sd[:4] < 3.0 * before.stiffness_sd[:4])
    assert np.all(np.abs(found.stiffness[:4] - 1.0) < 4.0 * found.stiffness_sd[:4])


@pytest.mark.parametrize(
    ("p_value", "words"), [(0.5, "holds"), (0.02, "may not hold"), (1e-4, "does NOT hold")]
)
def test_what_is_said_of_one_pair_of_matrices(p_value: float, words: str) -> None:
    found = fit_kd(paper_motion(0.03, 0), M).frequency
    assert replace(found, p_value=p_value).verdict == words


def test_constant_matrices_bring_no_warning() -> None:
    fit = fit_kd(paper_motion(0.02, 4), M)
    assert all(one.code != "frequency_dependent" for one in fit.notices)


def test_the_uncertainty_of_the_mass_matrix_belongs_to_the_factors() -> None:
    """With M drawn from its stated covariance the factors' false alarms stay as stated."""
    parameters = six_dof_parameters()
    covariance = np.zeros((10, 10))
    covariance[1:4, 1:4] = np.eye(3) * (3.2e-6 * 30e-6) ** 2
    rng = np.random.default_rng(5)
    places = dof_indices(DOF)
    truth = matrix_from_parameters(parameters)[np.ix_(places, places)]
    stated, bare = [], []
    for seed in range(60):
        motion = _motion_with(truth, seed)
        drawn = parameters.copy()
        drawn[1:4] += rng.standard_normal(3) * 3.2e-6 * 30e-6
        matrix = matrix_from_parameters(drawn)
        mass = MassMatrix("footplate_centre", "footplate", drawn, {"centre": covariance})
        stated.append(fit_kd(motion, mass, KDOptions(inplane="ignore")).frequency.p_value)
        bare.append(fit_kd(motion, matrix, KDOptions(inplane="ignore")).frequency.p_value)
    assert np.mean(np.array(stated) < 0.05) < 0.15
    assert np.mean(np.array(bare) < 0.05) > 0.3


def _motion_with(mass: np.ndarray, seed: int):
    from sample_volumes.shaken_stapes import simulated_motion

    base = driven_base(FREQ, DOF)
    return simulated_motion(
        mass, K, PAPER_DAMPING_CORRECTED, DOF, FREQ, base, 0.005, np.random.default_rng(seed)
    )


def test_few_lines_give_fewer_bands_and_none_gives_none() -> None:
    fit = fit_kd(paper_motion(0.02, 0, lines=24), M)
    assert len(fit.frequency.lines) == 3
    assert fit_kd(paper_motion(0.02, 0), M, KDOptions(bands=0)).frequency is None
    problem = fit.problem
    assert frequency_dependence(problem, problem.lines().select(np.arange(12)), fit.estimate) is None


def test_one_band_is_refused() -> None:
    with pytest.raises(FittingError, match="--bands must be 0, or 2 to 100 parts of the band; got 1"):
        KDOptions(bands=1)


@pytest.mark.parametrize(("lines", "bands", "said"), [(200, 100, "25 parts"), (12, 3, "no parts")])
def test_fewer_bands_than_asked_for_are_told(lines, bands, said):
    (notice,) = fewer_bands(lines, bands)
    assert notice.code == "fewer_bands"
    assert said in notice.text
    assert str(bands) in notice.text


def test_bands_that_can_be_had_are_not_told_of():
    assert fewer_bands(200, 25) == fewer_bands(12, USUAL_BANDS) == fewer_bands(12, 0) == []
