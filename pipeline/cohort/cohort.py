"""The laws of a cohort: which quantities of the ligament follow which of the stapes, and how surely."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.cohort.compatible import cohort_faults, reasons_to_exclude, shared_scans
from pipeline.cohort.components import Components, independent_parameters
from pipeline.cohort.covariates import covariates_of, described
from pipeline.cohort.ears import Ear, read_ear, unique_names
from pipeline.cohort.law import Law, LogPairs, fit_law
from pipeline.cohort.logs import LogTable, log_table
from pipeline.cohort.predict import Prediction, Predictor, left_out
from stapeskit.arrays import Array, finite_or_none
from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.results import Result
from stapeskit.warnings import Notice, unique

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from pipeline.results import StudyResult

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
# More planned laws would cost the family its power.
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


@dataclass(frozen=True, repr=False)
class Cohort(Result):
    """Laws over many ears.

    Attributes
    ----------
    ears : tuple of Ear
        All finished ones.
    excluded : tuple of (str, str)
        Name and reason of each ear that enters no law.
    table : LogTable or None
        None when there are too few ears for laws.
    """

    ears: tuple[Ear, ...]
    excluded: tuple[tuple[str, str], ...]
    table: LogTable | None
    laws: tuple[CohortLaw, ...]
    components: Components | None
    notices: tuple[Notice, ...]
    _predictors: dict[tuple[str, str], Predictor] = field(default_factory=dict, compare=False)

    @property
    def title(self) -> str:
        """What this is."""
        return f"Cohort of {len(self.ears)} ears, {len(self.laws)} laws"

    @property
    def primary(self) -> list[CohortLaw]:
        """The planned laws."""
        return [law for law in self.laws if law.family == "primary"]

    def summary(self) -> Sequence[tuple[str, str]]:
        """Return the exponents of the planned laws and the number of independent parameters."""
        rows = []
        for planned in self.primary:
            low, high = planned.law.interval
            text = f"exponent {planned.law.exponent:.2f} (95 % {low:.2f} to {high:.2f})"
            text += f", p = {planned.law.p_value:.2g}"
            rows.append((f"{planned.response} ~ {planned.predictor}", text))
        if self.components is not None:
            low_count, high_count = self.components.interval
            text = f"{self.components.estimate} (95 % {low_count} to {high_count})"
            rows.append(("independent parameters", text))
        return rows or [("ears", str(len(self.ears)))]

    def to_frame(self) -> DataFrame:
        """Return the laws, one a row."""
        import pandas as pd

        return pd.DataFrame([law.as_json() for law in self.laws])

    def plot(self) -> Figure:
        """Draw the planned laws with their bands."""
        from pipeline.cohort.page import laws_figure

        return laws_figure(self, self.primary)

    def write(self, folder: Path | str, *, force: bool = False) -> tuple[Path, ...]:
        """Write cohort.csv, cohort.json and cohort.html into a folder.

        Raises
        ------
        StapeskitError
            A file of another origin has the name of an output.
        """
        from pipeline.cohort.page import FILES, write_cohort
        from stapeskit.outputs import Outputs

        outputs = Outputs("cohort", Path(folder), FILES, (), force)
        with outputs.staged() as stage:
            write_cohort(stage, self, {"ears": [ear.folder for ear in self.ears]})
        return tuple(outputs.folder / name for name in FILES)

    def pairs(self, law: CohortLaw) -> LogPairs:
        """Return the logarithms of the ears that have both quantities of a law."""
        return self._logs.pairs(law.response, law.predictor)[0]

    @property
    def _logs(self) -> LogTable:
        if self.table is None:
            raise StapeskitError.of("the cohort", f"of at least {LEAST_EARS} ears", len(self.ears))
        return self.table

    def law(self, response: str, predictor: str) -> CohortLaw:
        """Return a law, by whole names or their beginnings: ``law("K11", "mass")``.

        Raises
        ------
        StapeskitError
            There is no such law.
        """
        names = (response, predictor)
        if self.table is not None:
            try:
                names = self.table.full_name(response), self.table.full_name(predictor)
            except KeyError:
                names = (response, predictor)
        for law in self.laws:
            if (law.response, law.predictor) == names:
                return law
        known = ", ".join(sorted({f"{law.response} ~ {law.predictor}" for law in self.laws})) or "none"
        raise StapeskitError.of("the law", f"one of {known}", f"{response} ~ {predictor}")

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
        mass : result of ct2mass or scan2kd, path or mapping
            A path leads to mass.json or to the folder that holds it; a mapping is its content.
        about : mapping, optional
            Covariates of the ear, where the cohort was adjusted for some.

        Raises
        ------
        StapeskitError
            There is no such law, or the scan lacks the predictor, or a covariate is missing.
        """
        law, table = self.law(response, predictor), self._logs
        content = _mass_content(mass)
        side = content["frames"].get("side") or ""
        # no folder of the cohort: an error that is named after its ear is one of this ear alone
        ear = replace(self.ears[0], folder="", mass=content, about=about or {}, side=side)
        alone = log_table([ear])
        try:
            column = alone.column(law.predictor)
        except KeyError:
            raise StapeskitError.of(law.predictor, "in mass.json", "none") from None
        # What the ear shares with the cohort is in its law; what it shares with none of it is its own error.
        foreign = [k for k, source in enumerate(alone.sources) if source not in table.sources]
        variance = alone.own[0, column, column] + np.sum(alone.shared[0, column, foreign] ** 2)
        columns = table.covariates.of_ear(described(ear)) if table.covariates.names else None
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
        parameters = None
        if count is not None:
            parameters = {
                "estimate": count.estimate,
                "interval_95": list(count.interval),
                "sd_log": count.sd.tolist(),
                "loadings_log": count.loadings.tolist(),
            }
        return {
            "schema": SCHEMA,
            "ears": [ear.name for ear in self.ears],
            "excluded": [{"ear": name, "reason": reason} for name, reason in self.excluded],
            "laws": [law.as_json() for law in self.laws],
            "independent_parameters": parameters,
            "covariates": [] if self.table is None else list(self.table.covariates.names),
            "normal_ranges_95_si": {name: list(ends) for name, ends in self.normal_ranges().items()},
            "shared_errors": [] if self.table is None else list(self.table.sources),
            "warnings": [notice.as_json() for notice in self.notices],
            "provenance": dict(provenance),
        }


def cohort(
    studies: Sequence[str | os.PathLike[str] | StudyResult],
    *,
    about: Mapping[str, Mapping[str, Any]] | None = None,
    mix: bool = False,
    use_all: bool = False,
    covariates: Sequence[str] = (),
    laws: Sequence[str] = (),
) -> Cohort:
    """Fit laws over finished studies: how K and D follow the inertia and the size of the stapes.

    Parameters
    ----------
    studies : sequence of path or StudyResult
        Folders of finished studies (mass.json, kd.json), or results of `scan2kd`.
    about : mapping, optional
        What is known of ears, by the names of their folders: subject, side, age, sex, group, scanner, cochlea
        ... A result of `scan2kd` brings what its study states.
    mix : bool
        Put ears together that were fitted or prepared in different ways.
    use_all : bool
        Let ears enter the laws whose verdict is "do not use".
    covariates : sequence of str
        What is known of the ears, by name, that laws are adjusted for: numbers, or names of groups.
    laws : sequence of str
        The planned laws, at most six, as ``"K11~mass"``; all others are exploratory.

    Raises
    ------
    StapeskitError
        A folder holds no finished study, the ears do not belong together, a covariate is missing, or a law is
        unknown.

    Examples
    --------
    >>> ears = cohort(["ear1_out", "ear2_out", "ear3_out", "ear4_out", "ear5_out"])  # doctest: +SKIP
    >>> ears.law("K11", "mass").law.interval  # doctest: +SKIP
    """
    ears, faults = list[Ear](), list[Fault]()
    for study in studies:
        if isinstance(study, str | os.PathLike):
            folder, name, known = Path(study), Path(study).name, {}
        else:
            folder, name, known = study.out, study.name, study.about
        try:
            ears.append(read_ear(folder, name, {**known, **(about or {}).get(folder.name, {})}))
        except (OSError, LookupError, ValueError, TypeError, AttributeError) as error:
            expected = "a folder with mass.json and kd.json of a finished study"
            faults.append(Fault(str(folder), expected, error, "", "Run scan2kd on its study first"))
    raise_all(faults)
    return cohort_of(ears, mix=mix, use_all=use_all, covariates=covariates, laws=laws)


def cohort_of(
    ears: Sequence[Ear],
    failed: Mapping[str, str] | None = None,
    *,
    mix: bool = False,
    use_all: bool = False,
    covariates: Sequence[str] = (),
    laws: Sequence[str] = (),
) -> Cohort:
    """Fit every law of a response on a predictor that the ears allow; see `cohort`.

    Parameters
    ----------
    failed : mapping of str to str, optional
        Studies without a result, and why.

    Raises
    ------
    StapeskitError
        The ears do not belong together, a covariate is missing, or a planned law is unknown; all of it in one
        error.
    """
    faults = cohort_faults(ears, mix)
    faults += [] if ears else [Fault("the cohort", "of at least one ear", "none")]
    raise_all(faults)
    reasons = reasons_to_exclude(ears, use_all)
    names = dict(zip((ear.folder for ear in ears), unique_names(ears), strict=True))
    excluded = (*(failed or {}).items(), *((names[folder], why) for folder, why in reasons.items()))
    used = [ear for ear in ears if ear.folder not in reasons]
    notices = shared_scans(ears)
    for why in dict.fromkeys(reasons.values()):
        alike = [names[folder] for folder, reason in reasons.items() if reason == why]
        notices.append(Notice("ear_excluded", f"Not in any law: {', '.join(alike)} ({why})."))
    if len(used) < LEAST_EARS:
        text = f"Laws need at least {LEAST_EARS} ears; there are {len(used)}. The ears are only listed."
        notices.append(Notice("cohort_too_small", text))
        return Cohort(tuple(ears), excluded, None, (), None, tuple(notices))
    table = log_table(used, covariates_of(used, covariates))
    family = _primary_family(table, [_split_law(text) for text in laws] or PRIMARY)
    choices = [(response, predictor) for response in table.responses for predictor in table.predictors]
    fitted = [law for names in choices if (law := _fitted(table, *names, names in family)) is not None]
    with_q = [law for name in ("primary", "exploratory") for law in _with_q_values(fitted, name)]
    notices += [*table.notices, *_unresolved(with_q)]
    return Cohort(tuple(ears), excluded, table, tuple(with_q), _components(table), unique(notices))


def _split_law(text: str) -> tuple[str, str]:
    response, _, predictor = text.partition("~")
    return response.strip(), predictor.strip()


def _primary_family(table: LogTable, planned: Sequence[tuple[str, str]]) -> set[tuple[str, str]]:
    """Return the planned laws by full names; those of the default that the ears lack are left out."""
    faults, family = list[Fault](), set[tuple[str, str]]()
    if len(set(planned)) > MOST_PLANNED:
        step = "The others are fitted as exploratory laws"
        faults.append(Fault("--laws", f"at most {MOST_PLANNED} laws", len(set(planned)), "", step))
    for response, predictor in planned:
        try:
            family.add((table.full_name(response), table.full_name(predictor)))
        except KeyError as name:
            if tuple(planned) != PRIMARY:
                known = f"responses {', '.join(table.responses)}, predictors {', '.join(table.predictors)}"
                faults.append(Fault("--laws", f"RESPONSE~PREDICTOR out of {known}", name.args[0]))
    raise_all(faults)
    return family


def _fitted(table: LogTable, response: str, predictor: str, planned: bool) -> CohortLaw | None:
    """Fit one law; None where too few ears have both quantities or the predictor is the same in all."""
    pairs, _ = table.pairs(response, predictor)
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
    if not members:
        return []
    rates = false_discovery_control([min(law.law.p_value, 1.0) for law in members])
    return [replace(law, q_value=float(rate)) for law, rate in zip(members, rates, strict=True)]


def _components(table: LogTable) -> Components | None:
    """Count the independent parameters among the responses of the ears that have all of them."""
    columns = [table.column(name) for name in table.entries]
    keep = np.all(np.isfinite(table.values[:, columns]), axis=1)
    if int(keep.sum()) < LEAST_EARS:
        return None
    values = table.values[keep][:, columns]
    if float(np.min(np.ptp(values, axis=0))) < 1e-9:
        return None
    return independent_parameters(values, table.own[keep][:, columns][:, :, columns])


def _unresolved(laws: Sequence[CohortLaw]) -> list[Notice]:
    """Return a warning about planned laws that the data cannot settle."""
    unbounded = [law for law in laws if law.family == "primary" and law.law.unbounded]
    planned = [f"{law.response} ~ {law.predictor}" for law in unbounded]
    if not planned:
        return []
    text = (
        f"The exponents of {', '.join(planned)} are unbounded: the spread of the predictor over these ears "
        "is not surely larger than its error."
    )
    return [Notice("predictor_not_resolved", text)]


def _shared_variance(pairs: LogPairs) -> float:
    """Return the mean variance of ln y by errors that ears share."""
    return float(np.mean(np.sum(pairs.shared[:, 1] ** 2, axis=1)))


def _mass_content(source: object) -> Mapping[str, Any]:
    """Return the content of mass.json out of whatever holds it."""
    import json

    if isinstance(source, Mapping):
        return source
    if isinstance(source, str | os.PathLike):
        path = Path(source)
        path = path / "mass.json" if path.is_dir() else path
        try:
            content: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            step = "Run ct2mass on the scan first"
            raise StapeskitError.of(str(path), "a mass.json", error, "", step) from error
        return content
    found = getattr(source, "content", None)
    found = found() if callable(found) else getattr(source, "mass", None)
    if isinstance(found, Mapping):
        return found
    expected = "a result of ct2mass or scan2kd, a path or a mapping"
    raise StapeskitError.of("the mass", expected, type(source).__name__)
