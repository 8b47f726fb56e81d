"""The formats of scans, one entry each; a new format is a function in a module and an entry here.

The help of ``ct2mass``, messages and the table of docs/formats.md follow from it, and the contract tests ask
for a writer of every entry.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from itertools import chain
from pathlib import Path

from ct_inertia.scan.stored import Stored
from stapeskit.faults import StapeskitError


@dataclass(frozen=True)
class Format:
    """A format of scans.

    Attributes
    ----------
    title : str
        For people.
    opener : str
        Module and function of ``ct_inertia.scan`` that takes a path and returns `Stored`.
    reads : str
        What is read of it, for docs/formats.md.
    suffixes : tuple of str
        Of files, lower case.
    libraries : tuple of str
        Modules that read it.
    carries_place : bool
        Other programs read spacing, origin and direction of the format as they are read here.
    matches : callable or None
        Recognises a file or folder by its content, where no suffix decides.
    """

    title: str
    opener: str
    reads: str
    suffixes: tuple[str, ...] = ()
    libraries: tuple[str, ...] = ()
    carries_place: bool = False
    matches: Callable[[Path], bool] | None = None

    def open_file(self, path: Path) -> Stored:
        """Read the header of a scan."""
        module, function = self.opener.split(".")
        stored: Stored = getattr(import_module(f"ct_inertia.scan.{module}"), function)(path)
        return stored


DICOM_SUFFIXES = (".dcm", ".dicom", ".ima")


def _is_zarr(path: Path) -> bool:
    names = (".zattrs", ".zgroup", ".zarray", "zarr.json")
    return path.is_dir() and any((path / name).is_file() for name in names)


def _is_dicom(path: Path) -> bool:
    inside = sorted(path.iterdir()) if path.is_dir() else [path]
    files = [file for file in inside if file.is_file() and not file.name.startswith(".")]
    return any(file.suffix.lower() in DICOM_SUFFIXES or has_preamble(file) for file in files[:5])


def has_preamble(path: Path) -> bool:
    """Return whether a file begins as DICOM files do (PS3.10, 7.1)."""
    try:
        with path.open("rb") as stream:
            return stream.read(132)[128:] == b"DICM"
    except OSError:  # whoever reads the file reports it
        return False


_TIFF = "BigTIFF, ImageJ, OME-TIFF (also of several files): spacing, place; packed; 0 is white: inverted"
_NRRD = "also segmentations (seg.nrrd): origin, direction and units, attached or detached; raw, gzip, bzip2"
_META = "origin, direction and units, attached or detached; raw or packed"
_NIFTI = "NIfTI-1 and -2: origin, direction and units, attached or detached; Analyze 7.5: spacing"
_AIM = "versions 020 and 030: spacing and origin"
_VGI = "a .vgi with its .vol file: spacing"
_AMIRA = "also Avizo: binary voxels that are not packed, spacing, origin, names of label materials"
_LAYOUT = (
    "as `--shape NX,NY,NZ --dtype uint16 [--byte-order big] [--header-bytes N]` say (also keys of `[scan]`)"
)
_DICOM = "a series of slices: order by position, rescaling of every slice; several series are listed"
_SLICES = (
    "TIFF, PNG, BMP, JPEG, JPEG 2000 in the order of their numbers, gaps reported; pixel size of the "
    "Bruker/SkyScan reconstruction log"
)

RAW = Format("raw voxels", "raw.open_raw", _LAYOUT, (".raw", ".vol", ".bin", ".dat", ".img"))
FORMATS = (
    Format("TIFF", "tiff.open_tiff", _TIFF, (".tif", ".tiff", ".btf", ".tf8", ".tf2"), ("tifffile",)),
    Format("NRRD", "itk.open_nrrd", _NRRD, (".nrrd", ".nhdr"), ("SimpleITK",), True),
    Format("MHA, MHD", "itk.open_metaimage", _META, (".mha", ".mhd"), ("SimpleITK",), True),
    Format("NIfTI", "nifti.open_nifti", _NIFTI, (".nii", ".nii.gz", ".hdr"), ("nibabel",), True),
    Format("Scanco ISQ", "scanners.open_isq", "spacing", (".isq", ".rsq", ".rad")),
    Format("Scanco AIM", "scanners.open_aim", _AIM, (".aim",)),
    Format("VGStudio", "scanners.open_vgi", _VGI, (".vgi",)),
    Format("Amira", "scanners.open_amira", _AMIRA, (".am",)),
    RAW,
    Format("OME-Zarr", "zarr.open_zarr", "0.1 to 0.5: scale and translation", (), ("zarr",), False, _is_zarr),
    Format("DICOM", "dicom.open_dicom", _DICOM, DICOM_SUFFIXES, ("pydicom", "SimpleITK"), True, _is_dicom),
    Format(
        "a folder of slices", "slices.open_slices", _SLICES, (), ("tifffile", "PIL.Image"), False, Path.is_dir
    ),
)
"""In this order a file or folder is recognised by its content; the last entry takes every other folder."""


def format_of(path: Path) -> Format:
    """Return the format of a file or folder, by suffix or by content.

    Raises
    ------
    StapeskitError
        No format of the table.
    """
    # VMS adds a version number to the names of Scanco files: SCAN.ISQ;1
    name = "" if path.is_dir() else path.name.lower().split(";")[0]
    named = (entry for entry in FORMATS if name.endswith(entry.suffixes))
    matching = (entry for entry in FORMATS if entry.matches is not None and entry.matches(path))
    for entry in chain(named, matching):
        return entry
    known = ", ".join(entry.title for entry in FORMATS)
    step = "Export it in one of these formats, or as raw voxels with --shape and --dtype"
    raise StapeskitError.of("the scan", f"a volume of a known format ({known})", path.name, next_step=step)


def stem_of(name: str) -> str:
    """Return the name of a scan without its endings: ``ear`` of ``ear.nii.gz`` and of ``ear.ome.tif``."""
    endings = [suffix for entry in FORMATS for suffix in entry.suffixes if name.lower().endswith(suffix)]
    stem = name[: len(name) - len(max(endings, key=len, default=Path(name).suffix))]
    return Path(stem).stem if stem.lower().endswith((".ome", ".seg")) else stem
