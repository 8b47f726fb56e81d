"""Raw voxels whose layout the user tells, memory-mapped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ct_inertia.errors import CtInertiaError
from ct_inertia.readers.checks import amount
from ct_inertia.readers.grid import Grid, check_dimensions, grid_volume
from ct_inertia.volume.volume import Volume
from stapeskit.faults import Fault

RAW_SUFFIXES = (".raw", ".vol", ".bin", ".dat", ".img")
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


def read_raw(path: Path, layout: RawLayout, spacing_mm: Sequence[float] | None = None) -> Volume:
    """Map raw voxels.

    Raises
    ------
    CtInertiaError
        No spacing, or a file that is not exactly as long as the layout says.
    """
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
    return grid_volume(grid, path, spacing_mm, None)


def companion(path: Path) -> Path | None:
    """Return the header beside a raw file: ``scan.mhd``, ``scan.nhdr``, ``scan.vgi``, ..."""
    for ending in (".mhd", ".nhdr", ".vgi"):
        for name in (path.with_suffix(ending), path.with_name(path.name + ending)):
            if name.is_file():
                return name
    header = path.with_suffix(".hdr")
    return header if header.is_file() and path.suffix.lower() == ".img" else None


def layout_missing(path: Path) -> CtInertiaError:
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
