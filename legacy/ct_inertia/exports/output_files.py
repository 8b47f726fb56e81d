"""The files that a run of `ct2mass` may write, and the name of its labels."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from legacy.stapeskit.option_names import named

if TYPE_CHECKING:
    from legacy.ct_inertia.options import MassOptions
    from legacy.stapeskit.own_files import OutputSet

LABELS, MEASURED_LABELS = "labels.nrrd", "labels.measured.nrrd"
SEGMENTS = {LABELS: "labels.seg.nrrd", MEASURED_LABELS: "labels.measured.seg.nrrd"}
"""The segmentation with names and colours beside each name of the labels."""
SCAN_CROP = "scan_crop.nrrd"
RESULT = ("mass.json", "stapes.ply", "plate.ply", LABELS, MEASURED_LABELS, *SEGMENTS.values(), SCAN_CROP)
"""Files that the next commands read together; one of another origin among them would be taken for a part."""
REPORT, DISPLAY = "report.html", "stapes_display.ply"
_CORRECTED = (LABELS, SEGMENTS[LABELS])


def labels_name(folder: Path, given: Path | None) -> str:
    """Return the name of the labels of this run in the output folder.

    Labels that were corrected in place and are given as ``--labels`` stay as they are: what is measured from
    them is written beside them.
    """
    for name in _CORRECTED:
        kept = Path(folder) / name
        if given is not None and kept.exists() and Path(given).exists() and os.path.samefile(kept, given):
            return MEASURED_LABELS
    return LABELS


def result_names(labels: str) -> tuple[str, ...]:
    """Return the files of a result whose labels have this name: without those of the user."""
    return tuple(name for name in RESULT if labels == LABELS or name not in _CORRECTED)


def output_set(
    options: MassOptions,
    folder: Path,
    *,
    report: bool = True,
    display: bool = False,
    exports: Sequence[str] = (),
    force: bool = False,
    config: Path | None = None,
) -> OutputSet:
    """Return the files that a run may write, and those that runs with other options may have left.

    Parameters
    ----------
    options : MassOptions
        They name the inputs.
    folder : Path
    report, display : bool
        Whether the report, and the surface for show, are written.
    exports : sequence of str
        Formats.
    force : bool
        Replace files that are not known as made by the command.
    config : Path, optional
        The file of options, another input.
    """
    from legacy.ct_inertia.exports import FILES, files_of
    from legacy.stapeskit.own_files import OutputSet

    more = [name for name, wanted in ((REPORT, report), (DISPLAY, display)) if wanted]
    names = (*result_names(labels_name(folder, options.labels)), *more, *files_of(exports))
    leftovers = tuple(name for name in (REPORT, DISPLAY, *_CORRECTED, *FILES) if name not in names)
    read = tuple(path for path in (*options.inputs.values(), config) if path is not None)
    hints = {
        name: f"Measure corrected labels with {named('labels')} {folder / name}, which stay as they are"
        for name in _CORRECTED
    }
    return OutputSet("ct2mass", folder, names, read, force, leftovers, hints=hints)
