"""How raw voxels lie in a file without a header."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legacy.ct_inertia.errors import CtInertiaError
from legacy.stapeskit.option_kinds import VOXEL_TYPE
from legacy.stapeskit.option_names import named


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
            raise CtInertiaError.of(
                "{shape}",
                "three whole numbers NX,NY,NZ of at least 2",
                ",".join(f"{n:g}" for n in self.shape),
                next_step="Give the number of voxels along x (runs fastest), y and z",
            )
        for option, value, known in (
            (named("dtype"), self.dtype, VOXEL_TYPE.choices),
            (named("byte_order"), self.byte_order, ("little", "big")),
        ):
            if value not in known:
                raise CtInertiaError.of(
                    option, f"one of {', '.join(known)}", value, next_step="Choose one of them"
                )
        if self.header_bytes < 0:
            raise CtInertiaError.of(
                "{header_bytes}", "0 or more", self.header_bytes, next_step="Count from the start"
            )

    @property
    def stored_type(self) -> np.dtype:
        """The voxels' type with its byte order."""
        return np.dtype(self.dtype).newbyteorder("<" if self.byte_order == "little" else ">")
