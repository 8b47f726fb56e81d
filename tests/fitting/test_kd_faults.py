"""What dof2kd's one call refuses, by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.fitting.errors import FittingError
from legacy.fitting.estimators import ESTIMATORS, estimator
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.model.laws import LAWS
from legacy.fitting.model.range_checks import check_result
from legacy.fitting.options import KDOptions
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.spatial import DOF_NAMES
from tests.fitting.cases import M, paper_motion, six_dof_mass, six_dof_motion


def test_a_sentence_names_the_estimators_with_a_likelihood() -> None:
    likelihood = [name for name in ESTIMATORS if estimator(name).likelihood]
    with pytest.raises(StapeskitError) as refused:
        KDOptions(estimator="pinv", correct="fluid")
    assert f"is {' or '.join(likelihood)}," in refused.value.faults[0].expected


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"estimator": "tls"}, f"--estimator must be one of {', '.join(ESTIMATORS)}; got tls"),
        ({"robust": "huber"}, "--robust must be one of none, t4; got huber"),
        ({"robust": "t4", "estimator": "pinv"}, "--robust must be none with this --estimator; got t4"),
        (
            {"damping": "dry"},
            f"--damping must be one of {', '.join(LAWS)}, compare; got dry",
        ),
        ({"inplane": "yes"}, "--inplane must be one of auto, load, ignore; got yes"),
        ({"constraint": "no"}, "--constraint must be one of eigenvalues, psd; got no"),
        (
            {"band_hz": (5000.0, 400.0)},
            "--band must be two frequencies in Hz, the lower first; got 5000.0,400.0",
        ),
        ({"exclude_hz": [(60.0, 50.0)]}, "--exclude must be a range of two frequencies"),
        (
            {"lower": {"K11": 1.0}},
            "--lower and --upper must be left out unless --estimator takes bounds; got ml",
        ),
        (
            {"constraint": "psd", "estimator": "pinv"},
            "--constraint must be left out unless --estimator takes bounds; got pinv",
        ),
        ({"lower": {"K44": 1.0}, "estimator": "constrained"}, "--lower must be an entry out of K11, K12"),
        (
            {"lower": {"K11": 5.0}, "upper": {"K11": 4.0}, "estimator": "constrained"},
            "--lower K11 must be below 4; got 5",
        ),
        ({"upper": {"K11": -5.0}, "estimator": "constrained"}, "--upper K11 must be positive; got -5"),
        (
            {"lower": {"D12": float("nan")}, "estimator": "constrained"},
            "--lower must be an entry and a number in SI",
        ),
        ({"dof": ("y", "y")}, "--dof must be all, or a list of different names out of x, y, z, alpha"),
        ({"bands": 1}, "--bands must be 0, or 2 to 100 parts of the band; got 1"),
    ],
)
def test_wrong_choices_are_refused(options: dict, message: str) -> None:
    with pytest.raises(FittingError) as fault:
        KDOptions(**options)
    assert message in str(fault.value)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(2), "the mass matrix must be 3 x 3 for --dof y,alpha,gamma, or 6 x 6; got 2 x 2"),
        (np.full((3, 3), np.nan), "the mass matrix must be finite numbers"),
        (np.diag([1.0, -1.0, 1.0]), "the diagonal of the mass matrix must be positive; got -1"),
        (np.eye(3) + np.diag([0.1, 0.0], 1), "the mass matrix must be symmetric"),
        (np.ones((3, 3)), "the mass matrix must be positive definite"),
    ],
)
def test_wrong_mass_is_refused(matrix: np.ndarray, message: str) -> None:
    with pytest.raises(FittingError) as fault:
        fit_kd(paper_motion(), matrix)
    assert message in str(fault.value)


def test_mass_about_another_point_is_refused() -> None:
    mass = six_dof_mass().moved(np.eye(3), np.zeros(3), "centre_of_mass", "footplate")
    with pytest.raises(
        FittingError, match="must be about footplate_centre in footplate axes; got about centre"
    ):
        fit_kd(paper_motion(), mass)


def test_missing_body_or_motion_is_refused() -> None:
    motion = paper_motion()
    with pytest.raises(StapeskitError, match="the body must be one of stapes, base; got incus"):
        fit_kd(motion, M, KDOptions(structure="incus"))
    with pytest.raises(StapeskitError, match="Name one with --base"):
        fit_kd(motion, M, KDOptions(base="bone"))
    with pytest.raises(FittingError, match="two different bodies"):
        fit_kd(motion, M, KDOptions(base="stapes"))
    with pytest.raises(FittingError, match="--dof must be degrees of freedom that were measured"):
        fit_kd(motion, six_dof_mass(), KDOptions(dof=("x", "y")))
    with pytest.raises(FittingError, match="the motion's axes must be footplate; got plate"):
        fit_kd(replace(motion, axes="plate"), M)


def test_too_few_lines_are_refused() -> None:
    motion = paper_motion()
    with pytest.raises(
        FittingError, match="the band must be one with measured lines of both bodies; got none"
    ):
        fit_kd(motion, M, KDOptions(band_hz=(10.0, 20.0)))
    with pytest.raises(FittingError, match="at least 12 equations at 2 or more frequencies for 12 unknowns"):
        fit_kd(motion, M, KDOptions(band_hz=(400.0, 410.0)))
    empty = replace(motion, q=np.full_like(motion.q, np.nan))
    with pytest.raises(FittingError, match="200 lines have missing values"):
        fit_kd(empty, M)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_impossible_variances_are_refused(value: float) -> None:
    motion = paper_motion()
    covariance = motion.covariance.copy()
    covariance[0, 0, 3, 1, 1] = value
    with pytest.raises(
        FittingError, match="the noise variances of structure alpha must be positive at every"
    ):
        fit_kd(replace(motion, covariance=covariance), M)


def test_every_fault_is_one_of_the_users() -> None:
    assert issubclass(FittingError, StapeskitError)


@pytest.mark.parametrize("plain", ["M.csv", "bounds"])
def test_dof_in_another_order_is_refused_where_entries_are_counted_by_it(plain, tmp_path) -> None:
    """A matrix written in the order that was given would be read in the fixed one."""
    from legacy.fitting.cli import work

    arguments = ["dof.csv", "--mass", str(tmp_path / ("M.csv" if plain == "M.csv" else "mass.json"))]
    arguments += ["--dof", "y,gamma,alpha"]
    if plain == "bounds":
        arguments += ["--estimator", "constrained", "--lower", "K22=1"]
    with pytest.raises(StapeskitError, match="--dof must be in the order"):
        work(arguments)


def test_as_many_equations_as_unknowns_give_an_answer_that_says_what_it_is_worth() -> None:
    fit = fit_kd(paper_motion(lines=2), M)
    assert "weak_identifiability" in {notice.code for notice in fit.notices}
    assert fit.n_dof == 0


def test_one_direction_for_six_degrees_of_freedom_is_answered_with_what_is_not_known() -> None:
    fit = fit_kd(six_dof_motion(0.05, 1, "y"), six_dof_mass(), KDOptions(dof=DOF_NAMES, inplane="ignore"))
    assert "weak_identifiability" in {notice.code for notice in fit.notices}


def test_a_line_far_beyond_the_others_is_named() -> None:
    motion = six_dof_motion(0.01, 1, lines=30)
    q = motion.q.copy()
    body = motion.bodies.index("stapes")
    q[0, body, 12, DOF_NAMES.index("y")] = 1e5
    with pytest.raises(FittingError) as caught:
        fit_kd(replace(motion, q=q), M)
    told = str(caught.value)
    assert told.startswith("the structure's y must be of a size like at the other lines")
    assert f"got 100000 m ({motion.freq_hz[12]:.6g} Hz). Correct this line" in told.replace("1e+05", "100000")


@pytest.mark.parametrize("factor", [1e289, 1e-40])
def test_masses_of_no_body_are_refused(factor: float) -> None:
    motion = paper_motion()
    with pytest.raises(FittingError, match="the diagonal of the mass matrix must be within 1e-30 and 1e"):
        fit_kd(motion, M * factor)


def test_equations_without_a_finite_solution_are_told(monkeypatch) -> None:
    def never(*_given: object) -> None:
        raise np.linalg.LinAlgError("SVD did not converge")

    monkeypatch.setattr("legacy.fitting.fit_kd.choose_inplane_load", never)
    with pytest.raises(FittingError, match="got equations without a finite solution"):
        fit_kd(paper_motion(), M)


def test_variances_below_zero_are_no_result() -> None:
    good = np.eye(2)
    check_result(good, -good, good, good)
    for spoiled in (np.diag([1.0, -1.0]), np.diag([1.0, np.nan])):
        with pytest.raises(FittingError, match="of sizes from which stiffness and damping follow"):
            check_result(good, good, spoiled, good)
