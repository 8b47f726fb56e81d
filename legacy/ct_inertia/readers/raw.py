"""Raw voxels in a layout that the user gives, memory-mapped."""

from __future__ import annotations

from pathlib import Path

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.readers.checks import amount
from legacy.ct_inertia.readers.formats import FORMATS, ReadOptions, format_of
from legacy.ct_inertia.readers.header_grid import Grid, check_dimensions, grid_volume
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.option_names import named

# Other programs use .hdr for headers of their own: those of NIfTI belong to .img alone.
_HEADERS = tuple(ending for entry in FORMATS for ending in entry.headers if ending != ".hdr")


def read(path: Path, options: ReadOptions) -> Volume:
    """Map raw voxels; without a layout they are read with the header in their folder.

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
        shape = " x ".join(str(int(n)) for n in layout.shape)
        guess = f"Check {named('shape')}, {named('dtype')} and {named('header_bytes')}"
        if stored > needed:
            surplus = layout.header_bytes + stored - needed
            guess += f"; {named('header_bytes')} {surplus} would fit if the surplus is a header"
        raise CtInertiaError.of(
            "the raw file",
            f"as long as {shape} voxels of {layout.dtype} ({amount(needed)}, {needed} bytes)",
            f"{stored} bytes after the header",
            path.name,
            guess,
        )
    size = (int(layout.shape[0]), int(layout.shape[1]), int(layout.shape[2]))
    grid = Grid(
        size, layout.stored_type, ((path, layout.header_bytes),), None, known="raw voxels do not have it"
    )
    return grid_volume(grid, path, options)


def companion_files(path: Path) -> list[Path]:
    """Return the header of a raw file, and the files that it names."""
    header = _header_beside(path)
    return [] if header is None else [header, *format_of(header).companion_files(header)]


def _header_beside(path: Path) -> Path | None:
    """Return the header of a raw file: ``scan.mhd``, ``scan.raw.mhd``, ``scan.nhdr``, ``scan.vgi``, ..."""
    names = [name for end in _HEADERS for name in (path.with_suffix(end), path.with_name(path.name + end))]
    if path.suffix.lower() == ".img":
        names.append(path.with_suffix(".hdr"))
    return next((name for name in names if name.is_file()), None)


def _layout_missing(path: Path) -> CtInertiaError:
    """Make the error for a raw file with neither a header in its folder nor a layout given."""
    return CtInertiaError.of(
        "raw voxels",
        f"in the folder of their header ({', '.join(_HEADERS)}) or described by {{shape}} and {{dtype}}",
        "neither",
        path.name,
        "Give {shape} NX,NY,NZ {dtype} uint16 [{byte_order} big] [{header_bytes} N] {spacing} H",
    )
