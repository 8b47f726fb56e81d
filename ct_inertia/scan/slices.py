"""A folder of numbered slice images, and the reconstruction log of Bruker/SkyScan beside them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.numbers import note_gaps, numbered
from ct_inertia.scan.stored import Stored, by_planes, native
from ct_inertia.scan.tiff import describe_slice, listening
from stapeskit.faults import StapeskitError

SLICE_SUFFIXES = (".tif", ".tiff", ".png", ".bmp", ".jpg", ".jpeg", ".jp2")

_TIFF = (".tif", ".tiff")
_PREVIEW = re.compile(r"_spr$|_arc$|^\.", re.IGNORECASE)  # pictures that SkyScan's programs add
_RIVAL = 0.5  # share of the longest series from which on another one is no side product
_LOGGED = {
    "slices": "Sections Count",
    "rows": r"Result Image Height \(pixels\)",
    "columns": r"Result Image Width \(pixels\)",
}
_PIXEL = {
    rf"{name} \({unit}\)": mm
    for name in ("Pixel Size", r"(?:Scaled )?Image Pixel Size")
    for unit, mm in (("um", 1e-3), ("mm", 1.0))
}
"""Keys of a pixel size, its own before that of the images it came from, and their units in mm."""
_APART = "Put the slices of one scan into a folder of their own"


def open_slices(folder: Path) -> Stored:
    """Open a folder of slices; slice k is the k-th in the order of the number that differs in their names."""
    files, numbers, others = _series(folder)
    first = _pixels(files[0])
    stored = Stored((len(files), *first.shape), first.dtype, known="slice images do not have it")
    if others:
        stored.note(f"{others} other image files in {folder.name} are not part of the series: left out.")
    note_gaps(stored, numbers, folder.name)
    if files[0].suffix.lower() in _TIFF:
        describe_slice(stored, files[0])
    _read_logs(stored, sorted(file for file in folder.iterdir() if file.suffix.lower() == ".log"))

    def decode(file: Path) -> NDArray[Any]:
        image = _pixels(file)
        look, wanted = (f"{one.shape[1]} x {one.shape[0]} {one.dtype}" for one in (image, first))
        if look != wanted:
            wanted, step = f"{wanted} like {files[0].name}", "Remove it, or export it again"
            raise StapeskitError.of(f"slice {file.name}", wanted, look, next_step=step)
        return image

    stored.voxels = by_planes(files, decode)
    return stored


def _series(folder: Path) -> tuple[list[Path], list[int], int]:
    """Return the slices of the only numbered series, their numbers, and the count of other images."""
    images = [
        path
        for path in sorted(folder.iterdir())
        if path.is_file() and path.suffix.lower() in SLICE_SUFFIXES and not _PREVIEW.search(path.stem)
    ]
    series = numbered(images)
    ranked = sorted(series, key=lambda name: (-len(series[name]), name))
    if not ranked or len(series[ranked[0]]) < 2:
        wanted = "a series of numbered slices (TIFF, PNG, BMP, JPEG) or a DICOM series"
        step = "Give the folder that holds the slices of one scan themselves, and no others"
        raise StapeskitError.of("the folder", wanted, f"{len(images)} image files", next_step=step)
    if len(ranked) > 1 and len(series[ranked[1]]) >= max(2, _RIVAL * len(series[ranked[0]])):
        listed = ", ".join(f"{name} ({len(series[name])} slices)" for name in ranked[:4])
        raise StapeskitError.of("the folder", "one series of numbered slices", listed, next_step=_APART)
    chosen = sorted(series[ranked[0]])
    numbers = [number for number, _ in chosen]
    doubled = [number for number, count in Counter(numbers).items() if count > 1]
    if doubled:
        raise StapeskitError.of("the slice numbers", "unique", f"number {doubled[0]} twice", next_step=_APART)
    return [path for _, path in chosen], numbers, len(images) - len(chosen)


def _read_logs(stored: Stored, logs: Sequence[Path]) -> None:
    """Set the spacing of the reconstruction log among these, or say why none counts.

    The section ``[Reconstruction]`` counts: the pixel size of the acquisition is that of the projections, and
    nothing says that the slices were reconstructed at it.
    """
    sizes: dict[tuple[float, float], str] = {}
    for log in logs:
        before, _, after = log.read_text(encoding="latin-1").partition("[Reconstruction]")
        size, projected = _pixel_mm(after), _pixel_mm(before.partition("[Acquisition]")[2])
        stated = [_number(after, key) for key in _LOGGED.values()]
        other = ", ".join(
            f"{held} {name}, not the {count:g} of {log.name}"
            for name, held, count in zip(_LOGGED, stored.shape, stated, strict=True)
            if count not in (None, held)
        )
        if size and other:
            stored.spacing_mm = None
            stored.known = f"slices are missing, were cropped or scaled, or come from another scan: {other}"
        elif size:
            sizes.setdefault((size, max(1.0, _number(after, "Section to Section Step") or 1.0)), log.name)
        elif projected and stored.spacing_mm is None:
            stored.known = (
                f"{log.name} is the log of the acquisition, whose {1e3 * projected:.6g} um are the "
                f"pixel size of the projections; nothing says at which size the slices were reconstructed"
            )
    if sizes:
        (size, step), *more = sizes
        stored.spacing_mm = None if more else np.array([size, size, size * step])
        listed = ", ".join(f"{name} {1e3 * size:.6g} um" for (size, _), name in sizes.items())
        stored.known = f"the reconstruction logs disagree ({listed})"


def _number(text: str, key: str) -> float | None:
    found = re.search(rf"^{key}\s*=\s*(\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?)\s*$", text, re.MULTILINE)
    return float(found[1].replace(",", ".")) if found else None


def _pixel_mm(text: str) -> float:
    """Return the pixel size in a section of a log, mm; 0 where it has none."""
    return next((value * mm for key, mm in _PIXEL.items() if (value := _number(text, key))), 0.0)


def _pixels(path: Path) -> NDArray[Any]:
    """Return the grey values of a slice; of three equal channels, or of grey and opacity, the first."""
    try:
        if path.suffix.lower() in _TIFF:
            import tifffile

            with listening(path):
                image = np.asarray(tifffile.imread(path))
        else:
            from PIL import Image

            with Image.open(path) as picture:
                image = np.asarray(picture if picture.mode != "P" else picture.convert("RGB"))
    except (StapeskitError, MemoryError):
        raise
    except Exception as fault:
        got, step = f"a truncated or damaged file of {path.stat().st_size} bytes", "Copy it again"
        raise StapeskitError.of("the slice", "a readable image", got, path.name, step) from fault
    if image.ndim == 3 and image.shape[-1] in (2, 3, 4):
        if image.shape[-1] > 2 and np.any(image[..., 1:3] != image[..., :1]):
            step = "Export grey values"
            raise StapeskitError.of(f"slice {path.name}", "grey values", "a colour image", next_step=step)
        image = np.ascontiguousarray(image[..., 0])
    if image.ndim != 2:
        got, step = f"shape {' x '.join(map(str, image.shape))}", "Give a stack as a file, not in a folder"
        raise StapeskitError.of(f"slice {path.name}", "one two-dimensional image", got, next_step=step)
    return native(image)
