"""The command dof2kd."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from stapeskit.command import Outcome, progress_line, run

if TYPE_CHECKING:
    from fitting.options import KDFiles, KDOptions

_TEXT = "Stiffness and damping of the annular ligament from motion (points2dof) and mass (ct2mass)."
_EXAMPLES = """examples:
  dof2kd dof.csv --mass mass.json
  dof2kd dof.csv --mass mass.json --damping compare --band 400,5000 --export fe,prior
  dof2kd --plan plan.toml

plan.toml, every key may be left out:
  directions = ["y"]        # driven by the shaker, one run each
  band_hz = [400, 5000]
  lines = 200
  noise_m_s = 2e-6          # sd of Re and Im of a reading
  mass = "mass.json"
"""


def main() -> None:
    """Run the command."""
    run("dof2kd", work)


def work(words: Sequence[str]) -> Outcome:
    """Fit or plan, write the files, and return what is printed."""
    from fitting.options import KDFiles, KDOptions
    from stapeskit.command_line import parse
    from stapeskit.faults import StapeskitError

    options, files = parse("dof2kd", _TEXT, (KDOptions, KDFiles), words, _EXAMPLES)
    if files.plan is not None:
        if options != KDOptions():
            step = "Put dof and band_hz into the plan and leave the others out"
            raise StapeskitError.of("--plan", "given without options of a fit", "some", "", step)
        return _plan(files)
    return _fit(options, files)


def _fit(options: KDOptions, files: KDFiles) -> Outcome:
    from fitting.dof2kd import find_mass, fit_files
    from fitting.exports import file_names
    from stapeskit.outputs import Outputs

    motion_file = files.motion
    assert motion_file is not None  # noqa: S101
    mass_file = files.mass or find_mass(motion_file)
    out = files.out or Path("kd.json")
    beside = motion_file.with_suffix(".h5")
    inputs = [motion_file, mass_file, *([beside] if beside.is_file() else [])]
    outputs = Outputs("dof2kd", out.parent, file_names(out.name, files.export), inputs, files.force)
    outputs.check()
    with progress_line(not files.quiet) as progress:
        fit = fit_files(motion_file, mass_file, options, force=files.force, report=progress)
        progress("drawing the page")
        with outputs.staged() as folder:
            fit.write_into(folder, name=out.name, export=files.export)
    rows = list(fit.summary())
    if files.mass is None:
        rows.append(("mass", f"{mass_file} (found next to the motion)"))
    content = fit.content() if files.as_json else {}
    return Outcome(fit.title, rows, fit.notices, outputs.paths(), content, files.as_json, files.quiet)


def _plan(files: KDFiles) -> Outcome:
    from fitting.plan import expect, plan_json, plan_rows, read_plan
    from stapeskit.outputs import Outputs
    from stapeskit.provenance import record

    path = files.plan
    assert path is not None  # noqa: S101
    out = files.out or Path("plan.json")
    plan, source = read_plan(path)
    mass = None if source is None else source.file
    inputs = [path, *([mass] if mass is not None else [])]
    outputs = Outputs("dof2kd", out.parent, (out.name,), inputs, files.force)
    outputs.check()
    with progress_line(not files.quiet) as progress:
        progress("simulating and fitting the planned measurement")
        fits = expect(plan, source)
        content = plan_json(plan, fits, record({"plan": path, "mass": mass}, {}))
        with outputs.staged() as folder:
            (folder / out.name).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    rows = plan_rows(fits)
    return Outcome("What the plan reaches", rows, (), outputs.paths(), content, files.as_json, files.quiet)


if __name__ == "__main__":
    main()
