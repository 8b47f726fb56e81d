"""Scans of every format, as the contract of readers has them: tests and damaged files are made from these."""

from dataclasses import dataclass, field

from tests.ct_inertia.readers import scanner_writers as scanners
from tests.ct_inertia.readers import writers as f

INTEGERS = ("u1", "i1", "u2", "i2", "u4", "i4")
ALL = (*INTEGERS, "f4", "f8")


@dataclass(frozen=True)
class Case:
    """A format: who writes it, in which types, and what its reader can and cannot know.

    ``held`` is how its voxels are held: ``map`` (memory-mapped), ``blocks`` (read when asked for) or
    ``whole`` (unpacked in memory, in the type of the file).
    """

    write: object
    held: str
    types: tuple[str, ...] = ("u2",)
    options: dict = field(default_factory=dict)
    asks: bool = False
    anatomical: bool = False
    raw: dict | None = None


CASES = {
    "imagej.tif": Case(f.imagej, "map", ("u1", "u2", "i2", "f4")),
    "imagej_um.tif": Case(f.imagej, "map", options={"unit": "um"}),
    "imagej_micron.tif": Case(f.imagej, "map", options={"unit": "micron"}),
    "imagej_mu.tif": Case(f.imagej, "map", options={"unit": "\\u00B5m"}),
    "imagej_nm.tif": Case(f.imagej, "map", options={"unit": "nm"}),
    "imagej_cm.tif": Case(f.imagej, "map", options={"unit": "cm"}),
    "imagej_inch.tif": Case(f.imagej, "map", options={"unit": "inch"}),
    "imagej_deflate.tif": Case(f.imagej, "blocks", ("u1", "u2", "f4"), {"compression": "zlib"}),
    "imagej_lzw.tif": Case(f.imagej, "blocks", ("u1", "u2", "f4"), {"compression": "lzw"}),
    "ome.ome.tif": Case(f.ome, "map", ALL),
    "ome_nm.ome.tif": Case(f.ome, "map", options={"unit": "nm"}),
    "ome_mm.ome.tif": Case(f.ome, "map", options={"unit": "mm"}),
    "ome_big.ome.tif": Case(f.ome, "map", ALL, {"bigtiff": True, "byteorder": ">"}),
    "ome_tiled.ome.tif": Case(f.ome, "blocks", ALL, {"tile": (16, 16), "compression": "zlib"}),
    "ome_tiles.ome.tif": Case(f.ome, "blocks", ("u2",), {"tile": (16, 16), "byteorder": ">"}),
    "ome_predicted.ome.tif": Case(f.ome, "blocks", ("u2", "f4"), {"compression": "lzw", "predictor": True}),
    "plain.tif": Case(f.plain, "map", ALL, asks=True),
    "plain_big_endian.tif": Case(f.plain, "map", ALL, {"byteorder": ">"}, asks=True),
    "plain_bigtiff.btf": Case(f.plain, "map", ("u2",), {"bigtiff": True}, asks=True),
    "plain_strips.tif": Case(f.plain, "map", ("u2",), {"rowsperstrip": 2, "metadata": None}, asks=True),
    "plain_packbits.tif": Case(f.plain, "blocks", ("u1", "u2"), {"compression": "packbits"}, asks=True),
    "plain_zstd.tif": Case(f.plain, "blocks", ("u2",), {"compression": "zstd"}, asks=True),
    "pages.tif": Case(f.pages, "map", ("u1", "u2", "f4"), asks=True),
    "pages_big_endian.tif": Case(f.pages, "map", ("u2", "f4"), {"byteorder": ">"}, asks=True),
    "pages_lzw.tif": Case(f.pages, "blocks", ALL, {"compression": "lzw"}, asks=True),
    "pages_deflate_big.tif": Case(
        f.pages, "blocks", ("u2",), {"compression": "zlib", "byteorder": ">"}, True
    ),
    "itk_lzw.tif": Case(f.itk, "blocks", ("u1", "u2"), {"packed": True, "compressor": "LZW"}, asks=True),
    "a.nrrd": Case(f.itk, "map", ALL, anatomical=True),
    "a_zip.nrrd": Case(f.itk, "whole", ALL, {"packed": True}, anatomical=True),
    "a_bare.nrrd": Case(f.nrrd, "map", ALL),
    "a_big.nrrd": Case(f.nrrd, "map", ALL, {"big": True}),
    "a_text.nrrd": Case(f.nrrd, "whole", ("u2", "i4", "f8"), {"encoding": "ascii"}),
    "a_hex.nrrd": Case(f.nrrd, "whole", ("u1", "f4"), {"encoding": "hex"}),
    "a.nhdr": Case(f.itk, "map", ("u2",), anatomical=True),
    "a.mha": Case(f.itk, "map", ALL, anatomical=True),
    "a_zip.mha": Case(f.itk, "whole", ALL, {"packed": True}, anatomical=True),
    "a_big.mha": Case(f.meta, "map", ALL, {"big": True}),
    "a_text.mha": Case(f.meta, "whole", ("i2", "f8"), {"BinaryData": "False"}),
    "a.mhd": Case(f.itk, "map", ("u2",), anatomical=True),
    "a_zip.mhd": Case(f.itk, "whole", ("u2",), {"packed": True}, anatomical=True),
    "a.nii": Case(f.itk, "map", ALL, anatomical=True),
    "a_big.nii": Case(f.nifti, "map", ALL, {"big": True}),
    "a_um.nii": Case(f.nifti, "map", ("u2",), {"unit": 3}),
    "a_m.nii": Case(f.nifti, "map", ("u2",), {"unit": 1}),
    "a.nii.gz": Case(f.itk, "whole", ALL, anatomical=True),
    "a.img": Case(f.itk, "map", ("i2",), anatomical=True),
    "analyze.hdr": Case(f.analyze, "map", ("u1", "i2", "f4")),
    "analyze_big.hdr": Case(f.analyze, "map", ("i2",), {"big": True}),
    "folder": Case(f.slices, "blocks", ALL, asks=True),
    "folder_big": Case(f.slices, "blocks", ("u2", "f4"), {"byteorder": ">"}, asks=True),
    "folder_lzw": Case(f.slices, "blocks", ("u2",), {"compression": "lzw"}, asks=True),
    "folder_png": Case(f.slices, "blocks", ("u1", "u2"), {"ending": "png"}, asks=True),
    "folder_bmp": Case(f.slices, "blocks", ("u1",), {"ending": "bmp"}, asks=True),
    "a.isq": Case(scanners.isq, "map", ("i2",)),
    "a.ISQ;1": Case(scanners.isq, "map", ("i2",)),
    "a.AIM": Case(scanners.aim, "map", ("i1", "u1", "i2", "u2", "i4", "f4")),
    "a30.aim": Case(scanners.aim30, "map", ("i1", "u1", "i2", "u2", "i4", "f4")),
    "a.vgi": Case(scanners.vgi, "map", ("u1", "u2", "i2", "f4")),
    "a_um.vgi": Case(scanners.vgi, "map", ("u2",), {"unit": "um", "skip": 100}),
    "a_parts.vgi": Case(scanners.vgi, "blocks", ("u2",), {"parts": 3}),
    "a.am": Case(scanners.amira, "map", ("u1", "i2", "u2", "i4", "f4", "f8")),
    "a_big.am": Case(scanners.amira, "map", ("u2", "f4"), {"big": True, "unit": "mm"}),
    "a_um.am": Case(scanners.amira, "map", ("u2",), {"unit": "um"}),
    "a_text.am": Case(scanners.amira, "whole", ("u1", "f8"), {"form": "ASCII"}),
    "a_runs.am": Case(scanners.amira, "whole", ("u1", "u2"), {"form": "HxByteRLE"}),
    "a_zip.am": Case(scanners.amira, "whole", ("u2", "f4"), {"form": "HxZip", "big": True}),
    "a_mu.am": Case(scanners.amira, "map", ("u2",), {"unit": "µm"}),
    "a.raw": Case(f.raw, "map", ALL, {"header": 12}, True, raw={"header_bytes": 12}),
    "a_big.raw": Case(f.raw, "map", ALL, {"big": True}, True, raw={"byte_order": "big"}),
    "dicom": Case(f.dicom, "blocks", ("i2", "u2", "u1"), anatomical=True),
    "dicom_jpeg": Case(f.dicom, "whole", ("u2", "u1"), {"packed": True}, anatomical=True),
    "frames.dcm": Case(f.frames, "whole", ("u1", "u2"), anatomical=True),
    "v04.zarr": Case(f.ome_zarr, "blocks", ALL),
    "v04_mm.zarr": Case(f.ome_zarr, "blocks", ("u2",), {"unit": "millimeter"}),
    "v04_tc.zarr": Case(f.ome_zarr, "blocks", ("u2",), {"leading": ("t", "c")}),
    "v04_bare.zarr": Case(f.ome_zarr, "blocks", (">u2", "f4"), {"compressors": None}),
    "v05.zarr": Case(f.ome_zarr, "blocks", ALL, {"version": "0.5"}),
    "v05_c.zarr": Case(f.ome_zarr, "blocks", ("u2",), {"version": "0.5", "leading": ("c",)}),
    "v05_shards.zarr": Case(f.ome_zarr, "blocks", ("u2", "f4"), {"version": "0.5", "shards": True}),
}
