"""Fit every law of a response on a predictor that the ears of a cohort allow; which of them were planned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from pipeline.cohort.components import Components, independent_parameters
from pipeline.cohort.law import PowerLaw, fit_law
from pipeline.cohort.logs import LogTable, full_name
from pipeline.cohort.predict import left_out
from stapeskit.faults import Fault, raise_all
from stapeskit.warnings import Notice

PRIMARY = (
    *(("K11", "mass_kg"), ("K22", "mass_kg"), ("K33", "mass_kg"), ("D11", "mass_kg")),
    *(("K11", "footplate_length_m"), ("K11", "gap_m")),
)
"""Planned before any data: what a ligament of one material and one shape would follow."""
# More planned laws would cost the family its power.
_MOST_PLANNED = 6
_UNLIKE_P = 0.01  # probability that any ear of a cohort is called unlike the others by chance
LEAST_EARS = 5
"""A law has four unknowns besides the mean of x: with five ears one degree of freedom more than none."""


def fit_laws(table: LogTable, planned: Sequence[str] = ()) -> tuple[PowerLaw, ...]:
    """Fit all laws: the planned family first, each with its false discovery rates (Benjamini, Hochberg 1995).

    Parameters
    ----------
    planned : sequence of str
        As ``"K11~mass"``; `PRIMARY` when left out.

    Raises
    ------
    StapeskitError
        A planned law is unknown, or they are too many.
    """
    from scipy.stats import false_discovery_control

    wanted = planned_laws(table.responses, table.predictors, planned)
    fitted = [_fitted(table, *names, names in wanted) for names in product(table.responses, table.predictors)]
    laws = list[PowerLaw]()
    for family in ("primary", "exploratory"):
        members = [law for law in fitted if law is not None and law.family == family]
        rates = false_discovery_control([min(law.p_value, 1.0) for law in members]) if members else []
        laws += [replace(law, q_value=float(rate)) for law, rate in zip(members, rates, strict=True)]
    return tuple(laws)


def planned_laws(
    responses: Sequence[str], predictors: Sequence[str], planned: Sequence[str]
) -> set[tuple[str, str]]:
    """Return the planned laws by full names; those of the default that the ears lack are left out.

    Raises
    ------
    StapeskitError
        A planned law is unknown, or they are too many.
    """
    names = [tuple(part.strip() for part in text.partition("~")[::2]) for text in planned]
    faults, family = list[Fault](), set[tuple[str, str]]()
    if len(set(names)) > _MOST_PLANNED:
        step = "The others are fitted as exploratory laws"
        faults.append(Fault("--laws", f"at most {_MOST_PLANNED} laws", len(set(names)), "", step))
    for response, predictor in names or PRIMARY:
        try:
            family.add((full_name(response, responses), full_name(predictor, predictors)))
        except KeyError as name:
            known = f"responses {', '.join(responses)}, predictors {', '.join(predictors)}"
            if names:
                faults.append(Fault("--laws", f"RESPONSE~PREDICTOR out of {known}", name.args[0]))
    raise_all(faults)
    return family


def _fitted(table: LogTable, response: str, predictor: str, planned: bool) -> PowerLaw | None:
    """Fit one law; None where too few ears have both quantities or the predictor is the same in all."""
    pairs = table.pairs(response, predictor)
    if pairs.n < LEAST_EARS:
        return None
    if min(float(np.ptp(pairs.x)), float(np.ptp(pairs.y))) < 1e-9:
        return None
    law, profile = fit_law(pairs)
    errors, p_values = left_out(pairs, profile)
    return replace(
        law,
        response=response,
        predictor=predictor,
        family="primary" if planned else "exploratory",
        left_out=errors,
        left_out_p=p_values,
    )


def components_of(table: LogTable) -> Components | None:
    """Count the independent parameters among the responses of the ears that have all of them."""
    columns = [table.column(name) for name in table.entries]
    keep = np.all(np.isfinite(table.values[:, columns]), axis=1)
    values = table.values[keep][:, columns]
    if len(values) < LEAST_EARS or float(np.min(np.ptp(values, axis=0))) < 1e-9:
        return None
    return independent_parameters(values, table.own[keep][:, columns][:, :, columns])


def unresolved(laws: Sequence[PowerLaw]) -> list[Notice]:
    """Return a warning about planned laws that the data cannot settle."""
    names = [f"{law.response} ~ {law.predictor}" for law in laws if law.family == "primary" and law.unbounded]
    text = (
        f"The exponents of {', '.join(names)} are unbounded: the spread of the predictor over these ears is "
        "not surely larger than its error."
    )
    return [Notice("laws_left_open", text)] if names else []


def unlike_others(laws: Sequence[PowerLaw], table: LogTable, names: Sequence[str]) -> list[Notice]:
    """Return a warning about ears that follow no planned law of the other ears."""
    planned, found = [law for law in laws if law.family == "primary"], dict[str, str]()
    for law in planned:
        ears = np.flatnonzero(np.isfinite(table.values[:, table.columns(law.response, law.predictor)]).all(1))
        for ear, error, p in zip(ears.tolist(), law.left_out, law.left_out_p, strict=True):
            if p * law.n * len(planned) < _UNLIKE_P:
                text = (
                    f"{law.response} is {np.exp(error):.2g} times what {law.predictor} of the others predicts"
                )
                found.setdefault(names[ear], text)
    listed = "; ".join(f"{name} ({text})" for name, text in found.items())
    text = f"Unlike the other ears: {listed}. The laws hold them still."
    return [Notice("ear_unlike_others", text)] if found else []
