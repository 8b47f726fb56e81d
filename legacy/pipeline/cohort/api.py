"""`stapeskit.cohort`: laws over finished studies as a function."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legacy.pipeline.cohort.cohort_laws import CohortLaws
from legacy.pipeline.cohort.ear_description import about_of
from legacy.stapeskit.results import Result, extend_result

if TYPE_CHECKING:
    from legacy.pipeline.results import StudyResult


@dataclass(frozen=True, repr=False)
class Cohort(CohortLaws, Result):
    """Laws over many ears that print, draw and write themselves."""

    @property
    def title(self) -> str:
        """What this is."""
        return f"Cohort of {len(self.ears)} ears, {len(self.laws)} laws"

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
        return rows

    def plot(self) -> Any:
        """Draw the planned laws with their bands."""
        from legacy.pipeline.cohort.law_figures import laws_figure

        return laws_figure(self)

    def write(
        self, folder: Path | str, *, force: bool = False, export: Sequence[str] = ()
    ) -> tuple[Path, ...]:
        """Write cohort.csv, cohort.html, cohort.json and exports into a folder.

        Parameters
        ----------
        force : bool
            Replace files that are not known as written here.
        export : sequence of str
            Further forms: names of `pipeline.cohort.exports.EXPORTS`.

        Raises
        ------
        StapeskitError
            A file of another origin has the name of an output.
        """
        from legacy.pipeline.cohort.cohort_files import cohort_outputs, write_cohort

        outputs = cohort_outputs(Path(folder), (), force, export)
        outputs.check()
        with outputs.staged() as fresh:
            settings = {"ears": [ear.folder for ear in self.ears]}
            names = write_cohort(fresh, self, settings, exports=export)
        return tuple(outputs.folder / name for name in names)

    def to_frame(self) -> Any:
        """Return the laws as a pandas table."""
        import pandas as pd

        return pd.DataFrame([law.as_json() for law in self.laws])


def cohort(
    studies: Sequence[str | os.PathLike[str] | StudyResult],
    *,
    about: Mapping[str, Mapping[str, Any]] | None = None,
    mix: bool = False,
    covariates: Sequence[str] = (),
    laws: Sequence[str] = (),
) -> Cohort:
    """Fit laws over finished studies: how K and D follow the inertia and the size of the stapes.

    Parameters
    ----------
    studies : sequence of path or StudyResult
        Folders of finished studies (mass.json, kd.json), or results of `scan2kd`.
    about : mapping, optional
        What is known of ears, by the names of their folders: subject, side, age, sex, group, scanner,
        cochlea ... A result of `scan2kd` brings what its study says.
    mix : bool
        Put ears together that were fitted or prepared in different ways.
    covariates : sequence of str
        What is known of the ears, by name, that laws are adjusted for: numbers, or names of groups.
    laws : sequence of str
        The planned laws, at most six, as ``"K11~mass"``; all others are exploratory.

    Raises
    ------
    PipelineError
        A folder holds no finished study, the ears do not belong together, a covariate is missing, or a law
        is unknown.

    Examples
    --------
    >>> ears = cohort(["ear1_out", "ear2_out", "ear3_out", "ear4_out", "ear5_out"])  # doctest: +SKIP
    >>> ears.law("K11", "mass").law.interval  # doctest: +SKIP
    """
    from legacy.pipeline.cohort.cohort_laws import PRIMARY, cohort_laws, planned_law
    from legacy.pipeline.cohort.compare_ears import Ear, read_ear
    from legacy.pipeline.errors import PipelineError
    from legacy.stapeskit.faults import Fault, StapeskitError, raise_all

    ears: list[Ear] = []
    faults: list[Fault] = []
    for study in studies:
        folder, name, known = _place(study)
        try:
            ear = read_ear(folder, name)
        except (OSError, LookupError, ValueError, TypeError, AttributeError, StapeskitError) as fault:
            expected = "a folder with mass.json and kd.json of a finished study"
            faults.append(Fault(str(folder), expected, fault, "", "Run scan2kd on its study first"))
            continue
        ears.append(replace(ear, about={**known, **(about or {}).get(folder.name, {})}))
    raise_all(PipelineError, faults)
    planned = tuple(planned_law(text) for text in laws) or PRIMARY
    return extend_result(Cohort, cohort_laws(ears, mix=mix, covariates=covariates, planned=planned))


def _place(study: str | os.PathLike[str] | StudyResult) -> tuple[Path, str, dict[str, Any]]:
    """Return the folder of a study, its name, and what its study file says of the ear."""
    if isinstance(study, str | os.PathLike):
        return Path(study), Path(study).name, {}
    return study.out, study.name, about_of(study.study.study)
