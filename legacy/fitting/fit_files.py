"""From files to files, as the command dof2kd works: a fit or a plan with its record, page and exports."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from legacy.fitting.calibrated import calibrated
from legacy.fitting.errors import FittingError
from legacy.fitting.export_formats import json_name, output_set
from legacy.fitting.file_chain import check_chain
from legacy.fitting.model.mass_file import read_mass
from legacy.fitting.options import KDOptions
from legacy.fitting.plan.plan import Expectation, expect, plan_json
from legacy.fitting.plan.plan_file import read_plan
from legacy.fitting.plan.plan_page import plan_page
from legacy.fitting.recorded_fit import kd_of
from legacy.fitting.results import KDResult
from legacy.stapeskit.input_changes import refuse_changes
from legacy.stapeskit.progress import Tell, silent
from legacy.stapeskit.provenance import record
from legacy.stapeskit.records.motion_files import read_motion


@dataclass(frozen=True)
class WrittenFit:
    """A fit with what was written.

    Attributes
    ----------
    content : mapping
        kd.json.
    """

    fit: KDResult
    content: Mapping[str, Any]
    files: tuple[Path, ...]


def fit_files(
    motion_path: Path,
    mass_path: Path,
    options: KDOptions,
    out: Path,
    *,
    force: bool = False,
    config: Path | None = None,
    progress: Tell = silent,
    export: Sequence[str] = (),
) -> WrittenFit:
    """Read, fit and write ``out`` (kd.json) and the page of the same name.

    With ``options.monte_carlo``, that many simulated repetitions are fitted; their scatter is in both files.

    Parameters
    ----------
    force : bool
        Replace files at the names of the outputs that are not known as made here, and fit with a mass.json
        that is not the one that the motion was computed with.
    config : Path, optional
        The file of options, another input.
    progress : callable
        Takes the stage at work, in words.
    export : sequence of str
        Names out of fitting.export_formats.EXPORTS.

    Raises
    ------
    FittingError, KinematicsError
        A file or an option is at fault, or changes while it is read, or the files do not belong together.
    StapeskitError
        An output is an input, or a file of another origin has its name.
    """
    out = json_name(out)
    motion_path, mass_path = Path(motion_path), Path(mass_path)
    beside = motion_path.with_suffix(".h5") if motion_path.suffix else None
    outputs = output_set(
        out.parent, out.name, filter(None, (motion_path, beside, mass_path, config)), force, export
    )
    outputs.check()
    progress("reading motion and mass")
    with refuse_changes((motion_path, beside, mass_path), FittingError):
        mass, mass_record = read_mass(mass_path, options.dof)
        motion = read_motion(motion_path)
        chain = check_chain(motion, motion_path.name, mass_record, mass_path, force)
        provenance = record(
            {"motion": motion_path, "mass": mass_path}, options.parameters(), calibrated.version()
        )
    progress("fitting stiffness and damping")
    fit = kd_of(motion, mass, options, mass_record, provenance, chain=chain)
    progress("drawing the report")
    with outputs.staged() as folder:
        names = fit.write_into(folder, out.name, export)
    return WrittenFit(fit, fit.content(), tuple(out.parent / name for name in names))


def plan_files(
    path: Path, out: Path, *, force: bool = False, config: Path | None = None
) -> tuple[Expectation, dict[str, Any], tuple[Path, Path]]:
    """Read a plan, compute its expected uncertainty, write ``out`` (plan.json) and the page of the same name.

    Parameters
    ----------
    force : bool
        Replace files at the names of the outputs that are not known as made here.
    config : Path, optional
        The file of options, another input.

    Raises
    ------
    FittingError, KinematicsError
        The plan is at fault.
    StapeskitError
        An output is an input, or a file of another origin has its name.
    """
    out = json_name(out)
    plan, mass_file = read_plan(path)
    outputs = output_set(out.parent, out.name, filter(None, (Path(path), mass_file, config)), force)
    outputs.check()
    expectation = expect(plan)
    provenance = record({"plan": path, "mass": mass_file}, {}, calibrated.version())
    content = plan_json(expectation, provenance)
    html = out.with_suffix(".html")
    with outputs.staged() as folder:
        (folder / out.name).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        plan_page(expectation, provenance).write(folder / html.name)
    return expectation, content, (out, html)
