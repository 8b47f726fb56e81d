"""Options of scan2kd that no study file has."""

from __future__ import annotations

from typing import Annotated

from stapeskit.option_types import Count, Flag, Folder, ReadFiles, Text, Words
from stapeskit.options import Opt, Options

_RUN, _COHORT = "running", "several studies"


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
    figures: Annotated[Folder | None, Opt("folder for every figure of the report as PDF and SVG", _RUN)] = (
        None
    )
    force: Annotated[Flag, Opt("repeat every stage; replace files that this command did not write", _RUN)] = (
        False
    )
    as_json: Annotated[Flag, Opt("print the whole result as JSON", _RUN, name="json")] = False
    quiet: Annotated[Flag, Opt("print nothing but errors", _RUN)] = False


class CohortOptions(Options):
    """How several studies run and what is compared."""

    mix: Annotated[Flag, Opt("compare ears that were fitted or prepared in different ways", _COHORT)] = False
    use_all: Annotated[Flag, Opt('let ears enter the laws whose verdict is "do not use"', _COHORT)] = False
    covariates: Annotated[Words, Opt("columns of [study] that laws are adjusted for", _COHORT)] = ()
    laws: Annotated[Words, Opt("planned laws, at most six: K11~mass,K22~mass", _COHORT)] = ()
