"""Label volumes: which number is which body, and segmentations that lie on the scan in 3D Slicer."""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError

SEGMENTS = {
    1: ("stapes", "0.90 0.62 0.00"),
    2: ("plate", "0.34 0.71 0.91"),
    3: ("other bone", "0.80 0.47 0.65"),
}
"""Name and colour (red, green, blue) of each label: colours of Okabe and Ito, for colour-blind readers."""

_GZIP = 31  # wbits of zlib: the widest window (15), with the header of gzip (16)
_STAPES, _PLATE = 1, 2  # of labels without names: as this package writes them
_AUTOMATIC = re.compile(r"(segment|label|region|object|mask|class|material|inside|exterior)?[\s_-]*\d*", re.I)
_STAPES_NAME = re.compile(r"stapes|stapedi", re.I)
_PLATE_NAME = re.compile(r"(?<!foot)(?<!foot[ _-])plate", re.I)
_PART = re.compile(
    r"stapes|stapedi|foot[\s_-]*plate|fu(ss|ß)platte|(anterior|posterior)[\s_-]*crus|"
    r"crus[\s_-]*(anterius|posterius)|crura|superstructure",
    re.I,
)
_SOFT = re.compile(r"stapedius|stapedial|tendon|muscle|nerve|artery|ligament|incus", re.I)


def body_numbers(
    names: Mapping[int, str], present: Sequence[int], stapes: int | None, plate: int | None, where: str
) -> tuple[int, int | None]:
    """Return the numbers of the stapes and of the plate (None: there is none) in a label volume.

    Parameters
    ----------
    names : mapping of int to str
        Names of its segments; they win over the usual numbers 1 and 2.
    present : sequence of int
        Numbers that occur in it, without 0.
    stapes, plate : int or None
        Numbers that the user gave; they win over names.
    where : str
        Name of the file.

    Raises
    ------
    StapeskitError
        Several segments have such a name, or one is a part of the stapes; neither names nor numbers say which
        body is the stapes; both bodies have the same number.
    """
    if stapes is None:
        stapes = _number_by_name(names, _STAPES_NAME, where)
        _refuse_parts(names, stapes, where)
    if stapes is None:
        unnamed = all(_AUTOMATIC.fullmatch(names.get(number, "").strip()) for number in present)
        if not unnamed or not set(present) <= {1, 2, 3} or _STAPES not in present:
            listed = ", ".join(f"{number} {names.get(number, '')}".strip() for number in present)
            raise StapeskitError.of(
                "the label volume",
                "one with a segment named stapes, or with the stapes as number 1 and the plate as 2",
                listed or "no labels",
                where,
                "Rename the segment, or give its number with --stapes-label",
            )
        stapes = _STAPES
    if plate is None:
        plate = _number_by_name(names, _PLATE_NAME, where, stapes)
        unnamed = _AUTOMATIC.fullmatch(names.get(_PLATE, "").strip()) is not None
        if plate is None and stapes != _PLATE and unnamed and _PLATE in present:
            plate = _PLATE
    if plate == stapes:
        step = "Give both numbers"
        raise StapeskitError.of("--plate-label", "another number than the stapes'", plate, where, step)
    for option, number in (("--stapes-label", stapes), ("--plate-label", plate)):
        if number is not None and number not in present:
            listed = ", ".join(map(str, present))
            raise StapeskitError.of(option, f"a number in the label volume ({listed})", number, where)
    return stapes, plate


def _number_by_name(
    names: Mapping[int, str], pattern: re.Pattern[str], where: str, other: int | None = None
) -> int | None:
    """Return the number of the segment whose name holds a pattern; one that is the pattern wins."""
    matching = [number for number, name in names.items() if number != other and pattern.search(name)]
    exact = [number for number in matching if pattern.fullmatch(names[number].strip())]
    matching = exact if len(exact) == 1 else matching
    if len(matching) > 1:
        listed = ", ".join(f"{number} {names[number]}" for number in matching)
        step = "Rename the others, or give --stapes-label and --plate-label"
        raise StapeskitError.of(
            "the label volume", "one with a single segment of that name", listed, where, step
        )
    return matching[0] if matching else None


def _refuse_parts(names: Mapping[int, str], stapes: int | None, where: str) -> None:
    """Refuse a stapes that was drawn in several segments: one of them alone has no footplate, or no arch."""
    parts = [n for n, name in names.items() if n == stapes or (_PART.search(name) and not _SOFT.search(name))]
    if stapes is None or len(parts) < 2:
        return
    listed = ", ".join(f"{number} {names[number]}" for number in sorted(parts))
    step = "Unite the parts in one segment, or give the number of the whole stapes with --stapes-label"
    raise StapeskitError.of(
        "the label volume", "one with the whole stapes in one segment", listed, where, step
    )


def write_segmentation(
    path: Path,
    slabs: Iterable[NDArray[np.uint8]],
    shape: Sequence[int],
    scan_from_index: Array,
    segments: Mapping[int, tuple[str, str]] = SEGMENTS,
) -> None:
    """Write labels as a segmentation of 3D Slicer (.seg.nrrd), with names and colours, slab by slab.

    Parameters
    ----------
    path : Path
    slabs : iterable of ndarray of uint8, [z, y, x]
        Layers of the labels one behind the other.
    shape : sequence of 3 int
        Of all of them, z, y, x.
    scan_from_index : ndarray, (4, 4)
        Index x, y, z of the labels to scan coordinates (LPS), mm.
    segments : mapping of int to (str, str)
        Name and colour of each number.

    Notes
    -----
    The keys: https://slicer.readthedocs.io/en/latest/developer_guide/modules/segmentations.html. All segments
    share one layer. Labels are long runs of one value: zlib looks for runs only, which is fastest.
    """
    keys = {
        "Segmentation_ContainedRepresentationNames": "Binary labelmap|",
        "Segmentation_MasterRepresentation": "Binary labelmap",
        "Segmentation_ReferenceImageExtentOffset": "0 0 0",
    }
    extent = " ".join(f"0 {n - 1}" for n in reversed(shape))
    for number, (value, (name, colour)) in enumerate(segments.items()):
        entry = {
            "ID": name.replace(" ", "_"),
            "Name": name,
            "NameAutoGenerated": 0,
            "Color": colour,
            "ColorAutoGenerated": 0,
            "Extent": extent,
            "LabelValue": value,
            "Layer": 0,
            "Tags": "|",
        }
        keys |= {f"Segment{number}_{key}": str(word) for key, word in entry.items()}
    packer = zlib.compressobj(level=1, wbits=_GZIP, strategy=zlib.Z_RLE)
    with path.open("wb") as stream:
        stream.write(nrrd_header("uint8", shape, scan_from_index, "gzip", keys))
        for slab in slabs:
            stream.write(packer.compress(np.ascontiguousarray(slab, dtype=np.uint8).data))
        stream.write(packer.flush())


def write_crop(path: Path, grey: NDArray[Any], scan_from_index: Array) -> None:
    """Write a part of a scan [z, y, x] as an NRRD of raw voxels that lies where it lay in the scan.

    Parameters
    ----------
    path : Path
    grey : ndarray, [z, y, x]
        Integers of 8, 16 or 32 bits, or floating point numbers.
    scan_from_index : ndarray, (4, 4)
        Index x, y, z of the part to scan coordinates (LPS), mm.
    """
    little = np.ascontiguousarray(grey, dtype=grey.dtype.newbyteorder("<"))
    kind = {"float32": "float", "float64": "double"}.get(grey.dtype.name, grey.dtype.name)
    with path.open("wb") as stream:
        stream.write(nrrd_header(kind, grey.shape, scan_from_index, "raw"))
        stream.write(little.reshape(-1).view(np.uint8).data)


def nrrd_header(
    kind: str,
    shape: Sequence[int],
    scan_from_index: Array,
    encoding: str,
    keys: Mapping[str, str] | None = None,
) -> bytes:
    """Return the header of an NRRD of little-endian voxels in scan coordinates (LPS).

    Parameters
    ----------
    kind : str
        Type of a voxel, as NRRD calls it: https://teem.sourceforge.net/nrrd/format.html
    shape : sequence of 3 int
        z, y, x.
    scan_from_index : ndarray, (4, 4)
    encoding : str
        ``raw`` or ``gzip``.
    keys : mapping of str to str, optional
        Of other programs.
    """
    columns = [_vector(scan_from_index[:3, k]) for k in range(4)]
    lines = [
        "NRRD0004",
        f"type: {kind}",
        "dimension: 3",
        "space: left-posterior-superior",
        f"sizes: {' '.join(str(int(n)) for n in reversed(shape))}",
        f"space directions: {' '.join(columns[:3])}",
        "kinds: domain domain domain",
        "endian: little",
        f"encoding: {encoding}",
        f"space origin: {columns[3]}",
        *(f"{key}:={value}" for key, value in (keys or {}).items()),
    ]
    return ("\n".join(lines) + "\n\n").encode("ascii")


def _vector(values: Array) -> str:
    return f"({','.join(repr(float(value)) for value in values)})"
