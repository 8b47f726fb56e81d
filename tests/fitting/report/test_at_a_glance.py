"""The first table says whether to believe K and D, and calls undetermined what its deviation exceeds."""

from __future__ import annotations

from dataclasses import replace

import pytest

from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.options import KDOptions
from legacy.fitting.report.at_a_glance import summary_rows
from legacy.stapeskit.warnings import Notice
from tests.fitting.cases import M, paper_motion


@pytest.fixture(scope="module")
def fit() -> KDFit:
    return fit_kd(paper_motion(0.01, 0, 40), M, KDOptions(bands=0))


@pytest.mark.parametrize(
    ("codes", "said"),
    [
        ((), "yes"),
        (("lines_dropped",), "yes"),
        (("lines_dropped", "cause_found", "misfit"), "check: cause_found, misfit"),
        (("misfit", "not_converged"), "do not use: not_converged"),
    ],
)
def test_belief_follows_from_the_verdicts_of_the_warnings(
    fit: KDFit, codes: tuple[str, ...], said: str
) -> None:
    rows = summary_rows(replace(fit, notices=tuple(Notice(code, "text") for code in codes)))
    assert rows[0][0] == "believe K and D?"
    assert rows[0][1].startswith(said)


def test_a_value_below_its_standard_deviation_is_undetermined(fit: KDFit) -> None:
    rows = dict(summary_rows(fit))
    assert not any("undetermined" in text for text in rows.values())
    covariance = fit.covariance.copy()
    covariance[3, 3] = (2.0 * fit.stiffness[1, 1]) ** 2
    rows = dict(summary_rows(replace(fit, covariance=covariance)))
    assert rows["K(alpha)"].startswith("undetermined")
    assert rows["believe K and D?"] == "do not use: K(alpha) undetermined"
    assert not rows["K(y)"].startswith("undetermined")


def test_an_undetermined_damping_is_to_be_checked(fit: KDFit) -> None:
    covariance = fit.covariance.copy()
    covariance[9, 9] = (2.0 * fit.damping[1, 1]) ** 2
    rows = dict(summary_rows(replace(fit, covariance=covariance, notices=())))
    assert rows["believe K and D?"] == "check: D(alpha) undetermined"
