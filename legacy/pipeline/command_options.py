"""The options of the command ``scan2kd``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from legacy.pipeline.cohort.exports import EXPORTS
from legacy.pipeline.runners import RUNNERS
from legacy.stapeskit.option_declaration import option
from legacy.stapeskit.option_kinds import FLAG, FOLDER, NAMES, TEXT, at_least, files, several, summaries
from legacy.stapeskit.option_rules import Rule
from legacy.stapeskit.options import OptionTable


@dataclass(frozen=True)
class StudyOptions(OptionTable):
    """The options of ``scan2kd``."""

    title = "scan2kd"
    rules = (
        Rule(
            lambda v: not v.studies and not v.template and not v.bids,
            "scan2kd",
            "given a study file",
            "none",
            "scan2kd --template prints one to start from",
        ),
        Rule(
            lambda v: len(set(v.studies)) < len(v.studies),
            "the study files",
            "all different",
            "one of them twice",
            "Name each once",
        ),
        Rule(
            lambda v: (
                len(v.studies) == 1
                and not v.bids
                and (v.scheduler or v.covariates or v.laws or v.mix or v.export)
            ),
            "scan2kd",
            "given several study files with {scheduler}, {covariates}, {laws}, {mix} or {export}",
            "one study file",
            "These options are of cohorts",
        ),
    )

    studies: tuple[Path, ...] = option(
        files("TOML file", "scan2kd --template prints one to start from"),
        "one study file per ear",
        (),
        positional=True,
        metavar="STUDY.toml",
    )
    template: bool = option(FLAG, "print a commented study file and leave", False)
    out: Path | None = option(
        FOLDER,
        "default <study name>_out for one study; cohort_out, with a subfolder each, for several",
        example="cohort",
    )
    bids: Path | None = option(
        FOLDER,
        "a folder of ears in the manner of BIDS: study files are copied there with all their files and run "
        "there; without study files, all ears of the folder are run; results are in derivatives/stapeskit",
        example="ears_bids",
    )
    jobs: int = option(at_least(1), "studies that run at a time on this machine", 1)
    scheduler: str | None = option(
        TEXT,
        f"address of {' or '.join(entry.summary for entry in RUNNERS.values() if entry.schemes)}; "
        "what runs there shares the storage with this machine",
        metavar="ADDRESS",
        example="tcp://10.0.0.1:8786",
    )
    covariates: tuple[str, ...] = option(
        NAMES,
        "of a cohort: what [study] states of the ears that laws are adjusted for",
        (),
        example=["age", "sex"],
    )
    laws: tuple[str, ...] = option(
        NAMES,
        "of a cohort: its planned laws, at most six, as RESPONSE~PREDICTOR; all others are exploratory",
        (),
        example=["K11~mass", "K11~gap"],
    )
    mix: bool = option(FLAG, "of a cohort: allow ears that were fitted or prepared in different ways", False)
    export: tuple[str, ...] = option(
        several(*EXPORTS),
        f"of a cohort: {summaries(EXPORTS)}",
        (),
        example=["xlsx", "svg"],
    )
    force: bool = option(
        FLAG,
        "make every stage anew; replace files at the names of outputs that scan2kd did not write, or that "
        "were edited",
        False,
    )
