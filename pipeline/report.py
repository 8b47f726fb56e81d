"""The report of a study: one self-contained page, put together from the sections of the stages."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pipeline.records import Told
from pipeline.stages import Workspace, results
from pipeline.study import Study
from stapeskit.page import page
from stapeskit.page.numbers import plus_minus
from stapeskit.page.page import Page, Section
from stapeskit.page.quantities import MASS
from stapeskit.provenance import input_record, versions
from stapeskit.records.motion_files import read_motion
from stapeskit.warnings import unique

# Heading in its room, and heading in this page; the order is the page's. What is not named here comes after
# the last section of its own room.
_ORDER: tuple[tuple[str, str, str], ...] = (
    ("scan", "Bodies and frames", "The stapes in its frames"),
    ("scan", "What was found", "The stapes beside the literature"),
    ("scan", "Segmentation", "Segmentation"),
    ("scan", "Mass matrix", "Mass matrix M"),
    ("motion", "Points and beams", "Points and beams"),
    ("motion", "Motion at one frequency", "Motion at one frequency"),
    ("motion", "Motion of the rigid bodies", "Motion of stapes and bone"),
    ("fit", "Stiffness and damping", "Stiffness K and damping D"),
    ("fit", "Measured and simulated responses", "Measured and simulated responses"),
    ("fit", "Principal axes", "Principal axes on the footplate"),
    ("fit", "Modes", "Modes"),
    ("fit", "Where the uncertainty comes from", "Uncertainty of K and D"),
    ("fit", "What the data can tell", "What the data can tell"),
    ("fit", "Residuals", "Residuals of the fit"),
    ("scan", "Uncertainty budget", "Uncertainty of M"),
    ("motion", "Verdict on every channel", "Verdict on every channel"),
    ("motion", "Residuals of the rigid fit", "Residuals of the rigid bodies"),
    ("motion", "Registration", "Registration"),
    ("motion", "Points on the surfaces of the scan", "Points on the surfaces of the scan"),
    ("motion", "Geometry estimated with the motion", "Geometry estimated with the motion"),
)


def write_report(
    path: Path, study_file: Path, name: str, study: Study, work: Workspace, told: Mapping[str, Told]
) -> None:
    """Write report.html.

    Parameters
    ----------
    path : Path
    study_file : Path
    name : str
        What the study is called.
    study : Study
    work : Workspace
        Where the result files are.
    told : mapping of str to Told
        Sections and warnings by stage.
    """
    mass, kd = results(work)
    made = Page(name, "Mass, stiffness and damping of a stapes in its annular ligament.")
    notes = [page.text(line) for line in study.study.notes.splitlines() if line.strip()]
    made.section("This ear", *notes, page.table(("", "value"), key_results(mass, kd)))
    found = unique(notice for one in told.values() for notice in one.notices)
    made.section("Warnings", page.notices(found))
    made.sections += ordered(told)
    made.section("Inputs", *_inputs(study_file, mass, kd, work))
    made.write(path)


def key_results(mass: Mapping[str, Any], kd: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the numbers that a reader looks for first, each with its standard deviation."""
    sd = mass["mass_matrix"]["standard_deviation_si"][1][1]
    rows = [("mass", MASS.with_sd(mass["mass_kg"], sd))]
    for letter, key in (("K", "stiffness"), ("D", "damping")):
        for place, dof in enumerate(kd["dof"]):
            value, spread = (kd[f"{key}{end}"][place][place] for end in ("_si", "_sd_si"))
            unit = ("N" if letter == "K" else "N s") + ("/m" if dof in "xyz" else " m/rad")
            rows.append((f"{letter}({dof}, {dof})", f"{plus_minus(value, spread)} {unit}"))
    for place, mode in enumerate(kd["modes"]):
        frequency = plus_minus(mode["frequency_hz"], mode.get("frequency_sd_hz"))
        ratio = plus_minus(mode["damping_ratio"], mode.get("damping_ratio_sd"))
        rows.append((f"mode {place + 1}", f"{frequency} Hz, damping ratio {ratio}"))
    stable = "yes" if kd["stable"] else "NO"
    passive = "yes" if all(kd["passive"].values()) else "NO"
    rows.append(("stable; passive", f"{stable}; {passive}"))
    return rows


def ordered(told: Mapping[str, Told]) -> list[Section]:
    """Return the sections of all stages in the order of the page."""
    places = {(stage, heading): place for place, (stage, heading, _) in enumerate(_ORDER)}
    last = {stage: place for place, (stage, _, _) in enumerate(_ORDER)}
    listed = []
    for stage, one in told.items():
        for number, section in enumerate(one.sections):
            place = places.get((stage, section.heading))
            heading = section.heading if place is None else _ORDER[place][2]
            key = (last.get(stage, len(_ORDER)), 1, number) if place is None else (place, 0, number)
            listed.append((key, Section(heading, section.blocks)))
    return [section for _, section in sorted(listed, key=lambda pair: pair[0])]


def _inputs(study_file: Path, mass: Mapping[str, Any], kd: Mapping[str, Any], work: Workspace) -> list[Any]:
    """Return every input with its hash, the settings, and the versions."""
    motion = read_motion(work.find("dof.h5")).provenance
    entries = {"study": input_record(study_file)}
    for source in (mass["provenance"], motion):
        entries |= source["inputs"]
    settings: list[tuple[str, Any]] = [
        (f"scan: {key}", value) for key, value in mass["provenance"]["parameters"].items()
    ]
    settings += [(f"motion: {key}", value) for key, value in motion["parameters"].items() if value]
    settings += [(f"fit: {key}", value) for key, value in kd["provenance"]["parameters"].items() if value]
    now = datetime.now(UTC).isoformat(timespec="seconds")
    used = ", ".join(f"{package} {number}" for package, number in versions().items())
    return [
        page.inputs_table({"inputs": entries}),
        page.table(("setting", "value"), [(key, _listed(value)) for key, value in settings], words=True),
        page.text(f"Report of {now}. {used}."),
    ]


def _listed(value: object) -> str:
    """Write a setting as a person would."""
    if isinstance(value, list | tuple):
        return ", ".join(_listed(entry) for entry in value)
    if isinstance(value, Mapping):
        return ", ".join(f"{key} = {_listed(entry)}" for key, entry in value.items())
    return str(value)
