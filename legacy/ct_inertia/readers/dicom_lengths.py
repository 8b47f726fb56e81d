"""The lengths in a DICOM file, checked before a library allocates what they claim.

The encoding: DICOM PS3.5, sections 7 (data elements, sequences) and 10 (transfer syntaxes).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from legacy.ct_inertia.readers.refusals import header_fault

_LONG = {b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV"}
# Undefined length and the tags of items and of the ends of items and sequences: DICOM PS3.5, 7.5.
_UNDEFINED = 0xFFFFFFFF
_ITEM, _ITEM_END, _SEQUENCE_END = (0xFFFE, 0xE000), (0xFFFE, 0xE00D), (0xFFFE, 0xE0DD)
# Tags of the transfer syntax, the pixels and their size: DICOM PS3.6, 6 and 7.
_TRANSFER_SYNTAX, _PIXELS = (0x0002, 0x0010), (0x7FE0, 0x0010)
_NUMBERS = {
    (0x0028, 0x0002): "samples",
    (0x0028, 0x0008): "frames",
    (0x0028, 0x0010): "rows",
    (0x0028, 0x0011): "columns",
    (0x0028, 0x0100): "bits",
}
_IMPLICIT, _BIG_ENDIAN = "1.2.840.10008.1.2", "1.2.840.10008.1.2.2"
_DEFLATED = "1.2.840.10008.1.2.1.99"
_NATIVE = (_IMPLICIT, _BIG_ENDIAN, "1.2.840.10008.1.2.1", "")
# Deepest nesting of sequences: real files have below ten, and each level is a call of Python.
_DEEPEST = 32


@dataclass
class DicomSize:
    """What a file claims of its pixels.

    Attributes
    ----------
    numbers : dict of str to int
        ``rows``, ``columns``, ``frames``, ``samples``, ``bits`` where the file has them.
    native : bool
        The pixels are neither packed nor in fragments.
    pixel_bytes : int
        Bytes of the element of pixels; 0 when there is none.
    """

    numbers: dict[str, int] = field(default_factory=dict)
    native: bool = True
    pixel_bytes: int = 0

    @property
    def claimed_bytes(self) -> int:
        """Bytes of the unpacked pixels."""
        total = -(-self.numbers.get("bits", 16) // 8)
        for name in ("rows", "columns", "frames", "samples"):
            total *= max(1, self.numbers.get(name, 1))
        return total


def dicom_size(path: Path) -> DicomSize:
    """Walk the elements of a file; return what it claims of its pixels.

    Raises
    ------
    CtInertiaError
        A length leads beyond the end of the file, elements are nested too deeply, the pixels are fewer than
        rows and columns say, or the data set is deflated as a whole.
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        start = stream.read(132)
        stream.seek(132 if start[128:] == b"DICM" else 0)
        walk = _Walk(stream, size, path)
        try:
            walk.elements(size, 0, top=True)
        except struct.error as fault:
            raise header_fault(path, "DICOM file", "a file that ends within an element") from fault
    lengths = walk.found
    if lengths.native and lengths.pixel_bytes and lengths.claimed_bytes > lengths.pixel_bytes + 1:
        got = f"{lengths.pixel_bytes} bytes of pixels for {lengths.claimed_bytes}"
        raise header_fault(path, "DICOM file", got)
    return lengths


class _Walk:
    """Goes from element to element; values are passed over."""

    def __init__(self, stream: BinaryIO, size: int, path: Path) -> None:
        self.stream, self.size, self.path = stream, size, path
        self.found = DicomSize()
        self.order, self.explicit, self.syntax = "<", self._explicit(), ""

    def _explicit(self) -> bool:
        """Return whether the first element names the type of its value."""
        place = self.stream.tell()
        kind = self.stream.read(6)[4:]
        self.stream.seek(place)
        return len(kind) == 2 and kind.isalpha() and kind.isupper()

    def elements(self, end: int, depth: int, top: bool = False) -> None:
        """Pass over elements up to an offset, or to the end of an item of undefined length."""
        if depth > _DEEPEST:
            raise header_fault(self.path, "DICOM file", "elements nested too deeply")
        meta = top
        while self.stream.tell() + 8 <= end:
            place = self.stream.tell()
            tag = struct.unpack("<HH", self.stream.read(4))
            if meta and tag[0] != 2:
                meta = False
                self._settle_syntax()
                self.stream.seek(place)
                tag = struct.unpack(self.order + "HH", self.stream.read(4))
            elif not meta:
                tag = struct.unpack(self.order + "HH", struct.pack("<HH", *tag))
            if tag in (_ITEM_END, _SEQUENCE_END):
                self.stream.seek(4, 1)
                return
            kind, length = self._length(meta)
            if length == _UNDEFINED:
                # Of an unknown type: the items are then of implicit types (PS3.5, 6.2.2).
                before, self.explicit = self.explicit, self.explicit and kind != b"UN"
                self._items(tag, depth)
                self.explicit = before
                continue
            here = self.stream.tell()
            if here + length > end:
                got = (
                    f"an element ({tag[0]:04x},{tag[1]:04x}) of {length} bytes at byte {place} of {self.size}"
                )
                raise header_fault(self.path, "DICOM file", got)
            if kind == b"SQ":
                self._sequence(here + length, depth)
            elif top:
                self._note(tag, length)
            self.stream.seek(here + length)

    def _settle_syntax(self) -> None:
        if self.syntax == _DEFLATED:
            got = "a data set that is deflated as a whole"
            raise header_fault(self.path, "DICOM file", got)
        if self.syntax:
            self.explicit = self.syntax != _IMPLICIT
            self.order = ">" if self.syntax == _BIG_ENDIAN else "<"
        self.found.native = self.syntax in _NATIVE

    def _length(self, meta: bool) -> tuple[bytes, int]:
        """Return the type, where it is stored, and the length of the value that follows."""
        order = "<" if meta else self.order
        if not meta and not self.explicit:
            return b"", int(struct.unpack(order + "I", self.stream.read(4))[0])
        kind = self.stream.read(2)
        if kind in _LONG:
            self.stream.seek(2, 1)
            return kind, int(struct.unpack(order + "I", self.stream.read(4))[0])
        return kind, int(struct.unpack(order + "H", self.stream.read(2))[0])

    def _items(self, tag: tuple[int, ...], depth: int) -> None:
        """Pass over the items of a sequence, or the fragments of pixels, of undefined length."""
        pixels = tag == _PIXELS
        while self.stream.tell() + 8 <= self.size:
            group, element, length = struct.unpack(self.order + "HHI", self.stream.read(8))
            if (group, element) != _ITEM:
                return
            if length == _UNDEFINED:
                self.elements(self.size, depth + 1)
                continue
            if self.stream.tell() + length > self.size:
                got = f"an item of {length} bytes in a file of {self.size}"
                raise header_fault(self.path, "DICOM file", got)
            if pixels:
                self.found.native = False
                self.found.pixel_bytes += length
            self.stream.seek(length, 1)

    def _sequence(self, end: int, depth: int) -> None:
        """Pass over the items of a sequence of known length."""
        while self.stream.tell() + 8 <= end:
            group, element, length = struct.unpack(self.order + "HHI", self.stream.read(8))
            if (group, element) != _ITEM:
                return
            if length == _UNDEFINED:
                self.elements(end, depth + 1)
                continue
            here = self.stream.tell()
            if here + length > end:
                got = f"an item of {length} bytes beyond its sequence"
                raise header_fault(self.path, "DICOM file", got)
            self.elements(here + length, depth + 1)
            self.stream.seek(here + length)

    def _note(self, tag: tuple[int, ...], length: int) -> None:
        if tag == _PIXELS:
            self.found.pixel_bytes = length
        elif tag == _TRANSFER_SYNTAX:
            self.syntax = self.stream.read(min(length, 64)).decode("ascii", "replace").strip("\0 ")
        elif tag in _NUMBERS and length <= 16:
            value = self.stream.read(length)
            if _NUMBERS[tag] == "frames":
                text = value.decode("ascii", "replace").strip("\0 ")
                number = int(text) if text.isdigit() else 1
            else:
                number = struct.unpack_from(self.order + "H", value)[0] if length >= 2 else 0
            self.found.numbers[_NUMBERS[tag]] = number
