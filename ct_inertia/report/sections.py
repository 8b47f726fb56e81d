"""The page of ``ct2mass`` and its sections, which other pages take over.

Everything comes from mass.json, the meshes and slices of the scan, so a result that is read back gives the
same page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ct_inertia.mass.sizes import NAMES
from ct_inertia.mass.ways import WAYS
from ct_inertia.report.pictured import Pictured
from ct_inertia.report.pictures import anatomy_of, frame_of, medial_view, slices_figure
from stapeskit.records.mass_matrix import source_words
from stapeskit.report import page
from stapeskit.report.colours import AXIS_COLOURS, BODY_COLOURS, PAGE_COLOURS
from stapeskit.report.quantities import LENGTH, MASS, SMALL_LENGTH, VOLUME, Quantity, matrix_units, plus_minus
from stapeskit.report.scene3d import Line, Mesh, Scene
from stapeskit.warnings import from_json

if TYPE_CHECKING:
    from markupsafe import Markup

_ABOUT = "about the footplate centre, in footplate axes"
_LARGEST = 5  # sources of uncertainty that are listed one by one
_LEAST_SHOWN = 5e-4  # percent and micrometres: less is none
_PLATE_AXIS_MM = 1.0
_BONE_FROM = {"interior": "mean deep inside", "fit": "of the fit", "mask": "labels"}

Content = Mapping[str, Any]


def mass_page(content: Content, pictured: Pictured) -> page.Page:
    """Return the page of a result from the content of its mass.json."""
    source = next(iter(content["provenance"]["inputs"].values()))["file"]
    lead = "A stapes from micro-CT: volume, frames and generalized mass matrix about the footplate centre."
    shown = page.Page(f"Mass matrix of {source}", lead)
    missing = _missing(content)
    note = f"No standard deviations: {missing}." if missing else page.PLUS_MINUS
    shown.add(page.note(f"{note} M is {_ABOUT}."))
    shown.add(page.beside(reduced_matrix(content), *summary_tables(content)))
    shown.add(page.notices(from_json(content["warnings"])))
    add_sections(shown, content, pictured)
    shown.section("The stapes in three dimensions", page.viewer(scene(content, pictured)))
    provenance = content["provenance"]
    given = [(key.replace("_", " "), str(value)) for key, value in provenance["parameters"].items()]
    versions = ", ".join(f"{name} {number}" for name, number in provenance["versions"].items())
    shown.appendix_section(
        "Inputs",
        page.inputs(provenance),
        page.table(("option", "value"), given, words=True),
        page.text(f"{provenance['command']}; {provenance['date']}. {versions}."),
    )
    return shown


def add_sections(shown: page.Page, content: Content, pictured: Pictured) -> None:
    """Add what was measured, mass matrix and its uncertainty, and the appendix, to a page."""
    cut = slices_figure(content, pictured)
    blocks = []
    if cut is not None:
        caption = (
            "Grey values in planes of the footplate frame, with the outline of what was measured as stapes, "
            "and of what was taken for other bone and the plate. Where the outline is wrong: seed, threshold "
            "and box correct it, and labels takes labels.seg.nrrd corrected in 3D Slicer or ITK-SNAP."
        )
        alt = "Three slices with the outlines of stapes, plate and other bone."
        blocks.append(page.figure(cut, caption, alt, file="cut"))
    shown.section("What was measured", *blocks, page.beside(*orientation_blocks(content, pictured)))
    shown.section("Mass matrix M", *matrix_blocks(content))
    measured = [_frames_table(content), *evidence_blocks(content)]
    for heading, rows in (
        ("Ways to the mass", ways_blocks(content)),
        ("Compared with published stapedes", published_blocks(content)),
    ):
        if rows:
            measured += [page.subheading(heading), *rows]
    shown.appendix_section("Frames, and how the stapes was found", *measured)


def _missing(content: Content) -> str:
    """Return why the mass has no standard deviation; empty where it has one."""
    way = content["mass_known_by"]
    stated = way in content["inertial_parameters"]["contributions_si"]
    return "" if stated else f"no standard deviation of {WAYS[way].what} was given"


def summary_tables(content: Content) -> list[Markup]:
    """Return mass, volume and centre, and sizes and directions, as two tables."""
    total, found, frames = content["uncertainty"]["total"], content["found"], content["frames"]
    values = np.array(content["inertial_parameters"]["values_si"])
    sd = None if _missing(content) else total["mass_kg"]
    density = f"{content['density_kg_m3']:.0f} kg/m³"
    if "density_assumed" in {warning["code"] for warning in content["warnings"]}:
        density += " ± 200, ASSUMED: state your own density, mass_mg or calibration"
    spread = zip(values[1:4] / values[0], total["center_of_mass_m"], strict=True)
    centre = ", ".join(plus_minus(LENGTH.of(float(value)), LENGTH.of(float(own))) for value, own in spread)
    mass = [
        ("density of the bone", density),
        ("mass with what was added" if found["added_masses"] else "mass", Quantity(values[0], sd, MASS)),
        ("volume of the bone", VOLUME.text(content["volume_m3"], ".4f")),
        ("centre of mass (footplate x, y, z)", f"{centre} mm"),
    ]
    size = f"{found['footplate_length_mm']:.2f} × {found['footplate_width_mm']:.2f} mm"
    place = [
        ("footplate, height", f"{size}, {found['height_mm']:.2f} mm"),
        ("gap of the ligament", _gap_words(found)),
        ("anterior", frames.get("anterior_in_words", "")),
        ("for the other choice", frames.get("other_choice", "")),
        ("z points", frames["z_is"]),
    ]
    tables = (("Mass", mass), ("Sizes and directions", place))
    return [page.table(("", ""), rows, title=title, words=True) for title, rows in tables]


def _gap_words(found: Content) -> str:
    if found.get("gap_mm") is None:
        return "not measured: no other bone along half of the rim, or too near"
    gap, sd = 1e3 * found["gap_mm"], 1e3 * found["gap_sd_mm"]
    return f"{gap:.0f} ± {sd:.1f} µm, median along {100.0 * found['gap_rim_share']:.0f} % of the rim"


def reduced_matrix(content: Content) -> Markup:
    """Return M for y, alpha, gamma with its 95 % intervals."""
    names = [f"{name} ({number})" for number, name in enumerate(content["mass_matrix_reduced"]["dof"], 1)]
    return _matrix(content, "mass_matrix_reduced", "", names)


def _matrix(content: Content, key: str, caption: str, names: Sequence[str] = ()) -> Markup:
    block = content[key]
    sd = None if _missing(content) else block["standard_deviation_si"]
    units = matrix_units("M", block["dof"])
    return page.matrix(names or block["dof"], block["matrix_si"], sd, units, caption, title="Mass M")


def matrix_blocks(content: Content) -> list[Markup]:
    """Return M in full and the budget of its largest sources."""
    blocks = [_matrix(content, "mass_matrix", _ABOUT)]
    if content["mass_matrix_plate_axes"] is not None:
        plate = _matrix(content, "mass_matrix_plate_axes", "about the footplate centre, in plate axes")
        blocks.append(page.folded("M in the axes of the plate", plate))
    return [*blocks, page.subheading("Uncertainty of M"), *budget_blocks(content)]


def budget_blocks(content: Content) -> list[Markup]:
    """Return the largest sources of uncertainty of M, the others together, and what is not included."""
    values = np.diag(np.array(content["mass_matrix"]["matrix_si"]))[[0, 3, 4, 5]]
    rows: dict[str, np.ndarray[Any, Any]] = {}
    for source, row in content["uncertainty"].items():
        if source not in ("total", "not_included"):
            shares = np.array(row["mass_matrix_diagonal_si"])[[0, 3, 4, 5]] / values
            rows[source] = np.append(
                100.0 * shares, SMALL_LENGTH.of(float(np.linalg.norm(row["center_of_mass_m"])))
            )
    order = sorted(rows, key=lambda source: -float(np.max(rows[source][:4])))
    listed = [(source_words(source), *_digits(rows[source])) for source in order[:_LARGEST]]
    rest = order[_LARGEST:]
    if rest and max(float(np.max(rows[source])) for source in rest) >= _LEAST_SHOWN:
        together = np.sqrt(sum(np.square(rows[source]) for source in rest))
        listed.append((f"{len(rest)} others together", *_digits(together)))
    listed.append(("all of these", *_digits(np.sqrt(sum(np.square(row) for row in rows.values())))))
    head = ("source", "mass (%)", "M(alpha) (%)", "M(beta) (%)", "M(gamma) (%)", "centre (µm)")
    blocks = [page.table(head, listed, "One standard deviation that each source adds; centre: of mass.")]
    missing = content["uncertainty"].get("not_included") or []
    return blocks + ([page.text("Not in the budget: " + "; ".join(missing) + ".")] if missing else [])


def _digits(values: Any) -> list[str]:
    return [f"{value:.2g}" if value >= _LEAST_SHOWN else "0" for value in values]


def orientation_blocks(content: Content, pictured: Pictured) -> list[Markup]:
    """Return the medial side with its directions named, and where anterior is in words."""
    from markupsafe import Markup

    frames = content["frames"]
    caption = "The medial side of the stapes, seen along the piston direction y, in axes of the footplate."
    alt = "The medial side of the stapes, with its directions named."
    drawn = page.figure(medial_view(content, pictured), caption, alt, file="medial")
    words = f"Anterior was taken to be {frames['anterior_in_words']}. For the other choice, add"
    flag = frames["other_choice"]
    key = f"anterior = [{flag.partition('=')[2].replace(',', ', ')}]"
    ways = [
        page.text(f"{words} to ct2mass:"),
        page.code(flag),
        page.text("or to [scan] of a study:"),
        page.code(key),
    ]
    return [drawn, Markup("").join(ways)]


def _frames_table(content: Content) -> Markup:
    columns: dict[str, list[str]] = {}
    for key in ("footplate", "plate"):
        frame = frame_of(content, key)
        if frame is None:
            continue
        pose = np.array(content["frames"]["pose_covariance"][f"scan_from_{key}"]["matrix_si"])
        sd = np.sqrt(np.diag(pose))
        columns[f"{key} frame"] = [
            _listed(frame.translation_mm, "+.4f"),
            *(_listed(axis, "+.4f") for axis in frame.rotation.T),
            _listed(SMALL_LENGTH.of(sd[:3]), ".2g"),
            _listed(np.degrees(sd[3:]), ".2g"),
        ]
    names = (
        *("origin (scan, mm)", "x (scan)", "y (scan)", "z (scan)"),
        *("sd of the origin along x, y, z (µm)", "sd of the turn about x, y, z (°)"),
    )
    rows = [(name, *(column[place] for column in columns.values())) for place, name in enumerate(names)]
    return page.table(("", *columns), rows, words=True)


def _listed(values: Any, form: str) -> str:
    return ", ".join(f"{value:{form}}" for value in values)


def scene(content: Content, pictured: Pictured) -> Scene:
    """Return the stapes, the plate, the bone around it and both frames for the viewer."""
    frame = frame_of(content, "footplate")
    assert frame is not None  # noqa: S101 - every mass.json has it
    names = anatomy_of(content)
    stapes = pictured.light_stapes
    colour, light = BODY_COLOURS["stapes"], len(stapes.faces)
    surfaces = [Mesh("stapes", stapes.vertices_mm, stapes.faces, colour, most_faces=light)]
    lines = []
    if pictured.plate is not None:
        plate = pictured.plate
        colour = BODY_COLOURS["plate"]
        surfaces.append(Mesh("plate", plate.vertices_mm, plate.faces, colour, 0.4, most_faces=3000))
    if pictured.bone is not None:
        bone, colour = pictured.bone, BODY_COLOURS["other bone"]
        surfaces.append(Mesh("other bone", bone.vertices_mm, bone.faces, colour, 0.3, most_faces=3000))
    outline = np.array(content["found"]["footplate_outline_in_footplate_mm"])
    closed = frame.points(np.vstack([outline, outline[:1]]))
    lines.append(Line("outline", closed, PAGE_COLOURS["ink"], "outline of the footplate", width=2.0))
    plate_frame = frame_of(content, "plate")
    if plate_frame is not None:
        for name, axis in zip("xyz", plate_frame.rotation.T, strict=True):
            start = plate_frame.translation_mm
            ends = np.stack([start, start + _PLATE_AXIS_MM * axis])
            lines.append(
                Line(f"{name}p", ends, AXIS_COLOURS[name], "plate frame", False, f"{name} plate", True)
            )
    return Scene(
        surfaces,
        axes=frame,
        lines=lines,
        directions=(names.get("+x", ""), names["+y"], names.get("+z", "")),
        title="The stapes and its frames",
    )


def published_blocks(content: Content) -> list[Markup]:
    """Return the sizes next to those of published human stapedes."""
    rows = []
    for row in content.get("published") or []:
        name, unit = NAMES[row["quantity"]]
        sd = "" if row["sd"] is None else f" ± {row['sd']:.3g}"
        number = f" (n = {row['n']})" if row["n"] else ""
        z = "" if row["z"] is None else f"{row['z']:+.1f}"
        published = f"{row['mean']:.4g}{sd}{number}"
        rows.append((f"{name} ({unit})", f"{row['value']:.4g}", published, z, row["reference"]))
    return [page.table(("", "found", "published", "z", "reference"), rows, words=True)] if rows else []


def evidence_blocks(content: Content) -> list[Markup]:
    """Return how the stapes was found, cut out and measured; nothing for a mesh."""
    segmentation = content.get("segmentation")
    if not segmentation:
        return []
    size = " × ".join(map(str, segmentation["size_voxels"]))
    voxel = " × ".join(f"{1e3 * value:.4g}" for value in segmentation["voxel_size_mm"])
    rows = [("voxels", f"{size} of {voxel} µm"), ("separated from other bone", segmentation["separation"])]
    levels = segmentation["levels"]
    if levels:
        noise = levels["noise"] / (levels["bone"] - levels["air"])
        rows += [
            ("grey value of air", f"{levels['air']:.5g} ± {levels['air_sd']:.2g}"),
            (
                f"grey value of bone ({_BONE_FROM[levels['bone_from']]})",
                f"{levels['bone']:.5g} ± {levels['bone_sd']:.2g}",
            ),
            ("noise of one voxel", f"{100.0 * noise:.1f} % of the contrast"),
            ("blur of the scan", f"{1e3 * segmentation['psf_sigma_mm']:.1f} µm (sd, voxel included)"),
        ]
    left = segmentation["measured"].get("residual_share_by_place", {})
    rows += [
        (f"left by the model: {place}", f"{100.0 * share:+.3f} % of the volume")
        for place, share in left.items()
    ]
    rows += [(f"fitted: {name}", f"{value:.3g}") for name, value in segmentation["media"].items()]
    return [page.table(("", "found"), rows, words=True)]


def ways_blocks(content: Content) -> list[Markup]:
    """Return the mass by each way that was given, where there are several."""
    others = content.get("mass_alternatives") or []
    if not others:
        return []
    sd = None if _missing(content) else content["uncertainty"]["total"]["mass_kg"]
    lead = content["mass_known_by"]
    rows: list[tuple[object, ...]] = [
        (
            f"{WAYS[lead].words} (used)",
            Quantity(content["mass_kg"], sd, MASS),
            content["density_kg_m3"],
            "",
        )
    ]
    for way in others:
        mass = Quantity(way["mass_kg"], way["mass_sd_kg"], MASS)
        rows.append((WAYS[way["by"]].words, mass, way["density_kg_m3"], way["mass_change_percent"]))
    head = ("mass by", "mass", "bone (kg/m³)", "change (%)")
    return [page.table(head, rows)]
