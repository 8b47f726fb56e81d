"""A folder of numbered slice images, and the reconstruction log of Bruker/SkyScan beside them."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.scan.opened import Opened, ReadOptions
from ct_inertia.scan.place import mm_per_unit
from ct_inertia.scan.streams import by_planes
from ct_inertia.scan.tiff import check_palette, listening, plane_spacing, white_is_zero
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError, list_some
from stapeskit.warnings import Notice

SLICE_SUFFIXES = (".tif", ".tiff", ".png", ".bmp", ".jpg", ".jpeg")

_TIFF = (".tif", ".tiff")
_PREVIEW = re.compile(r"_spr$|_arc$|^\.", re.IGNORECASE)  # pictures that SkyScan's programs add
_RIVAL = 0.5  # share of the longest series from which on another one is no side product
_APART = "Put the slices of one scan into a folder of their own"
_LOGGED = {
    "slices": "Sections Count",
    "rows": r"Result Image Height \(pixels\)",
    "columns": r"Result Image Width \(pixels\)",
}


def open_file(folder: Path, options: ReadOptions) -> Opened:
    """Open a folder of slices; slice k is the k-th in the order of the number that differs in their names.

    Raises
    ------
    StapeskitError
        No slices, several series, a slice of another size or type, a damaged slice, or a reconstruction log
        that describes other slices.
    """
    files, notices = slice_files(folder)
    first = _pixels(files[0])
    opened = Opened((len(files), *first.shape), first.dtype, notices=notices)
    logs = sorted(folder.glob("*.log"))
    if options.spacing_mm is None:
        opened.spacing_mm, opened.known = log_spacing(logs, opened.shape)
    if files[0].suffix.lower() in _TIFF:
        import tifffile

        with listening(files[0]), tifffile.TiffFile(files[0]) as tif:
            check_palette(tif.pages[0], files[0])
            opened.white_is_zero = white_is_zero(tif.pages[0])
            if opened.spacing_mm is None and not logs:
                opened.spacing_mm, opened.known = plane_spacing(tif.pages[0])

    def decode(file: Path) -> NDArray[Any]:
        image = _pixels(file)
        if (image.shape, image.dtype) != (first.shape, first.dtype):
            wanted, step = f"{_look(first)} like {files[0].name}", "Remove it, or export it again"
            raise StapeskitError.of(f"slice {file.name}", wanted, _look(image), next_step=step)
        return image

    opened.read = by_planes(files, decode)
    return opened


def _look(image: NDArray[Any]) -> str:
    return f"{image.shape[1]} x {image.shape[0]} {image.dtype}"


def slice_files(folder: Path) -> tuple[list[Path], list[Notice]]:
    """Return the slices of the folder's numbered series in natural order, and what is odd about them.

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
    series: dict[tuple[str, str], list[tuple[int, Path]]] = defaultdict(list)
    for (number, name), path in zip(_numbers([path.stem for path in images]), images, strict=True):
        if number is not None:
            series[name, path.suffix.lower()].append((number, path))
    ranked = sorted(series, key=lambda name: (-len(series[name]), name))
    if not ranked or len(series[ranked[0]]) < 2:
        wanted = "a series of numbered slices (TIFF, PNG, BMP, JPEG) or a DICOM series"
        step = "Give the folder that holds the slices themselves"
        raise StapeskitError.of("the folder", wanted, f"{len(images)} image files", folder.name, step)
    if len(ranked) > 1 and len(series[ranked[1]]) >= max(2, _RIVAL * len(series[ranked[0]])):
        listed = ", ".join(f"{name}{end} ({len(series[name, end])} slices)" for name, end in ranked[:4])
        raise StapeskitError.of("the folder", "one series of numbered slices", listed, folder.name, _APART)
    chosen = sorted(series[ranked[0]])
    numbers = [number for number, _ in chosen]
    doubled = [number for number, count in Counter(numbers).items() if count > 1]
    if doubled:
        got, step = f"number {doubled[0]} twice", "Leave one series of slices in the folder"
        raise StapeskitError.of("the slice numbers", "unique", got, folder.name, step)
    notices = []
    others = len(images) - len(chosen)
    if others:
        text = f"{others} other image files in {folder.name} are not part of the series and were left out."
        notices.append(Notice("file_read", text))
    return [path for _, path in chosen], notices + _gaps(numbers, folder.name)


def _numbers(stems: Sequence[str]) -> list[tuple[int | None, str]]:
    """Return of each name the number that counts slices, and the name with ``#`` in its place.

    Notes
    -----
    Of the names that differ in numbers only, it is the last number that differs: ``ear_0042_8bit`` counts by
    its first one. A name without a number has none.
    """
    parts = [re.split(r"(\d+)", stem) for stem in stems]
    alike = defaultdict(list)
    for words in parts:
        alike[tuple(words[::2])].append(words[1::2])
    numbered: list[tuple[int | None, str]] = []
    for words, stem in zip(parts, stems, strict=True):
        columns = list(zip(*alike[tuple(words[::2])], strict=True))
        if not columns:
            numbered.append((None, stem))
            continue
        differing = [k for k, column in enumerate(columns) if len(set(column)) > 1]
        at = 2 * (differing[-1] if differing else len(columns) - 1) + 1
        numbered.append((int(words[at]), "".join([*words[:at], "#", *words[at + 1 :]])))
    return numbered


def _gaps(numbers: list[int], name: str) -> list[Notice]:
    step = Counter(np.diff(numbers).tolist()).most_common(1)[0][0]
    missing = sorted(set(range(numbers[0], numbers[-1] + 1, step)) - set(numbers))
    if missing:
        text = (
            f"{len(missing)} slices are missing in {name} (number {list_some(map(str, missing), 5)}): the "
            f"slices around each gap are taken as neighbours, which shortens the body there."
        )
        return [Notice("slices_missing", text)]
    if step == 1:
        return []
    text = (
        f"The slices in {name} are numbered in steps of {step}: where the others were left out, the "
        f"distance of slices is {step} times that of the scan."
    )
    return [Notice("file_read", text)]


def log_spacing(logs: Sequence[Path], shape: Sequence[int]) -> tuple[Array | None, str]:
    """Return the spacing (3,), mm, in the reconstruction log among these, and what they say without.

    Parameters
    ----------
    logs : sequence of Path
    shape : sequence of 3 int
        Number of slices, rows and columns, which the log must describe.

    Raises
    ------
    StapeskitError
        Every reconstruction log describes other slices.

    Notes
    -----
    The section ``[Reconstruction]`` counts: the pixel size of the acquisition is that of the projections, and
    nothing says that the slices were reconstructed at it.
    """
    sizes: dict[tuple[float, float], str] = {}
    known, fault = "slice images do not have it", None
    for log in logs:
        before, _, after = log.read_text(encoding="latin-1").partition("[Reconstruction]")
        size, projected = _pixel_mm(after), _pixel_mm(before)
        if size is None and projected is not None:
            known = (
                f"{log.name} is the log of the acquisition, whose {1e3 * projected:.6g} um are the "
                f"pixel size of the projections; nothing says at which size the slices were reconstructed"
            )
        if size is None:
            continue
        counts = {name: _log_number(after, key) for name, key in _LOGGED.items()}
        differing = {
            name: (count, held)
            for (name, count), held in zip(counts.items(), shape, strict=True)
            if count not in (None, held)
        }
        if differing:
            fault = _other_slices(log, differing)
        else:
            step = max(1.0, _log_number(after, "Section to Section Step") or 1.0)
            sizes.setdefault((size, step), log.name)
    if len(sizes) > 1:
        listed = ", ".join(f"{name} {1e3 * size:.6g} um" for (size, _), name in sizes.items())
        return None, f"the reconstruction logs disagree ({listed})"
    if not sizes and fault is not None:
        raise fault
    for size, step in sizes:
        return np.array([size, size, size * step]), ""
    return None, known


def _log_number(text: str, key: str) -> float | None:
    found = re.search(rf"^{key}\s*=\s*([0-9.,]+(?:[eE][-+]?\d+)?)\s*$", text, re.MULTILINE)
    try:
        return float(found[1].replace(",", ".")) if found else None
    except ValueError:
        return None


def _pixel_mm(text: str) -> float | None:
    """Return the pixel size in a section of a log, mm; its own wins over that of the images it came from."""
    for name in ("Pixel Size", r"(?:Scaled )?Image Pixel Size"):
        for unit in ("um", "mm"):
            value = _log_number(text, rf"{name} \({unit}\)")
            if value:
                return value * (mm_per_unit(unit) or 1.0)
    return None


def _other_slices(log: Path, differing: Mapping[str, tuple[float | None, int]]) -> StapeskitError:
    stated = ", ".join(f"{count:g} {name}" for name, (count, _) in differing.items())
    held = ", ".join(f"{held} {name}" for name, (_, held) in differing.items())
    return StapeskitError.of(
        "the slices",
        f"those that their reconstruction log describes ({stated})",
        held,
        log.name,
        "They were cropped, scaled or come from another scan: give their voxel size with --spacing, or copy "
        "the whole folder again",
    )


def _pixels(path: Path) -> NDArray[Any]:
    """Return the grey values of a slice; of three equal channels, or of grey and opacity, the first."""
    if path.suffix.lower() in _TIFF:
        import tifffile

        with listening(path):
            image = np.asarray(tifffile.imread(path))
    else:
        from PIL import Image

        try:
            with Image.open(path) as picture:
                image = np.asarray(picture if picture.mode != "P" else picture.convert("RGB"))
        except Exception as fault:
            got, step = f"a truncated or damaged file of {path.stat().st_size} bytes", "Copy it again"
            raise StapeskitError.of("the slice", "a readable image", got, path.name, step) from fault
    if image.ndim == 3 and image.shape[-1] in (2, 3, 4):
        if image.shape[-1] > 2 and np.any(image[..., 1:3] != image[..., :1]):
            got = "a colour (RGB) image"
            raise StapeskitError.of(f"slice {path.name}", "grey values", got, next_step="Export grey values")
        image = np.ascontiguousarray(image[..., 0])
    if image.ndim != 2:
        got, step = f"shape {' x '.join(map(str, image.shape))}", "Give a stack as a file, not in a folder"
        raise StapeskitError.of(f"slice {path.name}", "one two-dimensional image", got, next_step=step)
    return image.astype(np.uint8 if image.dtype.kind == "b" else image.dtype.newbyteorder("="), copy=False)
