"""Options of scan2kd and stapeskit that no study file has."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar

from stapeskit.faults import Fault
from stapeskit.option_types import (
    Count,
    CountOrZero,
    Flag,
    Folder,
    Kind,
    ReadFiles,
    Text,
    Words,
    entries,
    text,
)
from stapeskit.options import Opt, Options, Rule

_RUN, _COHORT = "running", "several studies"
Changes = Annotated[
    tuple[str, ...], Kind(lambda value: tuple(map(text, entries(value))), "a change of an ear", "CHANGE")
]


class RunOptions(Options):
    """What is run, and where results go."""

    studies: Annotated[
        ReadFiles | None,
        Opt("study files", positional=True, repeats=True, name="study", example="study.toml"),
    ] = None
    template: Annotated[Flag, Opt("print a study file with every key")] = False
    check: Annotated[Flag, Opt("look at everything cheap, compute nothing")] = False
    out: Annotated[Folder | None, Opt("default <study name>_out; cohort_out for several", _RUN)] = None
    jobs: Annotated[Count, Opt("studies at a time on this machine", _RUN)] = 1
    scheduler: Annotated[Text, Opt("HOST:PORT of a dask scheduler that runs several studies", _RUN)] = ""
    figures: Annotated[
        Folder | None, Opt("folder for every figure of the report as PDF and SVG; one each of several", _RUN)
    ] = None
    force: Annotated[Flag, Opt("repeat every stage; replace files that this command did not write", _RUN)] = (
        False
    )
    as_json: Annotated[Flag, Opt("print the whole result as JSON", _RUN, name="json")] = False
    quiet: Annotated[Flag, Opt("print nothing but errors", _RUN)] = False


class CohortOptions(Options):
    """How several studies run and what is compared."""

    use_all: Annotated[Flag, Opt('let ears enter the laws whose verdict is "do not use"', _COHORT)] = False
    laws: Annotated[Words, Opt("planned laws, at most six: K11~mass,K22~mass", _COHORT)] = ()


class SampleOptions(Options):
    """stapeskit sample."""

    rules: ClassVar[tuple[Rule, ...]] = (
        Rule(lambda v: v.folder is None, Fault("DIR", "given", "nothing", "", "stapeskit sample ear")),
    )

    folder: Annotated[Folder | None, Opt("where the files go", positional=True, name="dir")] = None
    force: Annotated[Flag, Opt("replace files that this command did not write")] = False


class NewOptions(Options):
    """stapeskit new."""

    folder: Annotated[Folder, Opt("folder with the files of an ear", positional=True, name="dir")] = Path()
    yes: Annotated[Flag, Opt("ask nothing")] = False
    force: Annotated[Flag, Opt("replace a study.toml that this command did not write")] = False


class AppOptions(Options):
    """stapeskit app."""

    rules: ClassVar[tuple[Rule, ...]] = (
        Rule(lambda v: v.port > 65535, Fault("--port", "a number up to 65535", "a larger one")),
    )

    folder: Annotated[Folder, Opt("where the page looks for files first", positional=True)] = Path()
    no_browser: Annotated[Flag, Opt("only print the address of the page")] = False
    port: Annotated[CountOrZero, Opt("of the page; 0: any that is free", example=2800)] = 0


class CompareOptions(Options):
    """stapeskit compare."""

    rules: ClassVar[tuple[Rule, ...]] = (
        Rule(
            lambda v: len(v.folders) not in ((1, 2) if v.what_if else (2,)),
            lambda v: Fault("RESULT", "two folders, or one with --what-if", len(v.folders)),
        ),
        Rule(
            lambda v: len(v.folders) == 1 and (v.force or v.out != CompareOptions.out),
            Fault("--out and --force", "given with two results", "one", next_step="Leave them out"),
        ),
    )

    folders: Annotated[
        ReadFiles, Opt("output folders of two studies", positional=True, repeats=True, name="result")
    ] = ()
    what_if: Annotated[
        Changes,
        Opt("a change: K*10, D*2 or mass+5mg@head; once for each", example=["K*10"], repeats=True),
    ] = ()
    out: Annotated[Folder, Opt("folder of the page and the table of two results")] = Path("compare_out")
    force: Annotated[Flag, Opt("replace files that this command did not write")] = False
