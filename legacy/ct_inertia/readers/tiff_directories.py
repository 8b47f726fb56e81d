"""The chain of directories of a TIFF file, checked before a library follows it.

TIFF 6.0, section 2: a directory is a count, entries of 12 bytes (20 in BigTIFF), and the offset of the next.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, BinaryIO

from legacy.ct_inertia.readers.checks import beside
from legacy.ct_inertia.readers.refusals import header_fault

# Kinds of limits in readers.checks by the compression that a page states.
_PACKINGS = {
    "NONE": "raw",
    "ADOBE_DEFLATE": "deflate",
    "DEFLATE": "deflate",
    "PACKBITS": "packbits",
}
# Most entries of a directory, which have some tens: a larger count is damage, and the chain ends there.
_MOST_ENTRIES = 4096


def packing_of(page: Any) -> str:
    """Return how a page of tifffile is packed, as `checks.check_size` names it; else its own name."""
    if page.bitspersample < 8:
        return "bits"  # 8 voxels a byte, and perhaps packed
    return _PACKINGS.get(page.compression.name, page.compression.name)


def check_directories(path: Path) -> None:
    """Refuse a file whose directories lead in a circle, which a reader would follow for ever.

    Raises
    ------
    CtInertiaError
        An offset points at a directory that was met before.
    """
    with path.open("rb") as stream:
        head = stream.read(16)
        order = {b"II": "<", b"MM": ">"}.get(head[:2])
        if order is None or len(head) < 8:
            return
        big = struct.unpack_from(order + "H", head, 2)[0] == 43
        offset = (
            struct.unpack_from(order + ("Q" if big else "I"), head, 8 if big else 4)[0]
            if (not big or len(head) == 16)
            else 0
        )
        met: set[int] = set()
        while offset:
            if offset in met:
                raise header_fault(path, "TIFF", f"a directory at byte {offset} that leads back to itself")
            met.add(offset)
            offset = _next_directory(stream, offset, order, big)


def _next_directory(stream: BinaryIO, offset: int, order: str, big: bool) -> int:
    """Return the offset of the directory after the one at an offset; 0 after the last or a damaged one."""
    count_form, entry, next_form = ("Q", 20, "Q") if big else ("H", 12, "I")
    try:
        stream.seek(offset)
        (count,) = struct.unpack(order + count_form, stream.read(struct.calcsize(order + count_form)))
        if count > _MOST_ENTRIES:
            return 0
        stream.seek(count * entry, 1)
        (following,) = struct.unpack(order + next_form, stream.read(struct.calcsize(order + next_form)))
    except (struct.error, OSError, OverflowError):
        return 0
    return int(following)


def ome_file_names(xml: str | None) -> list[str]:
    """Return the names of the files over which OME metadata spread an image, each once."""
    from xml.etree import ElementTree

    try:
        elements = ElementTree.fromstring(xml).iter() if xml else iter(())
    except ElementTree.ParseError:
        return []  # what cannot be parsed names no file for tifffile either
    names = [element.get("FileName") for element in elements if element.tag.endswith("UUID")]
    return [name for name in dict.fromkeys(names) if name is not None]


def check_ome_files(path: Path, xml: str | None, follow: bool) -> None:
    """Refuse OME metadata that name files outside the folder.

    Raises
    ------
    CtInertiaError
        A name leads out of the folder of the file, and ``follow`` is False.
    """
    for name in ome_file_names(xml):
        beside(path, name, follow)
