"""The command ``points2dof``: parse, one library call, write, a short table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from stapeskit.command import Outcome, progress_line, run

if TYPE_CHECKING:
    from kinematics.results import MotionResult

SCHEMA = "stapeskit.points2dof/1"

_TEXT = "Vibrometer points to the motion of rigid bodies about the footplate centre."
_EXAMPLES = """examples:
  points2dof ldv.csv
  points2dof ldv.csv --mass scan_mass/mass.json --reference base:y --out ear1
  points2dof scan.uff --body stapes=1-10 --body base=11-19 --frame footplate
points.csv, fiducials.csv and mass.json (or the only *_mass/mass.json) are looked
for beside LDV; --points none, --fiducials none, --mass none turn them off.

Vibrometer files, recognised by their content:
{}
Tidy table, one row per body, point, beam and frequency:
  body, point, [x_mm, y_mm, z_mm,] dir_x, dir_y, dir_z, freq_hz, re_m_s, im_m_s
  The value is v . dir, positive towards the laser head. dir may hold x, y, z,
  -x, -y or -z instead. amp_m_s, phase_deg instead of re, im. Units by suffix:
  m, mm, um, nm (displacement), m_s (velocity), m_s2 (acceleration), rms_m_s ...
  Optional: sd_m_s (sd of the real = imaginary part), n_avg, coherence, run (one
  excitation each), repeat (pooled). Empty or NaN value: missing.
points.csv:    body, point, x_mm, y_mm, z_mm [, sd_mm]
fiducials.csv: name, x_mm, y_mm, z_mm (vibrometer), x_ref_mm, y_ref_mm, z_ref_mm
               [, frame = plate (default) | scan | footplate] [, sd_mm]
Written: X.csv, X.h5, X.channels.csv, X.html, named after --out X; X.mat with
--export mat.
Motion is displacement, peak, e^{{+iwt}}, in footplate axes.
"""


def main() -> None:
    """Run the command and leave with its exit code."""
    run("points2dof", work)


def work(words: Sequence[str]) -> Outcome:
    """Run the command on its arguments, write the files, and return what is printed."""
    from kinematics.options import MotionFiles, MotionOptions
    from stapeskit.command_line import parse

    options, files = parse("points2dof", _TEXT, (MotionOptions, MotionFiles), words, _epilog())
    from kinematics.inputs import with_companions
    from kinematics.points2dof import measure_motion
    from kinematics.results import output_set
    from stapeskit.records.mass_file import read_mass_json

    found = with_companions(options, files.mass)
    inputs = [*found.options.inputs().values(), *([found.mass] if found.mass else [])]
    output_set(files.out, inputs, files.force, files.export).check()
    with progress_line(not files.quiet and not files.as_json) as progress:
        mass = None if found.mass is None else read_mass_json(found.mass)
        result = measure_motion(found.options, mass, progress, taken=found.taken)
        progress("drawing the page")
        out, name = files.out.parent, files.out.name
        paths = result.write(out, force=files.force, name=name, export=files.export)
    content = as_json(result, [str(path) for path in paths]) if files.as_json else {}
    return Outcome(result.title, result.summary(), result.notices, paths, content, files.as_json, files.quiet)


def _epilog() -> str:
    from textwrap import fill

    from kinematics.readers.formats import FORMATS

    texts = [f"{entry.words}: {entry.reads.replace('`', '')}" for entry in reversed(FORMATS)]
    formats = [fill(text, 80, initial_indent="  ", subsequent_indent="      ") for text in texts]
    return _EXAMPLES.format("\n".join(formats))


def as_json(result: MotionResult, files: Sequence[str]) -> dict[str, Any]:
    """Return the result as ``--json`` prints it."""
    from kinematics.report.tables import bodies_json, registration_json
    from stapeskit import documents

    motion = result.motion
    content = {
        "schema": SCHEMA,
        "dof": motion.dof,
        "reference": motion.reference,
        "found_beside": {role: str(path) for role, path in result.taken.items()},
        "inputs_say": result.measurement.statements,
        "runs": motion.runs,
        "lines": len(motion.freq_hz),
        "bodies": bodies_json(result),
        **registration_json(result),
        "verdicts": [vars(one) for one in result.channels if one.verdict != "ok"],
        "warnings": [notice.as_json() for notice in result.notices],
        "provenance": motion.provenance,
        "files": files,
    }
    plain: dict[str, Any] = documents.as_json(content)
    return plain


if __name__ == "__main__":
    main()
