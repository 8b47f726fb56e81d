"""What readers say of scans that they cannot read: one sentence a cause, alike in every format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from legacy.ct_inertia.errors import CtInertiaError


def unreadable(path: Path, fault: Exception) -> CtInertiaError:
    """Make the error for a file that the system does not let be read."""
    why = getattr(fault, "strerror", None) or str(fault)
    return CtInertiaError.of(
        "the scan", "a file that can be read", why, path.name, "Check its name, permissions and disk"
    )


def no_data_file(path: Path, data: Path) -> CtInertiaError:
    """Make the error for a header whose data file is not there."""
    wanted, step = "in the folder of the header", "Copy both files together"
    return CtInertiaError.of("the data file", wanted, f"no {data.name}", path.name, step)


def header_fault(path: Path, kind: str, what: str) -> CtInertiaError:
    """Return the error for a header with an impossible value or without a needed one."""
    return CtInertiaError.of("the scan", f"a readable {kind}", what, path.name, "Copy or export it again")


def not_readable(path: Path, kind: str, fault: Exception) -> CtInertiaError:
    """Make the error for a file that its library cannot read."""
    return CtInertiaError.of(
        "the scan",
        f"a readable {kind}",
        f"a file that {'ends too early' if isinstance(fault, EOFError) else 'cannot be read as one'}",
        path.name,
        "The file is truncated or damaged: copy or export it again",
    )


def several_values(path: Path, got: str) -> CtInertiaError:
    """Make the error for a volume with more than one number in a voxel: colours, vectors, times."""
    wanted, step = "a stack of one grey value per voxel", "Export grey values of one channel, at one time"
    return CtInertiaError.of("the volume", wanted, got, path.name, step)


def no_grey_values(path: Path, got: object) -> CtInertiaError:
    """Make the error for voxels of a type that is no grey value: complex numbers, colours, unknown ones."""
    wanted = "integers or floating point numbers"
    return CtInertiaError.of("the grey values", wanted, got, path.name, "Export it as real grey values")


def not_three_dimensional(name: str, size: Sequence[int]) -> CtInertiaError:
    """Make the error for a picture, or for more than three dimensions; sizes x first."""
    got = f"an image of shape {' x '.join(map(str, size))}"
    step = "Give the whole stack, or the folder of slices"
    return CtInertiaError.of("the volume", "three-dimensional", got, name, step)


def ends_too_early(path: Path) -> CtInertiaError:
    """Make the error for a file that is shorter than its voxels."""
    got = "a file that ends too early"
    return CtInertiaError.of("the scan", "complete", got, path.name, "Copy or export it again")
