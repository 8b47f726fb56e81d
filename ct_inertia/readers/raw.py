"""Raw voxels whose layout the user tells, memory-mapped."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ct_inertia.errors import CtInertiaError
from ct_inertia.readers.checks import amount
from ct_inertia.readers.formats import FORMATS, ReadOptions, format_of
from ct_inertia.readers.grid import Grid, check_dimensions, grid_volume
from ct_inertia.volume.volume import Volume
from stapeskit.faults import Fault

RAW_TYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", "float64")


@dataclass(frozen=True)
class RawLayout:
    """How the voxels of a raw file lie in it.

    Attributes
    ----------
    shape : tuple of 3 int
        Voxels along x, y, z; x runs fastest.
    dtype : str
        One of uint8, int8, uint16, int16, uint32, int32, float32, float64.
    byte_order : str
        ``little`` or ``big``.
    header_bytes : int
        Bytes before the first voxel.

    Raises
    ------
    CtInertiaError
        A size below 2, an unknown type or byte order, a negative number of bytes.
    """

    shape: tuple[int, ...]
    dtype: str
    byte_order: str = "little"
    header_bytes: int = 0

    def __post_init__(self) -> None:
        if len(self.shape) != 3 or min(self.shape) < 2 or any(int(n) != n for n in self.shape):
            raise CtInertiaError(
                Fault(
                    "--shape",
                    "three whole numbers NX,NY,NZ of at least 2",
                    ",".join(f"{n:g}" for n in self.shape),
                    next_step="Give the number of voxels along x (runs fastest), y and z",
                )
            )
        for option, value, known in (
            ("--dtype", self.dtype, RAW_TYPES),
            ("--byte-order", self.byte_order, ("little", "big")),
        ):
            if value not in known:
                raise CtInertiaError(
                    Fault(option, f"one of {', '.join(known)}", value, next_step="Choose one of them")
                )
        if self.header_bytes < 0:
            raise CtInertiaError(
                Fault("--header-bytes", "0 or more", self.header_bytes, next_step="Count from the start")
            )

    @property
    def stored_type(self) -> np.dtype:
        """The voxels' type with its byte order."""
        return np.dtype(self.dtype).newbyteorder("<" if self.byte_order == "little" else ">")


def read(path: Path, options: ReadOptions) -> Volume:
    """Map raw voxels; without a layout they are read with the header beside them.

    Raises
    ------
    CtInertiaError
        Neither layout nor header, no spacing, or a file that is not exactly as long as the layout says.
    """
    layout = options.raw
    if layout is None:
        header = _header_beside(path)
        if header is None:
            raise _layout_missing(path)
        return format_of(header).read(header, options)
    check_dimensions(layout.shape, path.name)
    needed = layout.stored_type.itemsize
    for n in layout.shape:
        needed *= int(n)
    stored = path.stat().st_size - layout.header_bytes
    if stored != needed:
        told = " x ".join(str(int(n)) for n in layout.shape)
        guess = "Check --shape, --dtype and --header-bytes"
        if stored > needed:
            surplus = layout.header_bytes + stored - needed
            guess += f"; --header-bytes {surplus} would fit if the surplus is a header"
        raise CtInertiaError(
            Fault(
                "the raw file",
                f"as long as {told} voxels of {layout.dtype} ({amount(needed)}, {needed} bytes)",
                f"{stored} bytes after the header",
                path.name,
                guess,
            )
        )
    size = (int(layout.shape[0]), int(layout.shape[1]), int(layout.shape[2]))
    grid = Grid(
        size, layout.stored_type, ((path, layout.header_bytes),), None, known="raw voxels do not tell it"
    )
    return grid_volume(grid, path, options)


def companion_files(path: Path) -> list[Path]:
    """Return the header beside a raw file, and the files that it names."""
    header = _header_beside(path)
    return [] if header is None else [header, *format_of(header).companion_files(header)]


def _header_beside(path: Path) -> Path | None:
    """Return the header of a raw file: ``scan.mhd``, ``scan.raw.mhd``, ``scan.nhdr``, ``scan.vgi``, ..."""
    # Other programs use .hdr for headers of their own: those of NIfTI belong to .img alone.
    endings = [ending for entry in FORMATS for ending in entry.headers if ending != ".hdr"]
    names = [name for end in endings for name in (path.with_suffix(end), path.with_name(path.name + end))]
    if path.suffix.lower() == ".img":
        names.append(path.with_suffix(".hdr"))
    return next((name for name in names if name.is_file()), None)


def _layout_missing(path: Path) -> CtInertiaError:
    """Make the error for a raw file with neither a header beside it nor a layout given."""
    return CtInertiaError(
        Fault(
            "raw voxels",
            "beside a header (.mhd, .nhdr, .vgi) or described by --shape and --dtype",
            "neither",
            path.name,
            "Give --shape NX,NY,NZ --dtype uint16 [--byte-order big] [--header-bytes N] --spacing H",
        )
    )
