"""Fit every law of a response on a predictor that the ears of a cohort allow; which of them were planned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.cohort.components import Components, independent_parameters
from pipeline.cohort.law import Law, fit_law
from pipeline.cohort.logs import LogTable
from pipeline.cohort.predict import left_out
from stapeskit.arrays import Array, finite_or_none
from stapeskit.faults import Fault, raise_all
from stapeskit.warnings import Notice

PRIMARY = (
    *(("K11", "mass_kg"), ("K22", "mass_kg"), ("K33", "mass_kg"), ("D11", "mass_kg")),
    *(("K11", "footplate_length_m"), ("K11", "gap_m")),
)
"""Planned before any data: what a ligament of one material and one shape would follow."""
# More planned laws would cost the family its power.
_MOST_PLANNED = 6
LEAST_EARS = 5
"""A law has four unknowns besides the mean of x: with five ears one degree of freedom more than none."""


@dataclass(frozen=True)
class CohortLaw:
    """One law of a cohort.

    Attributes
    ----------
    family : str
        ``primary`` (planned) or ``exploratory``.
    errors : ndarray, (n,)
        ln of each response less what the ears of all other persons predict; NaN where they are too few.
    q_value : float
        False discovery rate within the family.
    """

    response: str
    predictor: str
    law: Law
    family: str
    errors: Array
    q_value: float = float("nan")

    @property
    def prediction_error(self) -> float:
        """Root mean square of the errors; NaN where there are none."""
        known = self.errors[np.isfinite(self.errors)]
        return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")

    def as_json(self) -> dict[str, Any]:
        """Return the form of cohort.json; open ends of intervals are null."""
        law = self.law
        return {
            "response": self.response,
            "predictor": self.predictor,
            "family": self.family,
            "exponent": law.exponent,
            "exponent_interval_95": [finite_or_none(end) for end in law.interval],
            "unbounded": law.unbounded,
            "p_value": law.p_value,
            "q_value": self.q_value,
            "intercept_log": law.intercept,
            "intrinsic_sd_log": law.sigma,
            "intrinsic_sd_log_interval_95": list(law.sigma_interval),
            "predictor_sd_log": law.tau,
            "reliability": law.reliability,
            "correlation_of_pairs": law.rho,
            "prediction_error_log": finite_or_none(self.prediction_error),
            "n": law.n,
        }


def fit_laws(table: LogTable, planned: Sequence[str] = ()) -> tuple[CohortLaw, ...]:
    """Fit all laws: the planned family first, each family with its false discovery rates.

    Parameters
    ----------
    planned : sequence of str
        As ``"K11~mass"``; `PRIMARY` when left out.

    Raises
    ------
    StapeskitError
        A planned law is unknown, or they are too many.
    """
    family = planned_laws(table, planned)
    fitted = [
        law
        for response in table.responses
        for predictor in table.predictors
        if (law := _fitted(table, response, predictor, (response, predictor) in family)) is not None
    ]
    return tuple(law for name in ("primary", "exploratory") for law in _with_q_values(fitted, name))


def planned_laws(table: LogTable, planned: Sequence[str]) -> set[tuple[str, str]]:
    """Return the planned laws by full names; those of the default that the ears lack are left out."""
    names = [tuple(part.strip() for part in text.partition("~")[::2]) for text in planned]
    faults, family = list[Fault](), set[tuple[str, str]]()
    if len(set(names)) > _MOST_PLANNED:
        step = "The others are fitted as exploratory laws"
        faults.append(Fault("--laws", f"at most {_MOST_PLANNED} laws", len(set(names)), "", step))
    for response, predictor in names or PRIMARY:
        try:
            family.add((table.full_name(response), table.full_name(predictor)))
        except KeyError as name:
            known = f"responses {', '.join(table.responses)}, predictors {', '.join(table.predictors)}"
            if names:
                faults.append(Fault("--laws", f"RESPONSE~PREDICTOR out of {known}", name.args[0]))
    raise_all(faults)
    return family


def _fitted(table: LogTable, response: str, predictor: str, planned: bool) -> CohortLaw | None:
    """Fit one law; None where too few ears have both quantities or the predictor is the same in all."""
    pairs = table.pairs(response, predictor)
    if pairs.n < LEAST_EARS or pairs.degrees < LEAST_EARS - 2 or not pairs.has_independent_covariates():
        return None
    if min(float(np.ptp(pairs.x)), float(np.ptp(pairs.y))) < 1e-9:
        return None
    law, profile = fit_law(pairs)
    family = "primary" if planned else "exploratory"
    return CohortLaw(response, predictor, law, family, left_out(pairs, profile))


def _with_q_values(laws: Sequence[CohortLaw], family: str) -> list[CohortLaw]:
    """Return the laws of a family with their false discovery rates (Benjamini and Hochberg 1995)."""
    from scipy.stats import false_discovery_control

    members = [law for law in laws if law.family == family]
    rates = false_discovery_control([min(law.law.p_value, 1.0) for law in members]) if members else []
    return [replace(law, q_value=float(rate)) for law, rate in zip(members, rates, strict=True)]


def components_of(table: LogTable) -> Components | None:
    """Count the independent parameters among the responses of the ears that have all of them."""
    columns = [table.column(name) for name in table.entries]
    keep = np.all(np.isfinite(table.values[:, columns]), axis=1)
    values = table.values[keep][:, columns]
    if len(values) < LEAST_EARS or float(np.min(np.ptp(values, axis=0))) < 1e-9:
        return None
    return independent_parameters(values, table.own[keep][:, columns][:, :, columns])


def unresolved(laws: Sequence[CohortLaw]) -> list[Notice]:
    """Return a warning about planned laws that the data cannot settle."""
    names = [
        f"{law.response} ~ {law.predictor}" for law in laws if law.family == "primary" and law.law.unbounded
    ]
    text = (
        f"The exponents of {', '.join(names)} are unbounded: the spread of the predictor over these ears is "
        "not surely larger than its error."
    )
    return [Notice("predictor_not_resolved", text)] if names else []
