"""Every way in which a scan is written for the contract of formats."""

from __future__ import annotations

from dataclasses import dataclass, field

from tests.scan_files import scan_writers as w
from tests.scan_files import scanner_writers as own

INTEGERS = ("u1", "i1", "u2", "i2", "u4", "i4")
ALL = (*INTEGERS, "f4", "f8")
SOME = ("u2", "f4")


@dataclass(frozen=True)
class Case:
    """A way of writing a scan: types, and what its file can and cannot say."""

    write: object
    types: tuple[str, ...] = ("u2",)
    options: dict = field(default_factory=dict)
    asks: bool = False  # for the spacing
    anatomical: bool = False
    raw: dict | None = None
    entry: str = "TIFF"


CASES = {
    "imagej.tif": Case(w.imagej, ("u1", "u2", "i2", "f4")),
    **{f"imagej_{k}.tif": Case(w.imagej, options={"unit": unit}) for k, unit in enumerate(w.UNITS)},
    "imagej_deflate.tif": Case(w.imagej, ("u1", "f4"), {"compression": "zlib"}),
    "imagej_lzw.tif": Case(w.imagej, ("u2",), {"compression": "lzw"}),
    "a.ome.tif": Case(w.ome, ALL),
    "nm.ome.tif": Case(w.ome, options={"unit": "nm"}),
    "big.ome.tif": Case(w.ome, SOME, {"bigtiff": True, "byteorder": ">"}),
    "tiled.ome.tif": Case(w.ome, ("u1", "u2", "f4"), {"tile": (16, 16), "compression": "zlib"}),
    "predicted.ome.tif": Case(w.ome, ("u2", "f4"), {"compression": "lzw", "predictor": True}),
    "files.ome.tif": Case(w.ome_files),
    "plain.tif": Case(w.plain, ALL, asks=True),
    "plain_big.btf": Case(w.plain, ("u2",), {"bigtiff": True, "byteorder": ">"}, True),
    "strips.tif": Case(w.plain, ("u2",), {"rowsperstrip": 2, "metadata": None}, True),
    "packbits.tif": Case(w.plain, ("u1", "u2"), {"compression": "packbits"}, True),
    "zstd.tif": Case(w.plain, ("u2",), {"compression": "zstd"}, True),
    "pages.tif": Case(w.pages, ("u1", "u2", "f4"), asks=True),
    "pages_big.tif": Case(w.pages, ("u2", "f4"), {"byteorder": ">"}, True),
    "pages_lzw.tif": Case(w.pages, ("u2", "f8"), {"compression": "lzw"}, True),
    "itk_lzw.tif": Case(w.itk, ("u1", "u2"), {"packed": True, "compressor": "LZW"}, True),
    "a.nrrd": Case(w.itk, ALL, anatomical=True, entry="NRRD"),
    "zip.nrrd": Case(w.itk, ("u1", "u2", "f8"), {"packed": True}, anatomical=True, entry="NRRD"),
    "big.nrrd": Case(w.nrrd, SOME, {"big": True}, entry="NRRD"),
    "a.nhdr": Case(w.itk, anatomical=True, entry="NRRD"),
    "a.mha": Case(w.itk, ALL, anatomical=True, entry="MHA, MHD"),
    "zip.mha": Case(w.itk, ("u1", "u2", "f8"), {"packed": True}, anatomical=True, entry="MHA, MHD"),
    "big.mha": Case(w.meta, SOME, {"big": True}, entry="MHA, MHD"),
    "a.mhd": Case(w.itk, anatomical=True, entry="MHA, MHD"),
    "zip.mhd": Case(w.itk, ("u2",), {"packed": True}, anatomical=True, entry="MHA, MHD"),
    "a.nii": Case(w.itk, ALL, anatomical=True, entry="NIfTI"),
    "big.nii": Case(w.nifti, SOME, {"big": True}, entry="NIfTI"),
    "um.nii": Case(w.nifti, ("u2",), {"unit": 3}, entry="NIfTI"),
    "m.nii": Case(w.nifti, ("u2",), {"unit": 1}, entry="NIfTI"),
    "a.nii.gz": Case(w.itk, ("u1", "i2", "f4"), anatomical=True, entry="NIfTI"),
    "analyze.hdr": Case(w.analyze, ("u1", "i2", "f4"), entry="NIfTI"),
    "analyze_big.hdr": Case(w.analyze, ("i2",), {"big": True}, entry="NIfTI"),
    "folder": Case(w.slices, ALL, asks=True, entry="a folder of slices"),
    "folder_big": Case(w.slices, ("u2", "f4"), {"byteorder": ">"}, True, entry="a folder of slices"),
    "folder_lzw": Case(w.slices, ("u2",), {"compression": "lzw"}, True, entry="a folder of slices"),
    "folder_png": Case(w.slices, ("u1", "u2"), {"ending": "png"}, True, entry="a folder of slices"),
    "folder_jp2": Case(w.slices, ("u1", "u2"), {"ending": "jp2"}, True, entry="a folder of slices"),
    "folder_bmp": Case(w.slices, ("u1",), {"ending": "bmp"}, True, entry="a folder of slices"),
    "a.isq": Case(own.isq, ("i2",), entry="Scanco ISQ"),
    "a.ISQ;1": Case(own.isq, ("i2",), entry="Scanco ISQ"),
    "a.AIM": Case(own.aim, ("i1", "u1", "i2", "u2", "i4", "f4"), entry="Scanco AIM"),
    "a30.aim": Case(own.aim30, ("i1", "u1", "i2", "u2", "i4", "f4"), entry="Scanco AIM"),
    "a.vgi": Case(own.vgi, ("u1", "u2", "i2", "f4"), entry="VGStudio"),
    "um.vgi": Case(own.vgi, ("u2",), {"unit": "um", "skip": 100}, entry="VGStudio"),
    "a.am": Case(own.amira, ("u1", "i2", "u2", "i4", "f4", "f8"), entry="Amira"),
    "big.am": Case(own.amira, ("u2", "f4"), {"big": True}, entry="Amira"),
    "um.am": Case(own.amira, ("u2",), {"unit": "µm"}, entry="Amira"),
    "a.raw": Case(w.raw, ALL, {"header": 12}, True, raw={"header_bytes": 12}, entry="raw voxels"),
    "big.raw": Case(w.raw, SOME, {"big": True}, True, raw={"byte_order": "big"}, entry="raw voxels"),
    "dicom": Case(w.dicom, ("i2", "u2", "u1"), anatomical=True, entry="DICOM"),
    "dicom_jpeg": Case(w.dicom, ("u2", "u1"), {"packed": True}, anatomical=True, entry="DICOM"),
    "v04.zarr": Case(w.ome_zarr, ALL, entry="OME-Zarr"),
    "v04_mm.zarr": Case(w.ome_zarr, ("u2",), {"unit": "millimeter"}, entry="OME-Zarr"),
    "v04_tc.zarr": Case(w.ome_zarr, ("u2",), {"leading": ("t", "c")}, entry="OME-Zarr"),
    "v04_bare.zarr": Case(w.ome_zarr, (">u2", "f4"), {"compressors": None}, entry="OME-Zarr"),
    "v05.zarr": Case(w.ome_zarr, SOME, {"version": "0.5"}, entry="OME-Zarr"),
    "v05_shards.zarr": Case(w.ome_zarr, ("u2", "f4"), {"version": "0.5", "shards": True}, entry="OME-Zarr"),
}
