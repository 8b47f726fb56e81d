"""The laws of a cohort: which quantities of the ligament follow which of the stapes, and how surely."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from legacy.pipeline.cohort.compare_ears import Ear, labels
from legacy.pipeline.cohort.compatibility import ears_without_sd, faults_of_cohort, shared_scans
from legacy.pipeline.cohort.covariates import covariates_of, stated
from legacy.pipeline.cohort.false_discovery import false_discovery
from legacy.pipeline.cohort.independent_parameters import Components, independent_parameters
from legacy.pipeline.cohort.log_pairs import LogPairs
from legacy.pipeline.cohort.log_table import LogTable, log_table
from legacy.pipeline.cohort.mass_content import mass_content
from legacy.pipeline.cohort.power_law import Law, fit_law
from legacy.pipeline.cohort.prediction import LeftOut, Prediction, Predictor, left_out
from legacy.pipeline.errors import PipelineError
from legacy.stapeskit.arrays import finite_or_none
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.warnings import Notice

SCHEMA = "stapeskit.cohort/1"

# Planned before any data: what a ligament of one material and one shape would follow. All others are
# exploratory.
PRIMARY = (
    ("K11", "mass_kg"),
    ("K22", "mass_kg"),
    ("K33", "mass_kg"),
    ("D11", "mass_kg"),
    ("K11", "footplate_length_m"),
    ("K11", "gap_m"),
)
# The primary family: more planned laws would cost its power.
MOST_PLANNED = 6
# A law has four unknowns besides the mean of x: with five ears one degree of freedom more than none is left.
LEAST_EARS = 5


@dataclass(frozen=True)
class CohortLaw:
    """One law of a cohort.

    Attributes
    ----------
    family : str
        ``primary`` or ``exploratory``.
    q_value : float
        False discovery rate within the family.
    left_out : LeftOut
        What the ears of all other persons say of each ear that has both quantities.
    """

    response: str
    predictor: str
    law: Law
    family: str
    left_out: LeftOut
    q_value: float = float("nan")

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
            "prediction_error_log": finite_or_none(self.left_out.rms),
            "n": law.n,
        }


@dataclass(frozen=True, repr=False)
class CohortLaws:
    """Laws over many ears.

    Attributes
    ----------
    ears : tuple of Ear
        All finished ones.
    excluded : tuple of (str, str)
        Name and reason of each ear that enters no law: its study failed, or it has no standard deviation.
    table : LogTable or None
        None when there are no ears.
    """

    ears: tuple[Ear, ...]
    excluded: tuple[tuple[str, str], ...]
    table: LogTable | None
    laws: tuple[CohortLaw, ...]
    components: Components | None
    notices: tuple[Notice, ...]
    _predictors: dict[tuple[str, str], Predictor] = field(default_factory=dict, repr=False, compare=False)

    @property
    def primary(self) -> list[CohortLaw]:
        """The planned laws."""
        return [law for law in self.laws if law.family == "primary"]

    @property
    def logarithms(self) -> LogTable:
        """The table that laws are fitted on.

        Raises
        ------
        PipelineError
            There are too few ears for laws.
        """
        if self.table is None:
            raise PipelineError.of("the cohort", f"of at least {LEAST_EARS} ears", len(self.ears))
        return self.table

    def pairs(self, law: CohortLaw) -> LogPairs:
        """Return the logarithms of the ears that have both quantities of a law."""
        return self.logarithms.pairs(law.response, law.predictor)[0]

    def law(self, response: str, predictor: str) -> CohortLaw:
        """Return a law, by whole names or their beginnings: ``law("K11", "mass")``.

        Raises
        ------
        PipelineError
            There is no such law.
        """
        if self.table is not None:
            try:
                names = self.table.full_name(response), self.table.full_name(predictor)
            except KeyError:
                names = (response, predictor)
            for law in self.laws:
                if (law.response, law.predictor) == names:
                    return law
        known = ", ".join(sorted({f"{law.response} ~ {law.predictor}" for law in self.laws})) or "none"
        raise PipelineError.of("the law", f"one of {known}", f"{response} ~ {predictor}")

    def predict(
        self,
        mass: object,
        response: str = "K11",
        predictor: str = "mass",
        about: Mapping[str, Any] | None = None,
    ) -> Prediction:
        """Predict a response of an ear from its CT alone.

        Parameters
        ----------
        mass : MassResult, StudyResult, path or mapping
            The result of its scan, its mass.json or the content of it.
        about : mapping, optional
            Covariates of the ear, where the cohort was adjusted for some.

        Raises
        ------
        PipelineError
            There is no such law, or the scan lacks the predictor, or a covariate is missing.
        """
        law = self.law(response, predictor)
        table = self.logarithms
        content = mass_content(mass)
        side = content["frames"].get("side") or ""
        # No folder of the cohort: an error that is named after its ear is one of this ear alone.
        ear = replace(self.ears[0], folder="", mass=content, about=about or {}, side=side)
        alone = log_table([ear])
        try:
            column = alone.column(law.predictor)
        except KeyError:
            raise PipelineError.of(law.predictor, "in mass.json", "none") from None
        # What the ear shares with the cohort is in its law; what it shares with none of it is its own error.
        foreign = [k for k, source in enumerate(alone.sources) if source not in table.sources]
        variance = alone.own[0, column, column] + np.sum(alone.shared[0, column, foreign] ** 2)
        columns = table.covariates.of_ear(stated(ear)) if table.covariates.names else None
        x = float(alone.values[0, column])
        return self.predictor(law).predict(x, float(variance), _shared_variance(self.pairs(law)), columns)

    def tolerance(self, response: str, predictor: str = "mass") -> tuple[float, float]:
        """Return the 95 % range of ln of a response over ears of this population: "is this ear normal".

        It is one of true values, and is wider by the errors that the ears share.
        """
        law = self.law(response, predictor)
        return self.predictor(law).tolerance(_shared_variance(self.pairs(law)))

    def predictor(self, law: CohortLaw) -> Predictor:
        """Return the predictive distribution of a law, computed once."""
        key = (law.response, law.predictor)
        if key not in self._predictors:
            self._predictors[key] = Predictor(self.pairs(law))
        return self._predictors[key]

    def normal_ranges(self) -> dict[str, tuple[float, float]]:
        """Return the 95 % range (SI) of each response over ears of this population, by its planned law."""
        ranges: dict[str, tuple[float, float]] = {}
        for law in self.primary:
            if law.response not in ranges:
                low, high = self.tolerance(law.response, law.predictor)
                ranges[law.response] = (float(np.exp(low)), float(np.exp(high)))
        return ranges

    def as_json(self, provenance: Mapping[str, Any]) -> dict[str, Any]:
        """Return the content of cohort.json."""
        count = self.components
        return {
            "schema": SCHEMA,
            "ears": [ear.name for ear in self.ears],
            "excluded": [{"ear": name, "reason": reason} for name, reason in self.excluded],
            "laws": [law.as_json() for law in self.laws],
            "independent_parameters": None
            if count is None
            else {
                "estimate": count.estimate,
                "interval_95": list(count.interval),
                "sd_log": count.sd.tolist(),
                "loadings_log": count.loadings.tolist(),
            },
            "covariates": [] if self.table is None else list(self.table.covariates.names),
            "normal_ranges_95_si": {name: list(ends) for name, ends in self.normal_ranges().items()},
            "shared_errors": [] if self.table is None else list(self.table.sources),
            "warnings": [notice.as_json() for notice in self.notices],
            "provenance": dict(provenance),
        }


def cohort_laws(
    ears: Sequence[Ear],
    failed: Mapping[str, str] | None = None,
    *,
    mix: bool = False,
    covariates: Sequence[str] = (),
    planned: Sequence[tuple[str, str]] = PRIMARY,
) -> CohortLaws:
    """Fit every law of a response on a predictor that the ears allow.

    Parameters
    ----------
    failed : mapping of str to str, optional
        Studies without a result, and why.
    mix : bool
        Put ears together that were fitted or prepared in different ways.
    covariates : sequence of str
        What [study] states of the ears, by name, that laws are adjusted for.
    planned : sequence of (response, predictor)
        The primary family, at most six laws; names may be shortened (``mass``).

    Raises
    ------
    PipelineError
        The ears do not belong together, a covariate is missing, or a planned law is unknown; all of it in
        one error.
    """
    faults = faults_of_cohort(ears, mix)
    faults += [] if ears else [Fault("the cohort", "of at least one ear", "none")]
    raise_all(PipelineError, faults)
    reasons = ears_without_sd(ears)
    names = dict(zip((ear.folder for ear in ears), labels(ears), strict=True))
    excluded = (*(failed or {}).items(), *((names[folder], why) for folder, why in reasons.items()))
    used = [ear for ear in ears if ear.folder not in reasons]
    notices = shared_scans(ears)
    for why in dict.fromkeys(reasons.values()):
        alike = [names[folder] for folder, reason in reasons.items() if reason == why]
        verb = "enters" if len(alike) == 1 else "enter"
        notices.append(Notice("ear_without_sd", f"{', '.join(alike)} {verb} no law: {why}."))
    if len(used) < LEAST_EARS:
        text = f"Laws need at least {LEAST_EARS} ears; there are {len(used)}. The ears are only listed."
        notices.append(Notice("cohort_too_small", text))
        return CohortLaws(tuple(ears), excluded, None, (), None, tuple(notices))
    table = log_table(used, covariates_of(used, covariates))
    family = primary_family(table, planned)
    laws = [
        _law(table, response, predictor, (response, predictor) in family)
        for response in table.responses
        for predictor in table.predictors
    ]
    fitted = [law for law in laws if law is not None]
    with_q: list[CohortLaw] = []
    for name in ("primary", "exploratory"):
        members = [law for law in fitted if law.family == name]
        q_values = false_discovery(np.array([law.law.p_value for law in members]))
        with_q += [replace(law, q_value=float(q)) for law, q in zip(members, q_values, strict=True)]
    notices += [*table.notices, *_unresolved_notices(with_q)]
    return CohortLaws(tuple(ears), excluded, table, tuple(with_q), _components(table), tuple(notices))


def cohort_laws_or_notice(ears: Sequence[Ear], failed: Mapping[str, str], **choices: Any) -> CohortLaws:
    """Fit every law, or return a cohort without laws and with the reason as its warning."""
    try:
        return cohort_laws(ears, failed, **choices)
    except PipelineError as fault:
        reason = str(fault).replace("\n", " ")
        notice = Notice("cohort_mixed", f"No laws: {reason}")
        return CohortLaws(tuple(ears), tuple(failed.items()), None, (), None, (notice,))


def _shared_variance(pairs: LogPairs) -> float:
    """Return the mean variance of ln y by errors that ears share."""
    return float(np.mean(np.sum(pairs.shared[:, 1] ** 2, axis=1)))


def planned_law(text: str) -> tuple[str, str]:
    """Return response and predictor of a law written as ``K11~mass``."""
    response, _, predictor = text.partition("~")
    return response.strip(), predictor.strip()


def primary_family(table: LogTable, planned: Sequence[tuple[str, str]]) -> set[tuple[str, str]]:
    """Return the planned laws by full names; those of the default that the ears lack are left out."""
    faults, family = list[Fault](), set[tuple[str, str]]()
    if len(set(planned)) > MOST_PLANNED:
        step = "The others are fitted as exploratory laws"
        faults.append(Fault("{laws}", f"at most {MOST_PLANNED} laws", len(set(planned)), "", step))
    for response, predictor in planned:
        try:
            family.add((table.full_name(response), table.full_name(predictor)))
        except KeyError as name:
            if tuple(planned) != PRIMARY:
                known = f"responses {', '.join(table.responses)}, predictors {', '.join(table.predictors)}"
                lost = response[:1] == "D" and not any(each.startswith("D") for each in table.responses)
                step = "D of these ears has no common unit: leave its laws out" if lost else ""
                faults.append(Fault("{laws}", f"RESPONSE~PREDICTOR out of {known}", name.args[0], "", step))
    raise_all(PipelineError, faults)
    return family


def _law(table: LogTable, response: str, predictor: str, planned: bool) -> CohortLaw | None:
    """Fit one law; None where too few ears have both quantities or the predictor is the same in all."""
    pairs, _ = table.pairs(response, predictor)
    if pairs.n < LEAST_EARS or pairs.degrees < LEAST_EARS - 2:
        return None
    if min(float(np.ptp(pairs.x)), float(np.ptp(pairs.y))) < 1e-9 or not pairs.covariates_are_independent():
        return None
    family = "primary" if planned else "exploratory"
    return CohortLaw(response, predictor, fit_law(pairs), family, left_out(pairs))


def _components(table: LogTable) -> Components | None:
    """Count the independent parameters among the responses of the ears that have all of them."""
    columns = [table.column(name) for name in table.entries]
    keep = np.all(np.isfinite(table.values[:, columns]), axis=1)
    if int(keep.sum()) < LEAST_EARS:
        return None
    values = table.values[keep][:, columns]
    own = table.own[keep][:, columns][:, :, columns]
    if float(np.min(np.ptp(values, axis=0))) < 1e-9:
        return None
    return independent_parameters(values, own)


def _unresolved_notices(laws: Sequence[CohortLaw]) -> list[Notice]:
    """Return a warning about planned laws that the data cannot settle."""
    open_laws = [
        f"{cohort_law.response} ~ {cohort_law.predictor}"
        for cohort_law in laws
        if cohort_law.law.unbounded and cohort_law.family == "primary"
    ]
    if not open_laws:
        return []
    text = (
        f"The exponents of {', '.join(open_laws)} are unbounded: the predictor is not resolved, its spread "
        "over these ears is not surely larger than its error."
    )
    return [Notice("predictor_not_resolved", text)]
