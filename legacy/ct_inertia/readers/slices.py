"""A folder of slice images in natural order of their numbers, each read when it is asked for."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.readers.checks import check_memory, check_size, settle_spacing
from legacy.ct_inertia.readers.formats import ReadOptions
from legacy.ct_inertia.readers.memory_mapping import read_at
from legacy.ct_inertia.readers.ome import Calibration
from legacy.ct_inertia.readers.refusals import not_readable
from legacy.ct_inertia.readers.skyscan import log_spacing
from legacy.ct_inertia.readers.tiff_directories import check_directories, packing_of
from legacy.ct_inertia.readers.tiff_log import listening
from legacy.ct_inertia.readers.tiff_pages import (
    check_offsets,
    check_palette,
    check_pieces,
    plane_calibration,
    turned_notice,
    white_is_zero,
)
from legacy.ct_inertia.volume.lazy_arrays import BlockArray, invert_grey_values
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.faults import list_some
from legacy.stapeskit.warnings import Notice

SLICE_SUFFIXES = (".tif", ".tiff", ".png", ".bmp", ".jpg", ".jpeg")
_TIFF = (".tif", ".tiff")
# SkyScan's preview of a reconstruction lies among the slices.
_PREVIEW = re.compile(r"_spr$|_arc$|^\.", re.I)
# Share of the longest series from which on another one in the folder is no side product.
_RIVAL = 0.5


@dataclass(frozen=True)
class _Look:
    """Rows and columns, type, packing, and where the pixels start when they lie in one piece (else None)."""

    shape: tuple[int, int]
    dtype: np.dtype
    packing: str = "any"
    offset: int | None = None


def read(folder: Path, options: ReadOptions) -> Volume:
    """Read a folder of slices; slice k is the k-th in the order of the last number in its name.

    Raises
    ------
    CtInertiaError
        No slices, several series, slices of different size or type, a damaged slice, or no spacing given.
    """
    files, notices = slice_files(folder)
    from_log, (turned, tagged) = log_spacing(folder), _tags_of(files[0])
    stated = tagged.spacing_mm if from_log is None else from_log
    spacing, settled = settle_spacing(stated, options.spacing_mm, folder.name, tagged.known)
    array = stacked_slices(files)
    if turned:
        array, notices = invert_grey_values(array), [*notices, turned_notice(files[0])]
    volume = Volume(array, spacing, np.zeros(3), np.eye(3), source=folder, notices=(*notices, *settled))
    return volume.mirrored(options.mirror)


def recognises(folder: Path) -> bool:
    """Return True: a folder of no other format is one of slices, or the error says what it should hold."""
    return folder.is_dir()


def _tags_of(path: Path) -> tuple[bool, Calibration]:
    """Return whether 0 is white in a slice, and the spacing that its tags state."""
    if path.suffix.lower() not in _TIFF:
        return False, Calibration(None, known="slice images do not have it")
    import tifffile

    with listening(path, "slice image"), tifffile.TiffFile(path) as tif:
        return white_is_zero(tif.pages[0]), plane_calibration(tif.pages[0])


def slice_files(folder: Path) -> tuple[list[Path], list[Notice]]:
    """Return the slices of the folder's numbered series in natural order, and what is odd."""
    series: dict[tuple[str, str], list[tuple[int, Path]]] = defaultdict(list)
    images = [
        p
        for p in folder.iterdir()
        if p.is_file() and p.suffix.lower() in SLICE_SUFFIXES and not _PREVIEW.search(p.stem)
    ]
    for (number, name), path in zip(_number([path.stem for path in images]), images, strict=True):
        if number is not None:
            series[name, path.suffix.lower()].append((number, path))
    if not series or max(len(v) for v in series.values()) < 2:
        raise CtInertiaError.of(
            "the folder",
            "a series of numbered slices (TIFF, PNG, BMP, JPEG) or a DICOM series",
            f"{len(images)} image files",
            folder.name,
            "Give the folder that holds the slices themselves",
        )
    ranked = sorted(series, key=lambda name: (-len(series[name]), name))
    if len(ranked) > 1 and len(series[ranked[1]]) >= max(2, _RIVAL * len(series[ranked[0]])):
        listed = ", ".join(f"{name}{end} ({len(series[name, end])} slices)" for name, end in ranked[:4])
        raise CtInertiaError.of(
            "the folder",
            "one series of numbered slices",
            listed,
            folder.name,
            "Put the slices of one scan into a folder of their own",
        )
    chosen = sorted(series[ranked[0]], key=lambda pair: (pair[0], pair[1].name))
    numbers = [number for number, _ in chosen]
    doubled = [number for number, count in Counter(numbers).items() if count > 1]
    if doubled:
        raise CtInertiaError.of(
            "the slice numbers",
            "unique",
            f"number {doubled[0]} twice",
            folder.name,
            next_step="Leave one series of slices in the folder",
        )
    notices = []
    others = len(images) - len(chosen)
    if others:
        text = f"{others} other image files in {folder.name} are not part of the series and were left out."
        notices.append(Notice("files_ignored", text))
    notices += _gaps(numbers, folder.name)
    return [path for _, path in chosen], notices


def _number(stems: Sequence[str]) -> list[tuple[int | None, str]]:
    """Return of each name the number that counts slices, and the name with ``#`` in its place.

    Notes
    -----
    Of the names that differ in numbers only, it is the last number that differs: ``ear_0042_8bit`` counts
    by its first one. A name without a number has none.
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
    if not missing and step > 1:
        text = (
            f"The slices in {name} are numbered in steps of {step}: where the others were left out, the "
            f"distance of slices is {step} times that of the scan."
        )
        return [Notice("slices_in_steps", text)]
    if not missing:
        return []
    text = (
        f"{len(missing)} slices are missing in {name} (number {list_some(map(str, missing), 5)}): the slices "
        "around each gap are taken as neighbours, which shortens the body there."
    )
    return [Notice("slices_missing", text)]


def stacked_slices(files: Sequence[Path]) -> NDArray[Any]:
    """Return the slices as one array [z, y, x] in their own type, read when they are asked for."""
    looks = [_look(path) for path in files]
    first = looks[0]
    for path, look in zip(files, looks, strict=True):
        if look.shape != first.shape or look.dtype != first.dtype:
            raise _different(path, look.shape, look.dtype, files[0], first)
    for path, look in zip(files, looks, strict=True):
        check_size((1, *look.shape), look.dtype, path.stat().st_size, path.name, packing=look.packing)
    check_memory(2 * first.shape[0] * first.shape[1] * first.dtype.itemsize, files[0].name)

    def plane(z: int, _y: int, _x: int) -> NDArray[Any]:
        path, look = files[z], looks[z]
        if look.offset is not None:
            data = read_at(path, look.offset, look.shape[0] * look.shape[1] * look.dtype.itemsize)
            return np.ndarray((1, *look.shape), look.dtype, data)
        image = _slice(path)
        if image.shape != first.shape or image.dtype.newbyteorder("=") != first.dtype.newbyteorder("="):
            raise _different(path, image.shape, image.dtype, files[0], first)
        return image[None]

    return BlockArray((len(files), *first.shape), first.dtype, (1, *first.shape), plane).as_array()


def _different(
    path: Path, shape: tuple[int, ...], dtype: np.dtype, other: Path, expected: _Look
) -> CtInertiaError:
    return CtInertiaError.of(
        f"slice {path.name}",
        f"{expected.shape[1]} x {expected.shape[0]} {expected.dtype.newbyteorder('=')} like {other.name}",
        f"{' x '.join(map(str, shape[::-1]))} {dtype.newbyteorder('=')}",
        next_step="Remove it from the folder or export it again",
    )


def _look(path: Path) -> _Look:
    """Return size and type of a slice from its header; a picture in colours is read as a whole."""
    try:
        look = _tiff_look(path) if path.suffix.lower() in _TIFF else _picture_look(path)
    except CtInertiaError:
        raise
    except Exception as fault:
        raise not_readable(path, "slice image", fault) from fault
    if look is not None:
        return look
    image = _slice(path)
    return _Look((image.shape[0], image.shape[1]), image.dtype)


def _tiff_look(path: Path) -> _Look | None:
    import tifffile

    check_directories(path)
    with listening(path, "slice image"), tifffile.TiffFile(path) as tif:
        page: Any = tif.pages[0]
        check_palette(page, path)
        check_pieces(page, path)
        check_offsets(page, path, path.stat().st_size)
        if len(tif.pages) != 1 or page.ndim != 2 or page.dtype is None or page.dtype.kind == "b":
            dtype, stored = page.dtype or np.dtype(bool), path.stat().st_size
            check_size(page.shape, dtype, stored, path.name, packing=packing_of(page), in_memory=True)
            return None
        dtype = np.dtype(tif.byteorder + page.dtype.char)
        whole = page.is_contiguous and page.bitspersample >= 8
        if whole:
            needed = int(page.dataoffsets[0]) + int(np.prod(page.shape)) * dtype.itemsize
            if needed > path.stat().st_size:
                raise not_readable(path, "slice image", EOFError())
        return _Look(page.shape, dtype, packing_of(page), int(page.dataoffsets[0]) if whole else None)


def _picture_look(path: Path) -> _Look | None:
    from PIL import Image

    known = {"L": "u1", "I;16": "<u2", "I;16B": "<u2", "I": "i4", "F": "f4"}
    packing = "deflate" if path.suffix.lower() == ".png" else "any"
    with Image.open(_in_memory(path)) as image:
        if image.mode not in known:
            shape = (image.height, image.width, len(image.getbands()))
            check_size(
                shape, np.dtype(np.uint8), path.stat().st_size, path.name, packing=packing, in_memory=True
            )
            return None
        return _Look((image.height, image.width), np.dtype(known[image.mode]), packing)


def _in_memory(path: Path) -> BytesIO:
    """Return the bytes of a picture: to read a length that it claims takes no more room than it has bytes.

    Pillow reads what is left of a PNG's data in one piece of the length that its chunk claims, up to 4 GiB.
    """
    return BytesIO(path.read_bytes())


def _slice(path: Path) -> NDArray[Any]:
    try:
        if path.suffix.lower() in _TIFF:
            import tifffile

            with listening(path, "slice image"):
                image = tifffile.imread(path)
        else:
            from imageio.v3 import imread

            image = imread(_in_memory(path), extension=path.suffix.lower())
    except CtInertiaError:
        raise
    except Exception as fault:
        raise not_readable(path, "slice image", fault) from fault
    image = np.asarray(image)
    if image.dtype.kind == "b":
        image = image.astype(np.uint8)
    if image.ndim == 3 and image.shape[-1] in (2, 3, 4):
        # Two values are grey and opacity.
        if image.shape[-1] == 2 or np.all(image[..., 1:3] == image[..., :1]):
            return np.ascontiguousarray(image[..., 0])
        raise CtInertiaError.of(
            f"slice {path.name}", "grey values", "a colour (RGB) image", next_step="Export grey values"
        )
    if image.ndim != 2:
        raise CtInertiaError.of(
            f"slice {path.name}",
            "one two-dimensional image",
            f"shape {image.shape}",
            next_step="Give a stack as a file, not in a folder",
        )
    return image
