"""The formats of scans, one entry each; a new format is a module with a function ``read`` and an entry here.

Messages, the help of ``ct2mass`` and the table in docs/formats.md follow from it. The tests of readers ask
for a writer (tests/ct_inertia/readers/writers.py) and a case (``contract.py`` there) of every entry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.readers.refusals import not_readable, unreadable
from legacy.stapeskit.faults import PARSER_ERRORS, StapeskitError

if TYPE_CHECKING:
    from legacy.ct_inertia.readers.raw_layout import RawLayout
    from legacy.ct_inertia.volume.volume import Volume


@dataclass(frozen=True)
class ReadOptions:
    """What the user says about a scan.

    Attributes
    ----------
    spacing_mm : sequence of 1 or 3 floats, or None
        Voxel spacing x, y, z in mm; replaces that of the file.
    mirror : str or None
        ``x``, ``y`` or ``z``: reverse the slices along that array axis, as `Volume.mirrored` does. A reader
        whose header has directions also uses it to make a left-handed grid right-handed.
    raw : RawLayout or None
        Layout of the voxels in a file without a header.
    follow : bool
        Data files that a header names may lie outside its folder.
    """

    spacing_mm: Sequence[float] | None = None
    mirror: str | None = None
    raw: RawLayout | None = None
    follow: bool = False


@dataclass(frozen=True)
class Format:
    """A format of scans.

    Attributes
    ----------
    title : str
        For people.
    module : str
        In ``ct_inertia.readers``, imported when a scan of this format is read. It has

        * ``read(path, options: ReadOptions) -> Volume``,
        * ``recognises(path) -> bool`` where ``sniffs`` is not empty: whether the content is of this format,
        * ``companion_files(path) -> list[Path]`` where the scan may lie in several files: those that are read
          with the one given; not asked for folders, which are one input with all that they hold. Names in a
          header pass through `checks.beside`, which keeps them in its folder unless ``follow`` allows more.
    reads : str
        What is read of it, for docs/formats.md.
    suffixes : tuple of str
        Of files, lower case.
    headers : tuple of str
        Those of them that belong to the header of a separate file of voxels: raw voxels (with an ending of
        the entry RAW) beside such a header are read as it says.
    sniffs : tuple of str
        ``file`` and ``folder``: recognised by content, in the order of the table, where no suffix decides.
    placed : bool
        Other programs read spacing, origin and direction of the format as they are read here.
    """

    title: str
    module: str
    reads: str
    suffixes: tuple[str, ...] = ()
    headers: tuple[str, ...] = ()
    sniffs: tuple[str, ...] = ()
    placed: bool = False

    def read(self, path: Path, options: ReadOptions) -> Volume:
        """Read a scan.

        Raises
        ------
        CtInertiaError
            It is damaged, incomplete, or cannot be read; what its content makes a parser raise included.
        """
        code = self._code()
        try:
            volume: Volume = code.read(path, options)
        except OSError as fault:
            raise unreadable(Path(fault.filename or path), fault) from fault
        except StapeskitError:
            raise
        except PARSER_ERRORS as fault:
            raise not_readable(path, self.title, fault) from fault
        return volume

    def recognises(self, path: Path) -> bool:
        """Return whether the content of a file or folder is of this format."""
        return ("folder" if path.is_dir() else "file") in self.sniffs and self._code().recognises(path)

    def companion_files(self, path: Path) -> list[Path]:
        """Return the files that are read with the one given, which may be among them.

        None of a damaged header: what is wrong with it is said when it is read.
        """
        if not hasattr(self._code(), "companion_files"):
            return []
        try:
            files: list[Path] = self._code().companion_files(path)
        except (StapeskitError, OSError, *PARSER_ERRORS):
            return []
        return files

    def _code(self) -> Any:
        return import_module(f"legacy.ct_inertia.readers.{self.module}")


RAW = Format(
    "raw voxels",
    "raw",
    "as `--shape NX,NY,NZ --dtype uint16 [--byte-order big] [--header-bytes N]` say (also keys of `[scan]`), "
    "or as a header in their folder says",
    (".raw", ".vol", ".bin", ".dat", ".img"),
)
# In this order a file or a folder is recognised by its content; the last entry takes every folder.
FORMATS = (
    Format(
        "TIFF",
        "tiff",
        "BigTIFF, ImageJ, OME-TIFF: spacing in any unit they know, plane positions, several files; tiled, "
        "LZW, deflate, packbits, zstd; one that says 0 is white is turned, with a notice (`white_is_zero`)",
        (".tif", ".tiff", ".btf", ".tf8", ".tf2"),
    ),
    Format(
        "NRRD",
        "nrrd",
        "also segmentations (seg.nrrd) and text: origin, direction and units, attached or detached",
        (".nrrd", ".nhdr"),
        headers=(".nhdr",),
        placed=True,
    ),
    Format(
        "MHA, MHD",
        "metaimage",
        "also text: origin, direction and units, attached or detached",
        (".mha", ".mhd"),
        headers=(".mhd",),
        placed=True,
    ),
    Format(
        "NIfTI",
        "nifti",
        "NIfTI-1 and -2: origin, direction and units, attached or detached; Analyze 7.5: spacing",
        (".nii", ".nii.gz", ".hdr"),
        headers=(".hdr",),
        placed=True,
    ),
    Format(
        "Scanco ISQ",
        "isq",
        "spacing; its density line is shown for `--calibration`",
        (".isq", ".rsq", ".rad"),
    ),
    Format(
        "Scanco AIM",
        "aim",
        "versions 020 and 030: spacing and origin; its density line is shown for `--calibration`",
        (".aim",),
    ),
    Format("VGStudio", "vgi", "a .vgi with its .vol files: spacing", (".vgi",), headers=(".vgi",)),
    Format(
        "Amira",
        "amira",
        "also Avizo: spacing and origin; binary, text, packed (HxByteRLE, HxZip), names of label materials",
        (".am",),
    ),
    RAW,
    Format(
        "OME-Zarr",
        "ome_zarr",
        "0.1 to 0.5: scale and translation (from 0.4 on); a coarser level for the first look",
        sniffs=("folder",),
    ),
    Format(
        "DICOM",
        "dicom",
        "series and multi-frame: position order, rescaling; several series are listed",
        (".dcm", ".dicom", ".ima"),
        sniffs=("file", "folder"),
        placed=True,
    ),
    Format(
        "a folder of slices",
        "slices",
        "TIFF, PNG, BMP: natural order, gaps reported; with the Bruker/SkyScan log its pixel size",
        sniffs=("folder",),
    ),
)


def stem_of(name: str) -> str:
    """Return the name of a scan without its endings: ``ear`` of ``ear.nii.gz`` and of ``ear.ome.tif``."""
    endings = [suffix for entry in FORMATS for suffix in entry.suffixes if name.lower().endswith(suffix)]
    stem = name[: len(name) - len(max(endings, key=len, default=Path(name).suffix))]
    return Path(stem).stem if stem.lower().endswith((".ome", ".seg")) else stem


def format_of(path: Path, raw: RawLayout | None = None) -> Format:
    """Return the format of a file or folder: raw voxels where a layout is given, by suffix, or by content.

    Raises
    ------
    CtInertiaError
        No format of the table.
    """
    if path.is_dir():
        return next(entry for entry in FORMATS if entry.recognises(path))
    if raw is not None:
        return RAW
    # VMS adds a version number to the names of Scanco files: SCAN.ISQ;1
    name = path.name.lower().split(";")[0]
    for entry in FORMATS:
        if name.endswith(entry.suffixes):
            return entry
    for entry in FORMATS:
        if entry.recognises(path):
            return entry
    raise CtInertiaError.of(
        "the scan",
        f"a volume of a known format ({', '.join(entry.title for entry in FORMATS)})",
        path.name,
        next_step="Export it in one of these formats, or as raw voxels with {shape} and {dtype}",
    )
