"""The report of a mass matrix: sections that other reports reuse, and the page of `ct2mass`.

The sections are built from the files of a result (mass.json, the surfaces, the labels, the scan), so that a
result read back gives the same report as a fresh one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.ct_inertia.bodies import PLATE
from legacy.ct_inertia.mass.budget import mass_sd_missing
from legacy.ct_inertia.report.colours import BODY_COLOURS
from legacy.ct_inertia.report.mass_sections import cross_check_section, files_blocks, masses_section
from legacy.ct_inertia.report.result_section import found_section
from legacy.ct_inertia.report.segmentation_sections import evidence_rows
from legacy.ct_inertia.surface.surface import Surface
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import RigidTransform
from legacy.stapeskit.option_names import named
from legacy.stapeskit.page import page
from legacy.stapeskit.page.quantities import SMALL_LENGTH, matrix_units
from legacy.stapeskit.records.mass_record import mass_source_words
from legacy.stapeskit.warnings import from_json

if TYPE_CHECKING:
    from legacy.ct_inertia.bodies import LabelledVolume
    from legacy.ct_inertia.ct2mass import MassMeasurement


@dataclass(frozen=True)
class Pictured:
    """What the pictures need in addition to mass.json.

    Attributes
    ----------
    stapes : Surface
    plate : Surface or None
    labelled : LabelledVolume or None
        With the scan as its grid; None: no pictures of slices.
    """

    stapes: Surface
    plate: Surface | None = None
    labelled: LabelledVolume | None = None


def mass_sections(content: Mapping[str, Any], pictured: Pictured) -> list[page.Section]:
    """Return the sections on bodies, frames and mass matrix.

    Result; how the stapes was cut out; the bodies in their frames; the mass matrix; its uncertainty; the ways
    to the mass; the cross-check.

    Parameters
    ----------
    content : mapping
        The content of mass.json.
    pictured : Pictured
    """
    sections = [found_section(content)]
    if pictured.labelled is not None:
        sections.append(_cut_section(content, pictured))
    sections += [_bodies_section(content, pictured), _matrix_section(content), _budget_section(content)]
    ways = masses_section(content)
    return [*sections, *([] if ways is None else [ways]), cross_check_section(content)]


def report_sections(
    result: MassMeasurement, content: Mapping[str, Any], shown: Surface | None = None
) -> list[page.Section]:
    """Return the sections of a result.

    Parameters
    ----------
    result : MassMeasurement
    content : mapping
        Of mass.json.
    shown : Surface, optional
        A lighter surface for the pictures.
    """
    labelled = None if result.bodies is None else result.bodies.labels
    return mass_sections(content, Pictured(shown or result.stapes, result.plate, labelled))


def write_report(
    path: Path, result: MassMeasurement, content: Mapping[str, Any], shown: Surface | None = None
) -> None:
    """Write report.html; for the arguments see `report_sections`."""
    sections = report_sections(result, content, shown)
    source = result.options.scan or result.options.labels
    document = page.Page(
        f"Mass matrix of {Path(str(source)).name}",
        "A stapes from micro-CT: its volume, frames and generalized mass matrix about the footplate centre.",
        [
            sections[0],
            page.Section("Warnings", [page.notices(from_json(content["warnings"]))]),
            *sections[1:],
            inputs_section(content),
        ],
    )
    document.write(path)


def inputs_section(content: Mapping[str, Any]) -> page.Section:
    """Return inputs with hashes, options and versions."""
    provenance = content["provenance"]
    options = [
        (key.replace("_", " "), _option_text(key, value)) for key, value in provenance["parameters"].items()
    ]
    versions = ", ".join(f"{name} {number}" for name, number in provenance["versions"].items())
    return page.Section(
        "Inputs",
        [
            page.inputs_table(provenance),
            page.table(("option", "value"), options, words=True),
            page.text(f"{provenance['command']} — {provenance['date']}. {versions}."),
            *files_blocks(content),
        ],
    )


def _option_text(key: str, value: Any) -> str:
    """Return the words for the value of an option."""
    if key in ("density", "mass_mg") and isinstance(value, list | tuple):
        return f"{value[0]:g}" if value[1] is None else f"{value[0]:g} ± {value[1]:g}"
    if isinstance(value, list | tuple):
        return ", ".join(_option_text("", entry) for entry in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _frame(content: Mapping[str, Any], key: str) -> RigidTransform | None:
    matrix = content["frames"][f"scan_from_{key}"]
    return None if matrix is None else RigidTransform(np.array(matrix, dtype=float), "scan", key)


def _bodies_section(content: Mapping[str, Any], pictured: Pictured) -> page.Section:
    from legacy.ct_inertia.report.drawn_body import Body
    from legacy.ct_inertia.report.pictures import Scene, render_scenes

    footplate = _frame(content, "footplate")
    if footplate is None:
        return page.Section("Bodies and frames", key="bodies_and_frames")
    plate = _frame(content, "plate")
    codes = {warning["code"] for warning in content["warnings"]}
    known = "anterior_not_given" not in codes
    side = content["frames"].get("side")
    stapes = Body(pictured.stapes.vertices_mm, pictured.stapes.faces)
    scenes = [Scene([stapes], footplate, None, side, known)]
    if pictured.plate is not None:
        mesh = pictured.plate
        body = Body(mesh.vertices_mm, mesh.faces, BODY_COLOURS[PLATE], 0.45, "plate", smooth=False)
        scenes.append(Scene([stapes, body], footplate, plate, side, known))
    pictures = render_scenes(scenes)
    captions = (
        "The stapes in the footplate frame: x along the footplate, y the piston direction, z = x × y.",
        "Stapes and plate with both frames, seen along the footplate axes.",
    )
    blocks = [
        page.image(picture, caption, caption) for picture, caption in zip(pictures, captions, strict=False)
    ]
    blocks.append(_frames_table(content))
    return page.Section("Bodies and frames", blocks, "bodies_and_frames")


def _frames_table(content: Mapping[str, Any]) -> Any:
    poses = content["frames"]["pose_covariance"]
    columns: dict[str, list[str]] = {}
    for key in ("footplate", "plate"):
        frame = _frame(content, key)
        if frame is None:
            continue
        sd = np.sqrt(np.diag(np.array(poses[f"scan_from_{key}"]["matrix_si"], dtype=float)))
        columns[f"{key} frame"] = [
            _format_numbers(frame.translation_mm, 4),
            *(_format_numbers(frame.rotation[:, axis], 4) for axis in range(3)),
            ", ".join(f"{SMALL_LENGTH.of(value):.2g}" for value in sd[:3]),
            ", ".join(f"{np.degrees(value):.2g}" for value in sd[3:]),
        ]
    labels = (
        "origin (scan, mm)",
        "x axis (scan)",
        "y axis (scan)",
        "z axis (scan)",
        "sd of origin along x, y, z (µm)",
        "sd of rotation about x, y, z (°)",
    )
    rows = [(label, *(column[place] for column in columns.values())) for place, label in enumerate(labels)]
    return page.table(("", *columns), rows)


def _format_numbers(values: Array, digits: int) -> str:
    return ", ".join(f"{value:+.{digits}f}" for value in values)


def _cut_section(content: Mapping[str, Any], pictured: Pictured) -> page.Section:
    from legacy.ct_inertia.report.slice_browser import slice_browser
    from legacy.ct_inertia.report.slices_figure import Crop, slices_figure

    footplate = _frame(content, "footplate")
    section = page.Section("Segmentation", key="segmentation")
    if footplate is None or pictured.labelled is None:
        return section
    crop = Crop(pictured.labelled)
    drawing = slices_figure(crop, footplate)
    section.add(
        slice_browser(crop),
        page.figure(
            drawing,
            "Grey values with the outlines of the labels. Top: planes of the footplate frame, through the "
            "arch (z = 0), across it (x = 0), and along the footplate. Bottom: slices of the scan itself "
            "where the area of the stapes is largest, or through its largest cut (blue) from other bone.",
            "Six slices with the outlines of stapes, plate and other bone.",
            vector=False,
        ),
    )
    rows = evidence_rows(content.get("segmentation") or {})
    if rows:
        section.add(page.subheading("Evidence"), page.table(("", "found"), rows, words=True))
    section.add(
        page.text(
            f"Where the cut looks wrong: {named('seed')}, {named('threshold')} and {named('box')} correct "
            f"it, and {named('labels')} takes a label "
            "volume corrected in 3D Slicer or ITK-SNAP: labels.nrrd, edited where it lies, or a copy of it. "
            "It is never written over."
        )
    )
    return section


def _matrix_section(content: Mapping[str, Any]) -> page.Section:
    section = page.Section("Mass matrix", key="mass_matrix")
    missing = mass_sd_missing(content)
    section.add(
        page.text(
            "Order of the degrees of freedom: x, y, z (translations of the footplate centre), alpha, beta, "
            "gamma (small rotations about x, y, z). "
            + (
                f"No standard deviations: {missing}; those of the other sources are in the budget below. "
                if missing
                else "± one standard deviation with all sources. "
            )
            + "mass.json holds the same in SI units."
        )
    )
    for key, words in (
        ("mass_matrix_reduced", "Reduced mass matrix about the footplate centre in footplate axes"),
        ("mass_matrix", "Mass matrix about the footplate centre in footplate axes"),
        ("mass_matrix_plate_axes", "Mass matrix about the footplate centre in plate axes"),
    ):
        block = content[key]
        if block is not None:
            sd = None if missing else block["standard_deviation_si"]
            units = matrix_units("M", block["dof"])
            section.add(page.quantity_matrix(block["matrix_si"], units, block["dof"], words, sd))
    return section


def _budget_section(content: Mapping[str, Any]) -> page.Section:
    matrix = np.array(content["mass_matrix"]["matrix_si"], dtype=float)
    diagonal = np.diag(matrix)
    rows = []
    missing = content["uncertainty"].get("not_included", [])
    for source, row in content["uncertainty"].items():
        if not isinstance(row, Mapping):
            continue
        name = "total of these" if source == "total" and missing else mass_source_words(source)
        shares = [
            f"{100.0 * sd / value:.3f}"
            for sd, value in zip(row["mass_matrix_diagonal_si"][2:], diagonal[2:], strict=True)
        ]
        com = ", ".join(f"{SMALL_LENGTH.of(value):.2f}" for value in row["center_of_mass_m"])
        rows.append((name, com, *shares))
    header = ("source", "centre of mass (µm)", "mass (%)", "M(alpha) (%)", "M(beta) (%)", "M(gamma) (%)")
    section = page.Section(
        "Uncertainty budget",
        [
            page.text(
                "One standard deviation that each source adds, carried linearly to every number; the total "
                "takes the sources as independent. Centre of mass along x, y, z of the footplate."
            ),
            page.table(header, rows),
        ],
        "mass_uncertainty",
    )
    if missing:
        section.add(page.text("Not in the budget: " + "; ".join(missing) + "."))
    return section
