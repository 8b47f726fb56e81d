"""The report of a study: one self-contained page, put together from the sections of the stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pipeline.records import Told
from pipeline.study import Study
from pipeline.workspace import Workspace
from stapeskit.page import page
from stapeskit.page.numbers import plus_minus
from stapeskit.page.page import Page, Section
from stapeskit.page.quantities import MASS
from stapeskit.provenance import input_record
from stapeskit.warnings import unique

# Sections by key, with their heading in this page; the order is the page's. What is not listed here comes
# after the last listed section of its own stage.
_ORDER: dict[str, str] = {
    "bodies_and_frames": "The stapes in its frames",
    "literature": "The stapes beside the literature",
    "segmentation": "Segmentation",
    "mass_matrix": "Mass matrix M",
    "points_and_beams": "Points and beams",
    "motion_at_one_frequency": "Motion at one frequency",
    "rigid_motion": "Motion of stapes and bone",
    "stiffness_and_damping": "Stiffness K and damping D",
    "responses": "Measured and simulated responses",
    "principal_axes": "Principal axes on the footplate",
    "modes": "Modes",
    "kd_uncertainty": "Uncertainty of K and D",
    "identifiability": "What the data can tell",
    "kd_residuals": "Residuals of the fit",
    "mass_uncertainty": "Uncertainty of M",
    "verdicts": "Verdict on every channel",
    "rigid_residuals": "Residuals of the rigid bodies",
    "registration": "Registration",
    "points_on_surfaces": "Points on the surfaces of the scan",
    "calibration": "Geometry estimated with the motion",
}


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
    mass, kd = work.mass.record.raw, work.kd
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
    places = {key: place for place, key in enumerate(_ORDER)}
    listed: list[tuple[tuple[int, int, int], Section]] = []
    for stage in told.values():
        last = max((places.get(section.key, -1) for section in stage.sections), default=-1)
        for number, section in enumerate(stage.sections):
            place = places.get(section.key)
            if place is None:
                listed.append(((last if last >= 0 else len(_ORDER), 1, number), section))
            else:
                listed.append(((place, 0, number), replace(section, heading=_ORDER[section.key])))
    return [section for _, section in sorted(listed, key=lambda pair: pair[0])]


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
    used = ", ".join(f"{package} {number}" for package, number in work.hashes.versions().items())
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
