"""Write a result: ``mass.json``, surfaces and labels, and what was asked for besides."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legacy.ct_inertia.exports.mass_json import mass_json
from legacy.ct_inertia.exports.output_files import DISPLAY, REPORT, SCAN_CROP, SEGMENTS
from legacy.ct_inertia.exports.scan_crop import EarlyCrop, needs_crop
from legacy.ct_inertia.surface.surface import write_surface
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

if TYPE_CHECKING:
    from legacy.ct_inertia.ct2mass import MassMeasurement
    from legacy.stapeskit.own_files import OutputSet
    from legacy.stapeskit.provenance import Hashes


def write_result(
    result: MassMeasurement,
    outputs: OutputSet,
    stage: Path,
    *,
    labels_file: str,
    report: bool = True,
    display: tuple[int | None, int | None] = (None, None),
    export: Sequence[str] = (),
    hashes: Hashes | None = None,
    sha256: bool = False,
    crop: EarlyCrop | None = None,
) -> tuple[list[str], dict[str, Any], tuple[Notice, ...]]:
    """Write every output into a folder; return their names, the content of mass.json, and new warnings.

    Parameters
    ----------
    result : MassMeasurement
    outputs : OutputSet
        Where they will be, for warnings about files that stay beside them.
    stage : Path
    labels_file : str
        `output_files.labels_name`.
    report : bool
        Write report.html, with the moments of the surface by another program.
    display : (int or None, int or None)
        Steps of smoothing and number of triangles of the surface for show; none without either.
    export : sequence of str
        Formats.
    hashes : Hashes, optional
        Of the inputs, when they were begun before; ``sha256`` is what they were begun with.
    crop : EarlyCrop, optional
        The part of the scan, when it may have been begun already.

    Raises
    ------
    StapeskitError
        An input has changed since it was read.
    """
    content = mass_json(result, sha256, hashes, report, labels_file)
    shown, names = None, []
    if display != (None, None):
        from legacy.ct_inertia.surface.display_surface import display_mesh

        mesh = display_mesh(result.stapes, *display)
        content["display_mesh"] = mesh.as_json()
        shown = mesh.surface
        write_surface(stage / DISPLAY, shown)
        names.append(DISPLAY)
    if export:
        from legacy.ct_inertia.exports import export as write_exports
        from legacy.ct_inertia.exports import units_of

        content["exports"] = units_of(export)
        names += write_exports(result, stage, export, shown)
    names += [REPORT] if report else []
    notices = (
        *_replaced_notices(outputs.folder / "mass.json", content),
        *outputs.kept_notices([*names_of(result, content), *names]),
    )
    content["warnings"] += [notice.as_json() for notice in notices]
    if report:
        from legacy.ct_inertia.report.sections import write_report

        write_report(stage / REPORT, result, content, shown)
    return [*write_outputs(result, stage, content, crop), *names], content, notices


def write_outputs(
    result: MassMeasurement, folder: Path, content: Mapping[str, Any], crop: EarlyCrop | None = None
) -> list[str]:
    """Write mass.json, surfaces, labels and the part of the scan under them; return their names.

    Parameters
    ----------
    result : MassMeasurement
    folder : Path
    content : mapping
        Of mass.json.
    crop : EarlyCrop, optional
        The part of the scan, when it may have been begun already.

    Raises
    ------
    StapeskitError
        An input has changed since it was read.
    """
    folder = Path(folder)
    (folder / "mass.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    write_surface(folder / "stapes.ply", result.stapes)
    if result.plate is not None:
        write_surface(folder / "plate.ply", result.plate)
    if result.bodies is not None:
        labels = content["labels_file"]
        result.bodies.labels.write(folder / labels)
        result.bodies.labels.write(folder / SEGMENTS[labels])
    if needs_crop(result.options) and result.bodies is not None:
        (crop or EarlyCrop(result.options, folder / SCAN_CROP)).finish(result.bodies)
    if result.inputs is not None:  # labels and pictures were read from the scan until here
        result.inputs.check()
    return names_of(result, content)


def _replaced_notices(earlier: Path, content: Mapping[str, Any]) -> tuple[Notice, ...]:
    """Report that the result of another scan is replaced: the usual folder is named after the scan alone."""
    try:
        before = json.loads(earlier.read_text(encoding="utf-8"))["provenance"]["inputs"]["scan"]
        now = content["provenance"]["inputs"]["scan"]
        if before["hash"] == now["hash"]:
            return ()
        was = f"{before['file']} of {before['modified']}"
    except (OSError, ValueError, KeyError, TypeError):
        return ()
    text = (
        f"{earlier.parent.name} held the result of another scan, {was}, which is replaced by this one. Give "
        f"each ear a folder of its own with {named('out')}."
    )
    return (Notice("other_result_replaced", text),)


def names_of(result: MassMeasurement, content: Mapping[str, Any]) -> list[str]:
    """Return the names of the files that `write_outputs` writes."""
    names = ["mass.json", "stapes.ply"]
    names += [] if result.plate is None else ["plate.ply"]
    if result.bodies is not None:
        names += [content["labels_file"], SEGMENTS[content["labels_file"]]]
    return names + ([SCAN_CROP] if result.bodies is not None and needs_crop(result.options) else [])
