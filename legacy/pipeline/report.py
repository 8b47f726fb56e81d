"""The report of a study: one self-contained page, put together from the sections of the stages."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from legacy.pipeline.errors import PipelineError
from legacy.pipeline.methods import methods
from legacy.pipeline.report_summary import si_table, summary_block
from legacy.pipeline.stage_records import StageReport
from legacy.pipeline.study import Study
from legacy.pipeline.verdict import verdict
from legacy.pipeline.viewer.scene import viewer
from legacy.pipeline.workspace import Workspace
from legacy.stapeskit.json_toml import is_finite_number, read_json
from legacy.stapeskit.page import page
from legacy.stapeskit.page.page import Page, Section
from legacy.stapeskit.provenance import input_record
from legacy.stapeskit.warnings import unique

# Parts of the page and their sections by key, with the heading in this page; the order is the page's. What is
# not listed here comes after the last listed section of its own stage.
_PARTS: dict[str, dict[str, str]] = {
    "Scan and mass": {
        "bodies_and_frames": "The stapes in its frames",
        "segmentation": "Segmentation",
        "mass_matrix": "Mass matrix M",
        "mass_uncertainty": "Uncertainty of M",
        "literature": "The stapes compared with the literature",
    },
    "Motion": {
        "points_and_beams": "Points and beams",
        "motion_at_one_frequency": "Motion at one frequency",
        "rigid_motion": "Motion of stapes and bone",
        "verdicts": "Verdict on every channel",
        "rigid_residuals": "Residuals of the rigid bodies",
        "registration": "Registration",
        "points_on_surfaces": "Points on the surfaces of the scan",
        "calibration": "Geometry estimated with the motion",
        "lasers": "How the lasers agree",
    },
    "Ligament": {
        "responses": "Measured and simulated responses",
        "stiffness_and_damping": "Stiffness K and damping D",
        "modes": "Modes",
        "principal_axes": "Principal axes on the footplate",
        "kd_uncertainty": "Uncertainty of K and D",
        "identifiability": "What the data can tell",
        "kd_residuals": "Residuals of the fit",
    },
}
_ORDER = {key: heading for part in _PARTS.values() for key, heading in part.items()}
_FIRST, _LAST = "This ear", "Record"


def write_report(
    path: Path, study_file: Path, name: str, study: Study, work: Workspace, reports: Mapping[str, StageReport]
) -> None:
    """Write report.html.

    Parameters
    ----------
    name : str
        What the study is called.
    work : Workspace
        Where the result files are.
    reports : mapping of str to StageReport
        Sections and warnings by stage.
    """
    mass, kd = work.mass.record.raw, work.kd
    truth = None if study.study.truth is None else read_truth(study.study.truth)
    notices = unique(notice for stage in reports.values() for notice in stage.notices)
    report = Page(name, "Mass, stiffness and damping of a stapes in its annular ligament.")
    report.summary += [page.text(line) for line in study.study.notes.splitlines() if line.strip()]
    report.summary.append(summary_block(mass, kd, verdict(kd, notices), truth))
    report.summary.append(si_table(mass, kd))
    report.section("The stapes in three dimensions", viewer(work.mass, kd)).key = "stapes_3d"
    report.section("Accept or correct the cut", *_correction(study_file, study, work))
    report.section("Warnings", page.notices(notices)).key = "warnings"
    report.section("Methods in words", page.text(methods(mass, kd, work.motion)))
    for section in report.sections:
        section.group = _FIRST
    report.sections += ordered(reports)
    report.section("Inputs", *_inputs(study_file, mass, kd, work)).group = _LAST
    report.write(path)


def read_truth(path: Path) -> Mapping[str, Any]:
    """Read the true values of a simulated ear.

    Raises
    ------
    PipelineError
        The file is no JSON object, or has something else than numbers where values are shown.
    """
    try:
        truth = read_json(path)
    except (OSError, ValueError):
        truth = {"dof": None}
    if not _are_true_values(truth):
        expected = "a JSON object: mass_kg a number, stiffness_si and damping_si square in the order of dof"
        raise PipelineError.of("study.truth", expected, "another file", path.name, "Leave the key out")
    return truth


def _are_true_values(truth: Mapping[str, Any]) -> bool:
    dof = truth.get("dof", [])
    if not isinstance(dof, list) or not is_finite_number(truth.get("mass_kg", 0.0)):
        return False
    for matrix in (truth[key] for key in ("stiffness_si", "damping_si") if key in truth):
        if not isinstance(matrix, list) or len(matrix) != len(dof):
            return False
        cells = [cell for row in matrix if isinstance(row, list) and len(row) == len(dof) for cell in row]
        if len(cells) != len(dof) ** 2 or not all(map(is_finite_number, cells)):
            return False
    return True


def _correction(study_file: Path, study: Study, work: Workspace) -> list[Any]:
    """Return what to do where the cut is right, and the line and command that correct it."""
    own = study.scan.labels
    if own is None:
        labels = _relative(work.out / "labels.nrrd", Path(study_file).absolute().parent)
        line = f'labels = "{labels}"'
        shown = _relative(work.out / "labels.nrrd", Path.cwd())
        edit = f"Open {shown} on the scan in 3D Slicer or ITK-SNAP, correct label 1, and save it there."
    else:
        line = f'labels = "{own.name}"  (it is there already)'
        edit = f"Correct {own.name} further and save it where it is."
    here = Path.cwd()
    command = f"scan2kd {_relative(study_file, here)} --out {_relative(work.out, here)}"
    return [
        page.text(
            "Look at the stapes above and at the slices of the segmentation. Is it the whole stapes and "
            "nothing else? Then there is nothing to do."
        ),
        page.text(f"Otherwise: {edit} Add this line to [scan] of {Path(study_file).name}:"),
        page.code(line),
        page.text("and run again from the same folder; your labels stay as they are:"),
        page.code(command),
    ]


def _relative(path: Path, folder: Path) -> str:
    """Return a path as it is written in a folder."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # another drive
        return Path(path).absolute().as_posix()


def ordered(reports: Mapping[str, StageReport]) -> list[Section]:
    """Return the sections of all stages in the order of the page."""
    places = {key: place for place, key in enumerate(_ORDER)}
    listed: list[tuple[tuple[int, int, int], Section]] = []
    for stage in reports.values():
        group = next((_part_of(section.key) for section in stage.sections if section.key in places), _LAST)
        last = max((places.get(section.key, -1) for section in stage.sections), default=-1)
        for number, section in enumerate(stage.sections):
            place = places.get(section.key)
            if place is None:
                rank = (last if last >= 0 else len(_ORDER), 1, number)
                listed.append((rank, replace(section, group=group)))
            else:
                heading = _ORDER[section.key]
                listed.append(
                    ((place, 0, number), replace(section, heading=heading, group=_part_of(section.key)))
                )
    return [section for _, section in sorted(listed, key=lambda pair: pair[0])]


def _part_of(key: str) -> str:
    """Return the part of the page that a listed section belongs to."""
    return next(part for part, sections in _PARTS.items() if key in sections)


def _inputs(study_file: Path, mass: Mapping[str, Any], kd: Mapping[str, Any], work: Workspace) -> list[Any]:
    """Return every input with its hash, the settings, and the versions."""
    motion = work.motion.provenance
    entries = {"study": input_record(study_file, hashes=work.hashes)}
    for source in (mass["provenance"], motion):
        entries |= source["inputs"]
    settings: list[tuple[str, Any]] = [
        (f"scan: {key}", value) for key, value in mass["provenance"]["parameters"].items()
    ]
    settings += [(f"motion: {key}", value) for key, value in motion["parameters"].items() if value]
    settings += [(f"fit: {key}", value) for key, value in kd["provenance"]["parameters"].items() if value]
    now = datetime.now(UTC).isoformat(timespec="seconds")
    versions: dict[str, str] = {}
    for source in (mass["provenance"], motion, kd["provenance"]):
        versions |= source["versions"]
    used = ", ".join(f"{package} {number}" for package, number in versions.items())
    return [
        page.inputs_table({"inputs": entries}),
        page.table(
            ("setting", "value"), [(key, _format_setting(value)) for key, value in settings], words=True
        ),
        page.text(f"Report of {now}. {used}."),
    ]


def _format_setting(value: object) -> str:
    """Write a setting as a person would."""
    if isinstance(value, list | tuple):
        return ", ".join(_format_setting(entry) for entry in value)
    if isinstance(value, Mapping):
        return ", ".join(f"{key} = {_format_setting(entry)}" for key, entry in value.items())
    return str(value)
