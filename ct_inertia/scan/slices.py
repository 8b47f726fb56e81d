"""A folder of numbered slice images, and the reconstruction log of Bruker/SkyScan beside them."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.place import mm_per_unit
from ct_inertia.scan.stored import Stored, by_planes, native
from ct_inertia.scan.tiff import listening, read_page_tags
from stapeskit.faults import StapeskitError, list_some

SLICE_SUFFIXES = (".tif", ".tiff", ".png", ".bmp", ".jpg", ".jpeg")

_TIFF = (".tif", ".tiff")
_PREVIEW = re.compile(r"_spr$|_arc$|^\.", re.IGNORECASE)  # pictures that SkyScan's programs add
_RIVAL = 0.5  # share of the longest series from which on another one is no side product
_LOGGED = {
    "slices": "Sections Count",
    "rows": r"Result Image Height \(pixels\)",
    "columns": r"Result Image Width \(pixels\)",
}
_APART = "Put the slices of one scan into a folder of their own"


def open_slices(folder: Path) -> Stored:
    """Open a folder of slices; slice k is the k-th in the order of the number that differs in their names."""
    files, numbers, others = _series(folder)
    first = _pixels(files[0])
    stored = Stored((len(files), *first.shape), first.dtype)
    if others:
        stored.note(f"{others} other image files in {folder.name} are not part of the series: left out.")
    _note_gaps(stored, numbers, folder.name)
    logs = sorted(file for file in folder.iterdir() if file.suffix.lower() == ".log")
    if files[0].suffix.lower() in _TIFF:
        import tifffile

        with listening(files[0]), tifffile.TiffFile(files[0]) as tif:
            read_page_tags(stored, tif.pages[0])
    if logs or not stored.known:
        _read_logs(stored, logs)

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
    """Return the slices of the only numbered series, their numbers, and the count of other images.

    Raises
    ------
    StapeskitError
        No series, two of them, or a number twice.
    """
    images = [
        path
        for path in sorted(folder.iterdir())
        if path.is_file() and path.suffix.lower() in SLICE_SUFFIXES and not _PREVIEW.search(path.stem)
    ]
    series = _numbered(images)
    ranked = sorted(series, key=lambda name: (-len(series[name]), name))
    if not ranked or len(series[ranked[0]]) < 2:
        wanted = "a series of numbered slices (TIFF, PNG, BMP, JPEG) or a DICOM series"
        raise StapeskitError.of("the folder", wanted, f"{len(images)} image files", next_step=_APART)
    if len(ranked) > 1 and len(series[ranked[1]]) >= max(2, _RIVAL * len(series[ranked[0]])):
        listed = ", ".join(f"{name} ({len(series[name])} slices)" for name in ranked[:4])
        raise StapeskitError.of("the folder", "one series of numbered slices", listed, next_step=_APART)
    chosen = sorted(series[ranked[0]])
    numbers = [number for number, _ in chosen]
    doubled = [number for number, count in Counter(numbers).items() if count > 1]
    if doubled:
        raise StapeskitError.of("the slice numbers", "unique", f"number {doubled[0]} twice", next_step=_APART)
    return [path for _, path in chosen], numbers, len(images) - len(chosen)


def _numbered(images: Sequence[Path]) -> dict[str, list[tuple[int, Path]]]:
    """Return number and file of the slices of each series, by its name with ``#`` in place of the number.

    Of names that differ in numbers only, the last number that differs counts the slices: ``ear_0042_8bit``
    counts by its first one. A name without a number is no slice.
    """
    alike = defaultdict(list)
    for path in images:
        words = re.split(r"(\d+)", path.stem)  # every second one is a number
        if len(words) > 1:
            alike[tuple(words[::2]), path.suffix.lower()].append((words, path))
    series: dict[str, list[tuple[int, Path]]] = defaultdict(list)
    for (_, ending), group in alike.items():
        places = range(1, len(group[0][0]), 2)
        at = max((k for k in places if len({words[k] for words, _ in group}) > 1), default=places[-1])
        for words, path in group:
            name = "".join([*words[:at], "#", *words[at + 1 :], ending])
            series[name].append((int(words[at]), path))
    return series


def _note_gaps(stored: Stored, numbers: list[int], name: str) -> None:
    step = Counter(np.diff(numbers).tolist()).most_common(1)[0][0]
    missing = sorted(set(range(numbers[0], numbers[-1] + 1, step)) - set(numbers))
    if missing:
        text = (
            f"{len(missing)} slices are missing in {name} (number {list_some(map(str, missing), 5)}): the "
            f"slices around each gap are taken as neighbours, which shortens the body there."
        )
        stored.note(text, "slices_missing")
    elif step > 1:
        stored.note(
            f"The slices in {name} are numbered in steps of {step}: where the others were left out, the "
            f"distance of slices is {step} times that of the scan."
        )


def _read_logs(stored: Stored, logs: Sequence[Path]) -> None:
    """Set the spacing of the reconstruction log among these, or say why none counts.

    The section ``[Reconstruction]`` counts: the pixel size of the acquisition is that of the projections, and
    nothing says that the slices were reconstructed at it.
    """
    sizes: dict[tuple[float, float], str] = {}
    acquired, other_slices = "", ""
    for log in logs:
        before, _, after = log.read_text(encoding="latin-1").partition("[Reconstruction]")
        size, projected = _pixel_mm(after), _pixel_mm(before)
        stated = [_number(after, key) for key in _LOGGED.values()]
        other = ", ".join(
            f"{held} {name}, not the {count:g} of {log.name}"
            for name, held, count in zip(_LOGGED, stored.shape, stated, strict=True)
            if count not in (None, held)
        )
        if size is not None and other:
            other_slices = f"slices are missing, were cropped or scaled, or come from another scan: {other}"
        elif size is not None:
            sizes.setdefault((size, max(1.0, _number(after, "Section to Section Step") or 1.0)), log.name)
        elif projected is not None:
            acquired = (
                f"{log.name} is the log of the acquisition, whose {1e3 * projected:.6g} um are the "
                f"pixel size of the projections; nothing says at which size the slices were reconstructed"
            )
    stored.spacing_mm = None
    stored.known = other_slices or acquired or "slice images do not have it"
    if len(sizes) > 1:
        listed = ", ".join(f"{name} {1e3 * size:.6g} um" for (size, _), name in sizes.items())
        stored.known = f"the reconstruction logs disagree ({listed})"
    for size, step in sizes if len(sizes) == 1 else ():
        stored.spacing_mm = np.array([size, size, size * step])


def _number(text: str, key: str) -> float | None:
    found = re.search(rf"^{key}\s*=\s*(\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?)\s*$", text, re.MULTILINE)
    return float(found[1].replace(",", ".")) if found else None


def _pixel_mm(text: str) -> float | None:
    """Return the pixel size in a section of a log, mm; its own wins over that of the images it came from."""
    for name in ("Pixel Size", r"(?:Scaled )?Image Pixel Size"):
        for unit in ("um", "mm"):
            value = _number(text, rf"{name} \({unit}\)")
            if value:
                return value * (mm_per_unit(unit) or 1.0)
    return None


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
