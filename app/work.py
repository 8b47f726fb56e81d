"""Carry out one step of a study: ``python -m app.work STEP STUDY.toml``, run as a child process.

Progress goes to standard output, a JSON object a line; exit codes and sentences are those of the commands.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from app.study_file import StudyFile, replace_file, stamp
from stapeskit.command import run
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from fitting.result import KDFit
    from kinematics.results import MotionResult


def tell(stage: str, share: float | None = None) -> None:
    """Report the stage at work."""
    sys.stdout.write(json.dumps({"stage": stage, "share": share}) + "\n")
    sys.stdout.flush()


def warn(notices: Sequence[Notice]) -> None:
    """Report warnings."""
    for notice in notices:
        sys.stdout.write(json.dumps({"code": notice.code, "text": notice.text}) + "\n")


def keep(study: StudyFile, name: str, content: dict[str, Any]) -> None:
    """Write what the page shows of a step into NAME_app/."""
    path = study.kept / f"{name}.json"
    replace_file(path, json.dumps(content), stamp(path))


def found(study: StudyFile) -> None:
    """Find the stapes and measure its mass, without hand work."""
    _mass(study, study.found, hand_work=False)


def cut(study: StudyFile) -> None:
    """Measure the mass with the labels that were drawn."""
    _mass(study, study.cut, hand_work=True)


def _mass(study: StudyFile, folder: Path, *, hand_work: bool) -> None:
    from ct_inertia.ct2mass import measure_mass

    result = measure_mass(study.mass_options(hand_work=hand_work), tell)
    result.write(folder, report=False)
    warn(result.notices)


def points(study: StudyFile) -> None:
    """Lay the measurement into the scan, and look at every beam."""
    from kinematics.options import MotionOptions
    from kinematics.points2dof import measure_motion
    from stapeskit.records.measured_mass import measured_mass

    folder = mass_folder(study)
    mass = None if folder is None else measured_mass(folder / "mass.json")
    options = MotionOptions.from_study(study.tables.get("ldv", {}), study.path.name, study.path.parent)
    result = measure_motion(options, mass, tell)
    warn(result.notices)
    keep(study, "points", points_content(result))


def points_content(result: MotionResult) -> dict[str, Any]:
    """Return points in scan mm with the verdicts of their beams, and how well the fiducials fit."""
    from kinematics.measurement import direction_name

    mass, fit = result.mass, result.placement.registration
    turn, shift = np.eye(3), np.zeros(3)
    if mass is not None:
        pose = mass.record.scan_from_footplate
        turn, shift = pose.rotation, pose.translation_mm
    places: dict[tuple[str, str], list[float]] = {}
    for body in result.measurement.bodies:
        arms = np.full((len(body.points), 3), np.nan) if body.positions_m is None else body.positions_m
        every = zip(body.points, 1e3 * arms @ turn.T + shift, strict=True)
        places |= {(body.body, point): [round(float(v), 4) for v in place] for point, place in every}
    beams = [
        {
            "body": one.body,
            "point": one.point,
            "beam": direction_name(one.direction),
            "channel": f"{one.body}:{one.point}:{direction_name(one.direction)}".replace(" ", ""),
            "channel_point": f"{one.body}:{one.point}",
            "scan_mm": places[one.body, one.point],
            "verdict": one.verdict,
            "estimate": one.estimate,
            "residual_um": round(1e6 * float(one.residual_rms_m), 6),
        }
        for one in result.channels
        if (one.body, one.point) in places
    ]
    residuals = [] if fit is None else 1e3 * np.linalg.norm(fit.residuals_mm, axis=1)
    return {
        "beams": beams,
        "in_scan": mass is not None,
        "rms_um": None if fit is None else 1e3 * fit.rms_mm,
        "fiducials": {} if fit is None else dict(zip(fit.names, map(float, residuals), strict=True)),
    }


def fit(study: StudyFile) -> None:
    """Run the study as ``scan2kd`` does."""
    from fitting.report.page import matrices, verdict_block
    from pipeline.run import run_study
    from stapeskit.report import page

    fitted = run_study(study.path, study.out, progress=tell, tell=warn).fit
    shown = str(verdict_block(fitted) + page.beside(*matrices(fitted)))
    keep(study, "fit", {"verdict": fitted.verdict.as_json(), "html": shown, **response_content(fitted)})


def response_content(result: KDFit) -> dict[str, Any]:
    """Return measured and simulated responses, for curves."""
    from fitting.report.figures import responses
    from stapeskit.report.figures import dof_unit

    shown = responses(result)
    order = np.argsort(shown.freq_hz)
    rows = []
    for place, name in enumerate(result.dof):
        for kind, values in (("measured", shown.measured), ("fitted", shown.simulated)):
            value = values[order, place]
            unit, symbol = dof_unit(name)
            rows.append(
                {
                    "motion": f"{name}, {symbol}",
                    "kind": kind,
                    "amplitude": [float(f"{unit * one:.6g}") for one in np.abs(value)],
                    "phase": [round(float(one), 3) for one in np.angle(value, deg=True)],
                }
            )
    return {
        "freq_hz": [round(float(one), 4) for one in shown.freq_hz[order]],
        "responses": rows,
    }


def mass_folder(study: StudyFile) -> Path | None:
    """Return the folder with the mass of the study: of the corrected cut, else of the found one."""
    drawn = study.cut if study.labels_are_ours else study.found
    return next((one for one in (drawn, study.found) if (one / "mass.json").is_file()), None)


STEPS: dict[str, Callable[[StudyFile], None]] = {"found": found, "cut": cut, "points": points, "fit": fit}


def work(words: list[str]) -> None:
    """Run the step that the words name."""
    step, path = words
    STEPS[step](StudyFile.read(Path(path)))


if __name__ == "__main__":
    run("stapeskit app", work)
