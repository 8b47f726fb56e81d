"""A folder of slice images in natural order of their numbers, with the SkyScan log beside them."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ct_inertia.errors import CtInertiaError
from ct_inertia.readers.checks import check_size, not_readable, settle_spacing
from ct_inertia.volume import Volume
from kinematics.errors import sentence
from kinematics.notices import Notice

SLICE_SUFFIXES = (".tif", ".tiff", ".png", ".bmp", ".jpg", ".jpeg")


def read_slices(folder: Path, spacing_mm: Sequence[float] | None = None) -> Volume:
    """Read a folder of slices; slice k is the k-th in the order of the last number in its name.

    Raises
    ------
    CtInertiaError
        No slices, slices of different size or type, a damaged slice, or no spacing given.
    """
    files, notices = slice_files(folder)
    found = log_spacing(folder)
    spacing, settled = settle_spacing(found, spacing_mm, folder.name, "slice images do not tell it")
    array = stacked_slices(files)
    return Volume(array, spacing, np.zeros(3), np.eye(3), source=folder, notices=(*notices, *settled))


def log_spacing(folder: Path) -> NDArray[np.float64] | None:
    """Return the voxel spacing that a Bruker/SkyScan reconstruction log in the folder tells, mm.

    The pixel size of the reconstruction, in um, times the step from section to section along z.
    """
    found: set[tuple[float, float]] = set()
    for path in sorted(folder.glob("*.log")):
        text = path.read_text(encoding="latin-1")
        part = text.partition("[Reconstruction]")[2]
        pixel = re.search(r"^Pixel Size \(um\)\s*=\s*([0-9.]+)", part, re.M)
        step = re.search(r"^Section to Section Step\s*=\s*([0-9.]+)", part, re.M)
        if pixel and float(pixel[1]) > 0.0:
            found.add((float(pixel[1]) * 1e-3, float(step[1]) if step else 1.0))
    if len(found) != 1:
        return None
    ((size, ratio),) = found
    return np.array([size, size, size * ratio])


def slice_files(folder: Path) -> tuple[list[Path], list[Notice]]:
    """Return the slices of the folder's largest numbered series in natural order, and what is odd."""
    series: dict[tuple[str, str], list[tuple[int, Path]]] = defaultdict(list)
    images = [p for p in folder.iterdir() if p.is_file() and p.suffix.lower() in SLICE_SUFFIXES]
    for path in images:
        match = re.match(r"^(.*?)(\d+)(\D*)$", path.stem)
        if match and not path.name.startswith("."):
            series[(match[1] + "#" + match[3], path.suffix.lower())].append((int(match[2]), path))
    if not series or max(len(v) for v in series.values()) < 2:
        raise CtInertiaError(
            sentence(
                "the folder",
                "a series of numbered slices (TIFF, PNG, BMP, JPEG) or a DICOM series",
                f"{len(images)} image files",
                folder.name,
                "Give the folder that holds the slices themselves",
            )
        )
    chosen = sorted(
        series[max(series, key=lambda name: len(series[name]))], key=lambda pair: (pair[0], pair[1].name)
    )
    numbers = [number for number, _ in chosen]
    doubled = [number for number, count in Counter(numbers).items() if count > 1]
    if doubled:
        raise CtInertiaError(
            sentence(
                "the slice numbers",
                "unique",
                f"number {doubled[0]} twice",
                folder.name,
                next_step="Leave one series of slices in the folder",
            )
        )
    notices = []
    others = len(images) - len(chosen)
    if others:
        text = f"{others} other image files in {folder.name} are not part of the series and were left out."
        notices.append(Notice("files_ignored", text))
    notices += _gaps(numbers, folder.name)
    return [path for _, path in chosen], notices


def _gaps(numbers: list[int], name: str) -> list[Notice]:
    step = Counter(np.diff(numbers).tolist()).most_common(1)[0][0]
    missing = sorted(set(range(numbers[0], numbers[-1] + 1, step)) - set(numbers))
    if not missing:
        return []
    shown = ", ".join(map(str, missing[:5])) + (" ..." if len(missing) > 5 else "")
    text = (
        f"{len(missing)} slices are missing in {name} (number {shown}): the slices around each gap are taken "
        f"as neighbours, which shortens the body there."
    )
    return [Notice("slices_missing", text)]


def stacked_slices(files: Sequence[Path]) -> NDArray[Any]:
    """Return the slices as one array [z, y, x] in their own type."""
    first = _slice(files[0])
    stored = sum(path.stat().st_size for path in files)
    check_size((len(files), *first.shape), first.dtype, stored, True, files[0].parent.name)
    array = np.empty((len(files), *first.shape), dtype=first.dtype)
    for k, path in enumerate(files):
        image = _slice(path)
        if image.shape != first.shape or image.dtype != first.dtype:
            raise CtInertiaError(
                sentence(
                    f"slice {path.name}",
                    f"{first.shape[1]} x {first.shape[0]} {first.dtype} like {files[0].name}",
                    f"{' x '.join(map(str, image.shape[::-1]))} {image.dtype}",
                    next_step="Remove it from the folder or export it again",
                )
            )
        array[k] = image
    return array


def _slice(path: Path) -> NDArray[Any]:
    try:
        if path.suffix.lower() in (".tif", ".tiff"):
            import tifffile

            image = tifffile.imread(path)
        else:
            from imageio.v3 import imread

            image = imread(path)
    except Exception as fault:
        raise not_readable(path, "slice image", fault) from fault
    image = np.asarray(image)
    if image.ndim == 3 and image.shape[-1] in (3, 4) and image.dtype == np.uint8:
        if np.array_equal(image[..., 0], image[..., 1]) and np.array_equal(image[..., 0], image[..., 2]):
            return np.ascontiguousarray(image[..., 0])
        raise CtInertiaError(
            sentence(
                f"slice {path.name}", "grey values", "a colour (RGB) image", next_step="Export grey values"
            )
        )
    if image.ndim != 2:
        raise CtInertiaError(
            sentence(
                f"slice {path.name}",
                "one two-dimensional image",
                f"shape {image.shape}",
                next_step="Give a stack as a file, not in a folder",
            )
        )
    return image
