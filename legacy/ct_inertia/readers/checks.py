"""What every reader checks: spacing, units, and sizes that the file can hold."""

from __future__ import annotations

import re
import stat
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.readers.refusals import header_fault, unreadable
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.memory import available_memory
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

# Bytes that a byte of a packed file can become at most, by the formats: deflate 1032, LZ4 255, PackBits 64;
# a number written as text has a digit and a blank and becomes 8 bytes at most.
# The others (zstd, bzip2, lzma, JPEG ...) have no such limit: a zstd block of 11 bytes is 128 KiB of zeros.
_MOST_PACKED = {"raw": 1.0, "deflate": 1100.0, "lz4": 260.0, "packbits": 65.0, "text": 4.5, "hex": 0.5}
# File systems store names of at most 255 bytes.
_LONGEST_NAME = 255
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
    return _MM.get(unit.strip().lower()) if isinstance(unit, str) else None


def settle_spacing(
    from_file: Array | None, from_user: Sequence[float] | None, name: str, known: str = ""
) -> tuple[Array, tuple[Notice, ...]]:
    """Choose the voxel spacing: that of the user, otherwise that of the file.

    Parameters
    ----------
    from_file : ndarray, (3,), or None
        Spacing along x, y, z in mm; NaN where the file does not say it.
    from_user : sequence of 1 or 3 floats, or None
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
    if from_user is not None:
        values = np.asarray(from_user, dtype=float).ravel()
        if values.size not in (1, 3) or not np.all(np.isfinite(values)) or np.any(values <= 0.0):
            raise CtInertiaError.of(
                "{spacing}",
                "one or three positive numbers in mm (H or DX,DY,DZ)",
                values.tolist(),
                next_step="Give it in mm, for example {spacing} 0.018",
            )
        spacing = np.broadcast_to(values, 3).copy()
        told = np.full(3, np.nan) if from_file is None else np.asarray(from_file, dtype=float)
        known_axes = np.isfinite(told)
        if np.any(np.abs(spacing / told - 1.0)[known_axes] > 1e-3):
            file_mm, given_mm = _format_numbers(told[known_axes]), _format_numbers(spacing)
            along = "" if np.all(known_axes) else " along " + " and ".join(np.array(list("xyz"))[known_axes])
            text = f"{name} says voxels of {file_mm} mm{along}; the given {given_mm} mm were used."
            return spacing, (Notice("spacing_overridden", text),)
        return spacing, ()
    if from_file is None or not np.all(np.isfinite(from_file)):
        raise CtInertiaError.of(
            "the voxel spacing",
            "in the file or given",
            f"none{': ' + known if known else ''}",
            name,
            "Give it in mm with {spacing} H or {spacing} DX,DY,DZ",
        )
    return np.asarray(from_file, dtype=float), ()


def check_size(
    shape: Sequence[int],
    dtype: np.dtype,
    stored_bytes: int,
    name: str,
    *,
    packing: str = "raw",
    in_memory: bool = False,
) -> None:
    """Refuse a header that claims more than its file can hold or than this machine can.

    Parameters
    ----------
    shape : sequence of int
        Claimed number of voxels along each axis.
    stored_bytes : int
        Bytes that the file has for them.
    name : str
        File name for messages.
    packing : str
        ``raw``, ``deflate`` (zlib, gzip, PNG), ``lz4``, ``packbits``, ``text``, ``hex``, or another one
        without a limit.
    in_memory : bool
        The voxels are unpacked as a whole, not piece by piece.

    Raises
    ------
    CtInertiaError
        The header claims more voxels than the file can hold, or than memory can.
    """
    claimed = int(np.dtype(dtype).itemsize)
    for n in shape:
        claimed *= int(n)
    size = " x ".join(str(int(n)) for n in reversed(list(shape)))
    if claimed > stored_bytes * _MOST_PACKED.get(packing, np.inf):
        raise CtInertiaError.of(
            "the volume",
            f"as large as its header says ({size} voxels, {amount(claimed)})",
            f"{amount(stored_bytes)} in the file",
            name,
            "The file is truncated or its header is wrong: copy or export it again",
        )
    if in_memory:
        check_memory(claimed, name)


def check_memory(needed: int, name: str) -> None:
    """Refuse what does not fit into memory.

    Raises
    ------
    CtInertiaError
        More than half of the available memory is needed.
    """
    # Half: what was unpacked is copied once more where it is measured.
    most = available_memory() // 2
    if needed > most:
        raise CtInertiaError.of(
            "the volume",
            f"small enough to unpack in memory ({amount(most)})",
            amount(needed),
            name,
            "Export it uncompressed, or crop it",
        )


def existing_file(path: Path) -> Path:
    """Return the path when it is a folder, or a regular file with content.

    Raises
    ------
    CtInertiaError
        Nothing is there, it cannot be looked at, it is empty, or it is a pipe or a device.
    """
    try:
        status = path.stat()
    except FileNotFoundError:
        raise CtInertiaError.of(
            "the scan", "an existing file or folder", path, next_step="Check the path"
        ) from None
    except (OSError, ValueError) as fault:
        raise unreadable(path, fault) from fault
    if not stat.S_ISREG(status.st_mode) and not stat.S_ISDIR(status.st_mode):
        raise CtInertiaError.of(
            "the scan", "a file or folder", "a pipe or a device", path.name, "Save it as a file first"
        )
    if stat.S_ISREG(status.st_mode) and status.st_size == 0:
        raise CtInertiaError.of(
            "the scan", "a file with content", "an empty file", path.name, next_step="Copy or export it again"
        )
    return path


def beside(path: Path, name: str, follow: bool) -> Path:
    """Return the data file that a header names.

    Parameters
    ----------
    path : Path
        The header.
    name : str
        As the header has it, relative to the header's folder.
    follow : bool
        Names that lead out of that folder are allowed.

    Raises
    ------
    CtInertiaError
        The name leads out of the folder, or is no file name.
    """
    if not name or "\0" in name or any(len(part.encode()) > _LONGEST_NAME for part in Path(name).parts):
        got = f"a name of {len(name)} characters" if len(name) > 60 else repr(name)
        raise CtInertiaError.of("the data file", "a file name", got, path.name, "Correct the header")
    outside = Path(name).is_absolute() or ".." in Path(name).parts
    if outside and not follow:
        raise CtInertiaError.of(
            "the data file",
            "in the folder of its header",
            name if len(name) <= 200 else f"{name[:200]}...",
            path.name,
            "Put both files into one folder, or let {follow} allow it if you trust the header",
        )
    return path.parent / name


def check_positive(size: Sequence[int], name: str) -> None:
    """Refuse a size with a number of voxels that is not positive."""
    if min(size) <= 0:
        raise CtInertiaError.of(
            "the size in the header",
            "positive",
            " x ".join(map(str, size)),
            name,
            next_step="Copy or export it again",
        )


def density_notice(name: str, scaling: float, slope: float, intercept: float, unit: str) -> list[Notice]:
    """Return the warning with the density line of a header, as two points for a calibration file."""
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


def named_files(named: str, listed: Sequence[str], most: float, path: Path, kind: str) -> list[str]:
    """Return the data files that a header names: one, a list behind it, or ``pattern first last [step]``.

    Parameters
    ----------
    named : str
        ``a.raw``, ``LIST``, or ``s%03d.raw 0 99 1``.
    listed : sequence of str
        The lines behind the header.
    most : float
        Files that there can be.
    path : Path
        The header.
    kind : str
        What it is, for messages.

    Raises
    ------
    CtInertiaError
        No list, no such pattern with whole numbers, or more names than ``most``.
    """
    if named.upper().startswith("LIST"):
        if not listed:
            raise header_fault(path, kind, "an empty list of data files")
        return list(listed)
    if not re.search(r"%\d*d", named):
        return [named]
    pattern, *rest = named.split()
    whole = len(rest) in (2, 3, 4) and all(re.fullmatch(r"\d{1,7}", word) for word in rest)
    step = int(rest[2]) if whole and len(rest) > 2 else 1
    if not whole or step < 1 or pattern.count("%") != 1 or not re.search(r"%0?[0-9]{0,2}d", pattern):
        raise header_fault(path, kind, f"data files {named}")
    numbers = range(int(rest[0]), int(rest[1]) + 1, step)
    if len(numbers) > most:
        raise header_fault(path, kind, f"{len(numbers)} data files for {most:g} slices")
    return [pattern % number for number in numbers]


def amount(count: int) -> str:
    """Return a number of bytes with a prefix."""
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count} bytes"


def _format_numbers(values: Array) -> str:
    return " x ".join(f"{v:.6g}" for v in values)
