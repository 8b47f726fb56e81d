"""What every reader checks: spacing, units, and sizes that the file can hold."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ct_inertia.errors import CtInertiaError
from stapeskit.faults import Fault
from stapeskit.vocabulary import named
from stapeskit.warnings import Notice

Array = NDArray[np.float64]
# zlib packs at most 1032 to 1; nothing that a scanner writes comes near it.
_MOST_PACKED = 1100
_MM = {
    **dict.fromkeys(("m", "meter", "metre", "meters"), 1e3),
    **dict.fromkeys(("cm", "centimeter", "centimetre", "centimeters"), 10.0),
    **dict.fromkeys(("mm", "millimeter", "millimetre", "millimeters"), 1.0),
    **dict.fromkeys(
        ("um", "µm", "μm", "\\u00b5m", "micron", "microns", "micrometer", "micrometre", "micrometers"), 1e-3
    ),
    **dict.fromkeys(("nm", "nanometer", "nanometre", "nanometers"), 1e-6),
    **dict.fromkeys(("angstrom", "å"), 1e-7),
    **dict.fromkeys(("inch", "in", "inches", '"'), 25.4),
}


def mm_per_unit(unit: str | None) -> float | None:
    """Return the length of a unit in mm, or None when the word names no length (``pixel``)."""
    return None if unit is None else _MM.get(unit.strip().lower())


def settle_spacing(
    from_file: Array | None, given: Sequence[float] | None, name: str, known: str = ""
) -> tuple[Array, tuple[Notice, ...]]:
    """Choose the voxel spacing: that of the user, otherwise that of the file.

    Parameters
    ----------
    from_file : ndarray, (3,), or None
        Spacing along x, y, z in mm.
    given : sequence of 1 or 3 floats, or None
        The user's, in mm.
    name : str
        File name for messages.
    known : str
        The part of an incomplete spacing that the file has, for the message.

    Raises
    ------
    CtInertiaError
        There is none, or one that is not positive.
    """
    if given is not None:
        values = np.asarray(given, dtype=float).ravel()
        if values.size not in (1, 3) or not np.all(np.isfinite(values)) or np.any(values <= 0.0):
            raise CtInertiaError(
                Fault(
                    "{spacing}",
                    "one or three positive numbers in mm (H or DX,DY,DZ)",
                    values.tolist(),
                    next_step="Give it in mm, for example {spacing} 0.018",
                )
            )
        spacing = np.broadcast_to(values, 3).copy()
        if from_file is not None and np.max(np.abs(spacing / from_file - 1.0)) > 1e-3:
            text = (
                f"{name} says voxels of {_listed(from_file)} mm; the given {_listed(spacing)} mm were used."
            )
            return spacing, (Notice("spacing_overridden", text),)
        return spacing, ()
    if from_file is None:
        raise CtInertiaError(
            Fault(
                "the voxel spacing",
                "in the file or given",
                f"none{': ' + known if known else ''}",
                name,
                "Give it in mm with {spacing} H or {spacing} DX,DY,DZ",
            )
        )
    return np.asarray(from_file, dtype=float), ()


def check_size(
    shape: Sequence[int],
    dtype: np.dtype,
    stored_bytes: int,
    packed: bool,
    name: str,
    held: bool = True,
) -> None:
    """Refuse a header that claims more than its file can hold or than this machine can.

    Parameters
    ----------
    shape : sequence of int
        Claimed number of voxels along each axis.
    dtype : dtype
    stored_bytes : int
        Bytes that the file has for them.
    packed : bool
        The data are compressed.
    name : str
        File name for messages.
    held : bool
        Packed data are unpacked as a whole; otherwise piece by piece when they are asked for.

    Raises
    ------
    CtInertiaError
    """
    claimed = int(np.dtype(dtype).itemsize)
    for n in shape:
        claimed *= int(n)
    size = " x ".join(str(int(n)) for n in reversed(list(shape)))
    if claimed > stored_bytes * (_MOST_PACKED if packed else 1):
        raise CtInertiaError(
            Fault(
                "the volume",
                f"as large as its header says ({size} voxels, {amount(claimed)})",
                f"{amount(stored_bytes)} in the file",
                name,
                "The file is truncated or its header is wrong: copy or export it again",
            )
        )
    if packed and held and claimed > _memory():
        raise CtInertiaError(
            Fault(
                "the volume",
                f"small enough to unpack in memory ({amount(_memory())})",
                amount(claimed),
                name,
                "Export it uncompressed, or crop it",
            )
        )


def existing_file(path: Path) -> Path:
    """Return the path when it is a file with content."""
    if not path.exists():
        raise CtInertiaError(
            Fault("the scan", "an existing file or folder", path, next_step="Check the path")
        )
    if path.is_file() and path.stat().st_size == 0:
        raise CtInertiaError(
            Fault(
                "the scan",
                "a file with content",
                "an empty file",
                path.name,
                next_step="Copy or export it again",
            )
        )
    return path


def no_data_file(path: Path, data: Path) -> CtInertiaError:
    """Make the error for a header whose data file is not there."""
    return CtInertiaError(
        Fault("the header", "beside its data file", f"no {data.name}", path.name, "Copy both files together")
    )


def header_fault(path: Path, kind: str, what: str) -> CtInertiaError:
    """Return the error for a header with an impossible value or without a needed one."""
    return CtInertiaError(Fault("the scan", f"a readable {kind}", what, path.name, "Copy or export it again"))


def check_positive(size: Sequence[int], name: str) -> None:
    """Refuse a size with a number of voxels that is not positive."""
    if min(size) <= 0:
        raise CtInertiaError(
            Fault(
                "the size in the header",
                "positive",
                " x ".join(map(str, size)),
                name,
                next_step="Copy or export it again",
            )
        )


def density_notice(name: str, scaling: float, slope: float, intercept: float, unit: str) -> list[Notice]:
    """Say how a header turns grey values into mineral density, as two points for a calibration file."""
    if not (scaling > 0.0 and slope > 0.0 and np.isfinite(intercept)):
        return []
    low, high = 0.0, 2.0 * scaling
    points = ", ".join(f"[{grey:.0f}, {slope * grey / scaling + intercept:.6g}]" for grey in (low, high))
    text = (
        f"{name} says density = {slope:.6g} * grey value / {scaling:.6g} + {intercept:.6g} "
        f"{unit or 'mg HA/ccm'}. For a density of every voxel write points_mg_ha_cm3 = [{points}] into the "
        f"file of {named('calibration')}."
    )
    return [Notice("density_in_header", text)]


def numbered_names(words: Sequence[str], path: Path, kind: str) -> list[str]:
    """Return the file names of ``pattern first last [step]``, as in ``s%03d.raw 0 99 1``."""
    pattern, *rest = words
    if len(rest) not in (2, 3, 4) or not all(re.fullmatch(r"\d{1,7}", word) for word in rest):
        raise header_fault(path, kind, f"data files {' '.join(words)}")
    step = int(rest[2]) if len(rest) > 2 else 1
    directive = re.search(r"%0?(\d*)d", pattern)
    if step < 1 or directive is None or pattern.count("%") != 1:
        raise header_fault(path, kind, f"data files {' '.join(words)}")
    return [pattern % number for number in range(int(rest[0]), int(rest[1]) + 1, step)]


def not_readable(path: Path, kind: str, fault: Exception) -> CtInertiaError:
    """Make the error for a file that its library cannot read."""
    return CtInertiaError(
        Fault(
            "the scan",
            f"a readable {kind}",
            f"a file that {'ends too early' if isinstance(fault, EOFError) else 'cannot be read as one'}",
            path.name,
            "The file is truncated or damaged: copy or export it again",
        )
    )


def _memory() -> int:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return 1 << 40


def amount(count: int) -> str:
    """Return a number of bytes with a prefix."""
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count} bytes"


def _listed(values: Array) -> str:
    return " x ".join(f"{v:.6g}" for v in values)
