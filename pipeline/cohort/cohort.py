"""A cohort: finished studies, the laws over them, and what they predict for a further ear."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.cohort.compatible import cohort_faults, reasons_to_exclude, shared_scans
from pipeline.cohort.components import Components
from pipeline.cohort.ears import Ear, read_ears, unique_names
from pipeline.cohort.law import PowerLaw
from pipeline.cohort.laws import LEAST_EARS, components_of, fit_laws, unlike_others, unresolved
from pipeline.cohort.logs import LogTable, full_name, log_table
from pipeline.cohort.predict import Prediction, Predictor
from pipeline.command_options import CohortOptions
from stapeskit.faults import StapeskitError, raise_all
from stapeskit.options import with_options
from stapeskit.records.mass_file import read_mass
from stapeskit.results import Result
from stapeskit.warnings import Notice, once

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from pipeline.run import StudyResult

SCHEMA = "stapeskit.cohort/1"


@dataclass(frozen=True, repr=False)
class Cohort(Result):
    """Laws over many ears."""

    ears: tuple[Ear, ...]  # all finished ones
    excluded: tuple[tuple[str, str], ...]  # name and reason of each ear that enters no law
    table: LogTable | None = None  # none when there are too few ears for laws
    laws: tuple[PowerLaw, ...] = ()
    components: Components | None = None
    notices: tuple[Notice, ...] = ()
    _predictors: dict[tuple[str, str], Predictor] = field(default_factory=dict, compare=False)

    @property
    def title(self) -> str:
        """What this is."""
        return f"Cohort of {len(self.ears)} ears, {len(self.laws)} laws"

    @property
    def primary(self) -> list[PowerLaw]:
        """The planned laws."""
        return [law for law in self.laws if law.family == "primary"]

    def summary(self) -> Sequence[tuple[str, str]]:
        """Return the exponents of the planned laws and the number of independent parameters."""
        rows = []
        for planned in self.primary:
            low, high = planned.interval
            text = f"exponent {planned.exponent:.2f} (95 % {low:.2f} to {high:.2f})"
            name = f"{planned.response} ~ {planned.predictor}"
            rows.append((name, f"{text}, p = {planned.p_value:.2g}"))
        if self.components is not None:
            ends = "{} to {}".format(*self.components.interval)
            rows.append(("independent parameters", f"{self.components.estimate} (95 % {ends})"))
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

    def law(self, response: str, predictor: str) -> PowerLaw:
        """Return a law, by whole names or their beginnings: ``law("K11", "mass")``.

        Raises
        ------
        StapeskitError
            There is no such law.
        """

        names = {name for law in self.laws for name in (law.response, law.predictor)}
        try:
            wanted = full_name(response, names), full_name(predictor, names)
            return next(law for law in self.laws if (law.response, law.predictor) == wanted)
        except (KeyError, StopIteration):
            known = ", ".join(sorted(f"{law.response} ~ {law.predictor}" for law in self.laws)) or "none"
            given = f"{response} ~ {predictor}"
            raise StapeskitError.of("the law", f"one of {known}", given) from None

    def predict(
        self, mass: object, response: str = "K11", predictor: str = "mass",
        about: Mapping[str, Any] | None = None,
    ) -> Prediction:  # fmt: skip
        """Predict a response of an ear from its CT alone.

        Parameters
        ----------
        mass : result of ct2mass or scan2kd, path or mapping
            A path leads to mass.json or to the folder that holds it; a mapping is its content.
        about : mapping, optional
            What is known of the ear: its ``scanner``, whose error of the voxel size it may share.

        Raises
        ------
        StapeskitError
            There is no such law, or the scan lacks the predictor.
        """
        law, table = self.law(response, predictor), self.table
        content = _mass_content(mass)
        side = content["frames"].get("side") or ""
        # no folder of the cohort: an error that is named after its ear is one of this ear alone
        ear = replace(self.ears[0], folder="", mass=content, about=about or {}, side=side)
        alone = log_table([ear])
        if law.predictor not in alone.predictors:
            raise StapeskitError.of(law.predictor, "in mass.json", "none")
        column = alone.column(law.predictor)
        # What the ear shares with the cohort is in its law; what it shares with none of it is its own error.
        foreign = [
            k for k, source in enumerate(alone.sources) if table is None or source not in table.sources
        ]
        variance = alone.own[0, column, column] + np.sum(alone.shared[0, column, foreign] ** 2)
        x = float(alone.values[0, column])
        return self.predictor(law).predict(x, float(variance), law.pairs.shared_variance)

    def predictor(self, law: PowerLaw) -> Predictor:
        """Return the predictive distribution of a law, computed once."""
        key = (law.response, law.predictor)
        if key not in self._predictors:
            self._predictors[key] = Predictor(law.pairs)
        return self._predictors[key]

    def as_json(self, provenance: Mapping[str, Any]) -> dict[str, Any]:
        """Return the content of cohort.json."""
        count = self.components
        known = None if count is None else {"estimate": count.estimate, "interval_95": list(count.interval)}
        return {
            "schema": SCHEMA,
            "ears": [ear.name for ear in self.ears],
            "excluded": [{"ear": name, "reason": reason} for name, reason in self.excluded],
            "laws": [law.as_json() for law in self.laws],
            "independent_parameters": known,
            "shared_errors": [] if self.table is None else list(self.table.sources),
            "warnings": [notice.as_json() for notice in self.notices],
            "provenance": dict(provenance),
        }


@with_options(CohortOptions)
def cohort(
    studies: Sequence[str | os.PathLike[str] | StudyResult] | str | os.PathLike[str] | StudyResult,
    *,
    about: Mapping[str, Mapping[str, Any]] | None = None,
    **options: Any,
) -> Cohort:
    """Fit laws over finished studies: how K and D follow the inertia and the size of the stapes.

    Parameters
    ----------
    studies : sequence of path or StudyResult
        Folders of finished studies (mass.json, kd.json), or results of `scan2kd`; one alone serves, too.
    about : mapping, optional
        What is known of ears, by the names of their folders: subject, side, age, sex, group, scanner, cochlea
        ... A result of `scan2kd` brings what its study states.

    Raises
    ------
    StapeskitError
        A folder holds no finished study, an option is unknown, or what `cohort_of` refuses.

    Examples
    --------
    >>> ears = cohort(["ear1_out", "ear2_out", "ear3_out", "ear4_out", "ear5_out"])  # doctest: +SKIP
    >>> ears.law("K11", "mass").interval  # doctest: +SKIP
    """
    from pipeline.run import StudyResult

    chosen, sources = CohortOptions.of(**options), []
    for study in [studies] if isinstance(studies, str | os.PathLike | StudyResult) else studies:
        if isinstance(study, str | os.PathLike):
            folder, name, known = Path(study), Path(study).name, dict[str, Any]()
        elif isinstance(study, StudyResult):
            folder, name, known = study.out, study.name, study.about
        else:
            expected = "the folder of a finished study, or a result of scan2kd"
            raise StapeskitError.of("an ear of a cohort", expected, type(study).__name__)
        sources.append((folder, name, {**known, **(about or {}).get(folder.name, {})}))
    return cohort_of(read_ears(sources), **vars(chosen))


def cohort_of(
    ears: Sequence[Ear],
    failed: Mapping[str, str] | None = None,
    *,
    use_all: bool = False,
    laws: Sequence[str] = (),
) -> Cohort:
    """Fit every law of a response on a predictor that the ears allow.

    Parameters
    ----------
    failed : mapping of str to str, optional
        Studies without a result, and why.
    use_all : bool
        Let ears enter the laws whose verdict is "do not use".
    laws : sequence of str
        The planned laws, at most six, as ``"K11~mass"``; all others are exploratory.

    Raises
    ------
    StapeskitError
        The ears do not belong together, or a planned law is unknown.
    """
    raise_all(cohort_faults(ears))
    reasons = reasons_to_exclude(ears, use_all)
    names = dict(zip((ear.folder for ear in ears), unique_names(ears), strict=True))
    excluded = (*(failed or {}).items(), *((names[folder], why) for folder, why in reasons.items()))
    notices = shared_scans(ears)
    for why in dict.fromkeys(reasons.values()):
        alike = [names[folder] for folder, reason in reasons.items() if reason == why]
        notices.append(Notice("ear_excluded", f"Not in any law: {', '.join(alike)} ({why})."))
    used = [ear for ear in ears if ear.folder not in reasons]
    if len(used) < LEAST_EARS:
        text = f"Laws need at least {LEAST_EARS} ears; there are {len(used)}. The ears are only listed."
        notices.append(Notice("laws_left_open", text))
        return Cohort(tuple(ears), excluded, notices=tuple(notices))
    table = log_table(used)
    fitted = fit_laws(table, laws)
    own = [names[ear.folder] for ear in used]
    notices += [*table.notices, *unresolved(fitted), *unlike_others(fitted, table, own)]
    return Cohort(tuple(ears), excluded, table, fitted, components_of(table), once(notices))


def _mass_content(source: Any) -> Mapping[str, Any]:
    """Return the content of mass.json out of whatever holds it."""
    if isinstance(source, Mapping):
        return source
    if isinstance(source, str | os.PathLike) and Path(source).is_dir():
        source = Path(source) / "mass.json"
    return read_mass(getattr(source, "measured", source)).raw
