"""Every way in which a scan is written for the contract of formats."""

from __future__ import annotations

from dataclasses import dataclass, field

from tests.scan_files.scan_writers import (
    UNITS,
    analyze,
    dicom,
    imagej,
    itk,
    meta,
    nifti,
    nrrd,
    ome,
    ome_files,
    ome_zarr,
    pages,
    plain,
    raw,
    slices,
)
from tests.scan_files.scanner_writers import aim, aim30, amira, isq, vgi

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
    "imagej.tif": Case(imagej, ("u1", "u2", "i2", "f4")),
    **{f"imagej_{k}.tif": Case(imagej, options={"unit": unit}) for k, unit in enumerate(UNITS)},
    "imagej_deflate.tif": Case(imagej, ("u1", "f4"), {"compression": "zlib"}),
    "imagej_lzw.tif": Case(imagej, ("u2",), {"compression": "lzw"}),
    "a.ome.tif": Case(ome, ALL),
    "nm.ome.tif": Case(ome, options={"unit": "nm"}),
    "big.ome.tif": Case(ome, SOME, {"bigtiff": True, "byteorder": ">"}),
    "tiled.ome.tif": Case(ome, ("u1", "u2", "f4"), {"tile": (16, 16), "compression": "zlib"}),
    "predicted.ome.tif": Case(ome, ("u2", "f4"), {"compression": "lzw", "predictor": True}),
    "files.ome.tif": Case(ome_files),
    "plain.tif": Case(plain, ALL, asks=True),
    "plain_big.btf": Case(plain, ("u2",), {"bigtiff": True, "byteorder": ">"}, True),
    "strips.tif": Case(plain, ("u2",), {"rowsperstrip": 2, "metadata": None}, True),
    "packbits.tif": Case(plain, ("u1", "u2"), {"compression": "packbits"}, True),
    "zstd.tif": Case(plain, ("u2",), {"compression": "zstd"}, True),
    "pages.tif": Case(pages, ("u1", "u2", "f4"), asks=True),
    "pages_big.tif": Case(pages, ("u2", "f4"), {"byteorder": ">"}, True),
    "pages_lzw.tif": Case(pages, ("u2", "f8"), {"compression": "lzw"}, True),
    "itk_lzw.tif": Case(itk, ("u1", "u2"), {"packed": True, "compressor": "LZW"}, True),
    "a.nrrd": Case(itk, ALL, anatomical=True, entry="NRRD"),
    "zip.nrrd": Case(itk, ("u1", "u2", "f8"), {"packed": True}, anatomical=True, entry="NRRD"),
    "big.nrrd": Case(nrrd, SOME, {"big": True}, entry="NRRD"),
    "a.nhdr": Case(itk, anatomical=True, entry="NRRD"),
    "a.mha": Case(itk, ALL, anatomical=True, entry="MHA, MHD"),
    "zip.mha": Case(itk, ("u1", "u2", "f8"), {"packed": True}, anatomical=True, entry="MHA, MHD"),
    "big.mha": Case(meta, SOME, {"big": True}, entry="MHA, MHD"),
    "a.mhd": Case(itk, anatomical=True, entry="MHA, MHD"),
    "zip.mhd": Case(itk, ("u2",), {"packed": True}, anatomical=True, entry="MHA, MHD"),
    "a.nii": Case(itk, ALL, anatomical=True, entry="NIfTI"),
    "big.nii": Case(nifti, SOME, {"big": True}, entry="NIfTI"),
    "um.nii": Case(nifti, ("u2",), {"unit": 3}, entry="NIfTI"),
    "m.nii": Case(nifti, ("u2",), {"unit": 1}, entry="NIfTI"),
    "a.nii.gz": Case(itk, ("u1", "i2", "f4"), anatomical=True, entry="NIfTI"),
    "analyze.hdr": Case(analyze, ("u1", "i2", "f4"), entry="NIfTI"),
    "analyze_big.hdr": Case(analyze, ("i2",), {"big": True}, entry="NIfTI"),
    "folder": Case(slices, ALL, asks=True, entry="a folder of slices"),
    "folder_big": Case(slices, ("u2", "f4"), {"byteorder": ">"}, True, entry="a folder of slices"),
    "folder_lzw": Case(slices, ("u2",), {"compression": "lzw"}, True, entry="a folder of slices"),
    "folder_png": Case(slices, ("u1", "u2"), {"ending": "png"}, True, entry="a folder of slices"),
    "folder_bmp": Case(slices, ("u1",), {"ending": "bmp"}, True, entry="a folder of slices"),
    "a.isq": Case(isq, ("i2",), entry="Scanco ISQ"),
    "a.ISQ;1": Case(isq, ("i2",), entry="Scanco ISQ"),
    "a.AIM": Case(aim, ("i1", "u1", "i2", "u2", "i4", "f4"), entry="Scanco AIM"),
    "a30.aim": Case(aim30, ("i1", "u1", "i2", "u2", "i4", "f4"), entry="Scanco AIM"),
    "a.vgi": Case(vgi, ("u1", "u2", "i2", "f4"), entry="VGStudio"),
    "um.vgi": Case(vgi, ("u2",), {"unit": "um", "skip": 100}, entry="VGStudio"),
    "a.am": Case(amira, ("u1", "i2", "u2", "i4", "f4", "f8"), entry="Amira"),
    "big.am": Case(amira, ("u2", "f4"), {"big": True}, entry="Amira"),
    "um.am": Case(amira, ("u2",), {"unit": "µm"}, entry="Amira"),
    "a.raw": Case(raw, ALL, {"header": 12}, True, raw={"header_bytes": 12}, entry="raw voxels"),
    "big.raw": Case(raw, SOME, {"big": True}, True, raw={"byte_order": "big"}, entry="raw voxels"),
    "dicom": Case(dicom, ("i2", "u2", "u1"), anatomical=True, entry="DICOM"),
    "dicom_jpeg": Case(dicom, ("u2", "u1"), {"packed": True}, anatomical=True, entry="DICOM"),
    "v04.zarr": Case(ome_zarr, ALL, entry="OME-Zarr"),
    "v04_mm.zarr": Case(ome_zarr, ("u2",), {"unit": "millimeter"}, entry="OME-Zarr"),
    "v04_tc.zarr": Case(ome_zarr, ("u2",), {"leading": ("t", "c")}, entry="OME-Zarr"),
    "v04_bare.zarr": Case(ome_zarr, (">u2", "f4"), {"compressors": None}, entry="OME-Zarr"),
    "v05.zarr": Case(ome_zarr, SOME, {"version": "0.5"}, entry="OME-Zarr"),
    "v05_shards.zarr": Case(ome_zarr, ("u2", "f4"), {"version": "0.5", "shards": True}, entry="OME-Zarr"),
}
