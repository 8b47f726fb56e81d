"""Check a study before the long work on its scan begins."""

from __future__ import annotations

from legacy.pipeline.errors import PipelineError
from legacy.pipeline.stages import measurement_of
from legacy.pipeline.study import Study, words
from legacy.pipeline.workspace import Workspace
from legacy.stapeskit.faults import Fault, StapeskitError, raise_all, translate_option_names


def check_inputs(study: Study, work: Workspace) -> None:
    """Check the options of a study, and read the vibrometer's files, which the motion then uses.

    Raises
    ------
    PipelineError
        Every fault of the options and of the vibrometer's files.
    """
    try:
        with translate_option_names(words("ldv")):
            _check_measurement(study, work)
    except StapeskitError as error:
        raise PipelineError(*error.faults) from error


def _check_measurement(study: Study, work: Workspace) -> None:
    bodies = [body.body for body in measurement_of(study, work).measurement.bodies]
    file = ", ".join(path.name for path in study.ldv.files)
    faults = [
        Fault(
            f"the body {name}",
            f"among those of the vibrometer table, {', '.join(bodies)}",
            "no row of it",
            file,
            f"Name the bodies with {key}",
        )
        for key, name in (("fit.structure", study.fit.structure), ("fit.base", study.fit.base))
        if name not in bodies
    ]
    wanted = [name for name in study.fit.dof if name not in study.ldv.dof]
    if wanted:
        faults.append(
            Fault("fit.dof", f"among ldv.dof, {', '.join(study.ldv.dof)}", ", ".join(wanted), "study")
        )
    raise_all(PipelineError, faults)
