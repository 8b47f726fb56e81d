"""One sentence for each bad file, whatever its format, and before memory is asked for."""

import gzip
import json

import numpy as np
import pytest
import SimpleITK as sitk
import tifffile

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.read_scan import read_volume
from legacy.ct_inertia.readers.checks import check_size
from legacy.ct_inertia.readers.raw_layout import RawLayout
from tests.ct_inertia.readers import scanner_writers as scanners
from tests.ct_inertia.readers import writers as f
from tests.ct_inertia.readers.writers import picture

NOISE = np.random.default_rng(0).integers(0, 60000, (20, 40, 40)).astype(np.uint16)
TOLD = r"must be .*b\.[a-z.]+\)\. .*[Cc]opy or export it again\.$"
FOREIGN = ("Error", "tifffile", "corrupt", "series", "TiffTag", "itk::", "Traceback")


@pytest.mark.parametrize("options", [{}, {"compression": "zlib", "metadata": None}, {"imagej": True}])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_truncated_tiff(tmp_path, options, share):
    tifffile.imwrite(tmp_path / "a.tif", NOISE, **options)
    data = (tmp_path / "a.tif").read_bytes()
    (tmp_path / "b.tif").write_bytes(data[: int(len(data) * share)])
    with pytest.raises(CtInertiaError, match=TOLD) as told:
        read_volume(tmp_path / "b.tif", 0.02)
    assert not any(word in str(told.value) for word in FOREIGN)


WRITERS = {
    "a.nrrd": f.itk,
    "a_zip.nrrd": f.itk,
    "a.mha": f.itk,
    "a_zip.mha": f.itk,
    "a.nii": f.itk,
    "a.nii.gz": f.itk,
    "a.isq": scanners.isq,
    "a.aim": scanners.aim,
    "a30.aim": scanners.aim30,
    "a.am": scanners.amira,
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("share", [0.001, 0.02, 0.6, 0.99])
def test_truncated_headers_and_data(tmp_path, name, share):
    options = {"packed": "zip" in name} if WRITERS[name] is f.itk else {}
    array = NOISE.astype(np.int16) if name.endswith(("isq", "aim")) else NOISE
    WRITERS[name](tmp_path / name, array, **options)
    data = (tmp_path / name).read_bytes()
    short = tmp_path / ("b." + name.split(".", 1)[1])
    short.write_bytes(data[: max(8, int(len(data) * share))])
    with pytest.raises(CtInertiaError, match=r"must be .*; got .*[Cc]opy or export it again\.") as told:
        read_volume(short)
    assert not any(word in str(told.value) for word in FOREIGN)


def test_a_damaged_packed_volume(tmp_path):
    for name in ("a.nii.gz", "a_zip.mha", "a_zip.nrrd"):
        f.itk(tmp_path / name, NOISE, packed=True)
        data = bytearray((tmp_path / name).read_bytes())
        data[len(data) // 2 : len(data) // 2 + 400] = bytes(400)
        (tmp_path / name).write_bytes(bytes(data))
        with pytest.raises(CtInertiaError, match=r"must be a readable (gzip|zlib) file"):
            read_volume(tmp_path / name)


HUGE = "50000 60000 70000"
CLAIM = r"as large as its header says .50000 x 60000 x 70000 voxels, \d+ TB"


def test_headers_that_claim_terabytes_are_refused_before_allocation(tmp_path):
    small = picture(np.int16)
    files = [
        f.meta(tmp_path / "a.mha", small, DimSize=HUGE),
        f.nrrd(tmp_path / "a.nrrd", small, sizes=HUGE),
        f.nrrd(tmp_path / "zip.nrrd", small, sizes=HUGE, encoding="gzip"),
    ]
    nifti = f.nifti(tmp_path / "a.nii", small)
    data = bytearray(nifti.read_bytes())
    data[42:48] = np.array([32000, 32000, 32000], "<i2").tobytes()
    nifti.write_bytes(bytes(data))
    (tmp_path / "z.nii.gz").write_bytes(gzip.compress(bytes(data)))
    isq = scanners.isq(tmp_path / "a.isq", small)
    data = bytearray(isq.read_bytes())
    data[44:56] = np.array([50000, 60000, 70000], "<i4").tobytes()
    isq.write_bytes(bytes(data))
    aim = scanners.aim30(tmp_path / "a.aim", small)
    data = bytearray(aim.read_bytes())
    data[96:120] = np.array([50000, 60000, 70000], "<i8").tobytes()
    aim.write_bytes(bytes(data))
    vgi = scanners.vgi(tmp_path / "a.vgi", small)
    vgi.write_text(vgi.read_text().replace("5 6 7", HUGE))
    amira = scanners.amira(tmp_path / "a.am", small)
    amira.write_bytes(
        amira.read_bytes().replace(b"define Lattice 5 6 7", b"define Lattice 50000 60000 70000")
    )
    for path in (*files, isq, aim, vgi, amira):
        with pytest.raises(CtInertiaError, match=CLAIM):
            read_volume(path, 0.02)
    for name in ("a.nii", "z.nii.gz"):
        with pytest.raises(CtInertiaError, match=r"32000 x 32000 x 32000 voxels, 65\.5 TB"):
            read_volume(tmp_path / name)
    with pytest.raises(CtInertiaError, match="small enough to unpack"):
        check_size((10**4, 10**4, 10**5), np.dtype("u2"), 10**12, "x.tif", packing="deflate", in_memory=True)


def test_a_zarr_that_claims_terabytes_is_refused(tmp_path):
    path = f.ome_zarr(tmp_path / "a.zarr", picture())
    meta = json.loads((path / "0" / ".zarray").read_text())
    (path / "0" / ".zarray").write_text(json.dumps(meta | {"shape": [70000, 60000, 50000]}))
    with pytest.raises(CtInertiaError, match="a claim of 50000 x 60000 x 70000 voxels"):
        read_volume(path)


def test_header_without_spacing_or_data(tmp_path):
    f.itk(tmp_path / "a.mhd", picture())
    text = (tmp_path / "a.mhd").read_text(encoding="utf-8")
    (tmp_path / "b.mhd").write_text("\n".join(x for x in text.splitlines() if "Spacing" not in x))
    for path in (
        tmp_path / "b.mhd",
        f.nrrd(tmp_path / "a.nrrd", picture(), spacings=None),
        scanners.vgi(tmp_path / "a.vgi", picture(), unit=""),
        scanners.amira(tmp_path / "a.am", picture(), unit=""),
    ):
        with pytest.raises(
            CtInertiaError, match=r"voxel spacing must be in the file or given; got none.*--spacing"
        ):
            read_volume(path)
    (tmp_path / "a.raw").unlink()
    with pytest.raises(CtInertiaError, match=r"in the folder of the header; got no a\.raw"):
        read_volume(tmp_path / "a.mhd")
    (tmp_path / "a-0.vol").unlink()
    with pytest.raises(CtInertiaError, match=r"in the folder of the header; got no a-0\.vol"):
        read_volume(tmp_path / "a.vgi", 0.02)


@pytest.mark.parametrize(
    ("write", "fields", "message"),
    [
        (f.nrrd, {"data file": "s%03d.raw 0 x 1"}, "data files s%03d.raw 0 x 1"),
        (f.nrrd, {"data file": "s%03d%03d.raw 0 6 1"}, "data files s%03d%03d.raw 0 6 1"),
        (f.nrrd, {"data file": "a.raw", "byte skip": "some"}, "byte skip some"),
        (f.nrrd, {"data file": "LIST"}, "an empty list of data files"),
        (f.nrrd, {"spacings": "1 2"}, "2 spacings for 3 axes"),
        (f.nrrd, {"spacings": None, "space directions": "(1,0,0) (0,1,0) (0,0,x)"}, r"the vector \(0,0,x\)"),
        (f.nrrd, {"encoding": "base64"}, "encoding must be one of raw, gzip, .*; got base64"),
        (f.nrrd, {"type": "block"}, "got type block"),
        (f.meta, {"data": "s%03d.raw 0"}, "data files s%03d.raw 0"),
        (f.meta, {"data": "s%03d.raw 0 6 0"}, "data files s%03d.raw 0 6 0"),
        (f.meta, {"ElementSpacing": "1 2 x"}, "ElementSpacing = 1 2 x"),
        (f.meta, {"ElementType": "MET_OTHER"}, "ElementType MET_OTHER"),
        (f.meta, {"DimSize": None}, "a header without DimSize"),
    ],
)
def test_headers_that_make_no_sense(tmp_path, write, fields, message):
    path = write(tmp_path / ("a.nhdr" if write is f.nrrd else "a.mhd"), picture(), **fields)
    with pytest.raises(CtInertiaError, match=message):
        read_volume(path, 0.02)


BAD_TIFF = {
    "flat.tif": (picture()[0], {}, "three-dimensional; got an image of shape 5 x 6"),
    "rgb.tif": (np.zeros((4, 6, 5, 3), np.uint8), {"photometric": "rgb"}, "colour"),
    "complex.tif": (picture().astype(np.complex64), {}, "complex"),
    "constant.tif": (np.full((5, 6, 7), 7, np.uint8), {"photometric": "minisblack"}, "got 7 in every voxel"),
    "channels.tif": (
        np.zeros((3, 2, 6, 5), np.uint8),
        {"imagej": True, "metadata": {"axes": "ZCYX"}},
        r"a stack of one grey value per voxel; got 2 C \(channels or times\)",
    ),
    "times.ome.tif": (
        np.zeros((4, 3, 6, 5), np.uint16),
        {"metadata": {"axes": "TZYX"}},
        r"a stack of one grey value per voxel; got 4 T \(channels or times\)",
    ),
}


@pytest.mark.parametrize("name", BAD_TIFF)
def test_bad_tiff_content(tmp_path, name):
    array, options, message = BAD_TIFF[name]
    tifffile.imwrite(tmp_path / name, array, **options)
    with pytest.raises(CtInertiaError, match=message):
        read_volume(tmp_path / name, 0.02)


@pytest.mark.parametrize("ending", ["nrrd", "mha", "nii"])
def test_colour_vector_complex_and_flat_images_in_open_formats(tmp_path, ending):
    flat = tmp_path / f"flat.{ending}"
    sitk.WriteImage(sitk.GetImageFromArray(picture(np.int16)[0]), str(flat))
    with pytest.raises(CtInertiaError, match="three-dimensional"):
        read_volume(flat, 0.02)
    vector = sitk.GetImageFromArray(np.zeros((4, 5, 6, 3), np.uint8), isVector=True)
    sitk.WriteImage(vector, str(tmp_path / f"v.{ending}"))
    with pytest.raises(CtInertiaError, match=r"one grey value per voxel; got 3|real grey values|a colour"):
        read_volume(tmp_path / f"v.{ending}", 0.02)
    numbers = sitk.GetImageFromArray(np.ones((4, 5, 6), np.complex64))
    if ending != "mha":
        sitk.WriteImage(numbers, str(tmp_path / f"c.{ending}"))
        with pytest.raises(CtInertiaError, match=r"one grey value per voxel|complex"):
            read_volume(tmp_path / f"c.{ending}", 0.02)


@pytest.mark.parametrize("name", ["a.tif", "a.nrrd", "a.zarr", "folder"])
def test_not_finite_voxels(tmp_path, name):
    array = picture(np.float32)
    array[3, 3, 3] = np.nan
    array[3, 3, 4] = np.inf
    write = {"a.tif": f.plain, "a.nrrd": f.nrrd, "a.zarr": f.ome_zarr, "folder": f.slices}[name]
    write(tmp_path / name, array)
    with pytest.raises(CtInertiaError, match=r"finite; got 2 voxels .*--nan-as-air"):
        read_volume(tmp_path / name, 0.02)
    assert read_volume(tmp_path / name, 0.02, nan_as_air=True).nan_as_air


def test_files_that_are_no_scans(tmp_path):
    with pytest.raises(CtInertiaError, match="an existing file or folder"):
        read_volume(tmp_path / "none.tif")
    (tmp_path / "empty.tif").write_bytes(b"")
    with pytest.raises(CtInertiaError, match="an empty file"):
        read_volume(tmp_path / "empty.tif")
    for ending, kind in {
        "tif": "TIFF",
        "nrrd": "NRRD volume",
        "mha": "MetaImage volume",
        "nii": "NIfTI volume",
        "nii.gz": "NIfTI volume",
        "isq": "ISQ file",
        "aim": "AIM file",
        "vgi": "VGI header",
        "am": "Amira lattice",
        "dcm": "DICOM file",
    }.items():
        (tmp_path / f"junk.{ending}").write_bytes(b"NRRD0004\nhello world\n" * 20)
        with pytest.raises(CtInertiaError, match=f"readable {kind}"):
            read_volume(tmp_path / f"junk.{ending}", 0.02)


def test_bad_folders(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(CtInertiaError, match="a series of numbered slices"):
        read_volume(tmp_path / "empty", 0.02)
    f.slices(tmp_path / "f", picture())
    tifffile.imwrite(tmp_path / "f" / "rec_9.tif", np.zeros((4, 4), np.uint16))
    with pytest.raises(CtInertiaError, match=r"rec_9.tif must be 5 x 6 uint16 like rec_8.tif; got 4 x 4"):
        read_volume(tmp_path / "f", 0.02)
    tifffile.imwrite(tmp_path / "f" / "rec_9.tif", picture(np.uint8)[0])
    with pytest.raises(CtInertiaError, match=r"must be 5 x 6 uint16 like rec_8.tif; got 5 x 6 uint8"):
        read_volume(tmp_path / "f", 0.02)
    (tmp_path / "f" / "rec_9.tif").write_bytes(b"nothing")
    with pytest.raises(CtInertiaError, match="readable slice image"):
        read_volume(tmp_path / "f", 0.02)
    tifffile.imwrite(tmp_path / "f" / "rec_09.tif", picture()[0])
    with pytest.raises(CtInertiaError, match="slice numbers must be unique; got number 9 twice"):
        read_volume(tmp_path / "f", 0.02)
    (tmp_path / "f" / "rec_09.tif").unlink()
    for k, image in enumerate(picture()):
        tifffile.imwrite(tmp_path / "f" / f"other_{k}.tif", image)
    with pytest.raises(CtInertiaError, match=r"one series of .* got .*other_#\.tif \(7 slices\)"):
        read_volume(tmp_path / "f", 0.02)
    f.slices(
        tmp_path / "rgb",
        np.random.default_rng(0).integers(0, 255, (3, 4, 5, 3)).astype(np.uint8),
        ending="png",
    )
    with pytest.raises(CtInertiaError, match="must be grey values; got a colour"):
        read_volume(tmp_path / "rgb", 0.02)


def test_bad_dicom_folders(tmp_path):
    f.dicom(tmp_path / "d", picture(np.int16))
    (tmp_path / "d" / "1_5.dcm").unlink()
    with pytest.raises(CtInertiaError, match="distance of DICOM slices must be even"):
        read_volume(tmp_path / "d")
    f.dicom(tmp_path / "two", picture(np.int16))
    f.dicom(tmp_path / "two", picture(np.int16), series="2")
    with pytest.raises(CtInertiaError, match=r"one DICOM series; got 2 series: ear 1 \(7 files\), ear 2"):
        read_volume(tmp_path / "two")
    with pytest.raises(CtInertiaError, match="one of several frames; got a single slice"):
        read_volume(tmp_path / "two" / "1_9.dcm")


def test_bad_scanco_files(tmp_path):
    data = scanners.isq(tmp_path / "a.isq", picture()).read_bytes()
    (tmp_path / "head.isq").write_bytes(data[:100])
    with pytest.raises(CtInertiaError, match="100 bytes, less than its header of 512"):
        read_volume(tmp_path / "head.isq")
    (tmp_path / "zero.isq").write_bytes(data[:44] + bytes(12) + data[56:])
    with pytest.raises(CtInertiaError, match="size in the header must be positive"):
        read_volume(tmp_path / "zero.isq")
    packed = bytearray(scanners.aim(tmp_path / "a.aim", picture()).read_bytes())
    packed[40:44] = np.array([0x00080002], "<i4").tobytes()
    (tmp_path / "packed.aim").write_bytes(bytes(packed))
    with pytest.raises(CtInertiaError, match="not packed; got type 0x80002"):
        read_volume(tmp_path / "packed.aim")
    (tmp_path / "new.aim").write_bytes(b"AIMDATA_V030   " + bytes(300))
    with pytest.raises(CtInertiaError, match="a readable AIM file; got blocks of 0, 0 and 0 bytes"):
        read_volume(tmp_path / "new.aim")


def test_bad_vgi_and_amira_files(tmp_path):
    path = scanners.vgi(tmp_path / "a.vgi", picture())
    text = path.read_text()
    for old, new, message in (
        ("BitsPerElement = 16", "BitsPerElement = 12", "BitsPerElement = 12"),
        ("Size = 5 6 7", "Size = 5 6", "Size = 5 6"),
        ("[file1]", "[fill1]", r"no section \[file1\]"),
        ("FileFormat = raw", "FileFormat = jpeg", "FileFormat must be raw; got jpeg"),
    ):
        path.write_text(text.replace(old, new))
        with pytest.raises(CtInertiaError, match=message):
            read_volume(path)
    data = scanners.amira(tmp_path / "a.am", picture()).read_bytes()
    for old, new, message in (
        (b"BINARY-LITTLE-ENDIAN", b"ASCII", "a readable text file"),
        (b"Data } @1", b"Data } @1(HxByteRLE,99)", r"packed volume must be complete \(420 bytes"),
        (b"Data } @1", b"Data } @1(HxPNG,99)", "not packed, or by HxByteRLE, HxZip; got HxPNG"),
        (b"ushort Data", b"ushort[3] Data", "one grey value per voxel"),
        (b'CoordType "uniform"', b'CoordType "curvilinear"', "not a uniform one"),
    ):
        (tmp_path / "b.am").write_bytes(data.replace(old, new))
        with pytest.raises(CtInertiaError, match=message):
            read_volume(tmp_path / "b.am")


def test_bad_zarr_folders(tmp_path):
    path = f.ome_zarr(tmp_path / "a.zarr", picture(), "0.5")
    array = json.loads((path / "0" / "zarr.json").read_text())
    array["codecs"].append({"name": "sz3", "configuration": {}})
    (path / "0" / "zarr.json").write_text(json.dumps(array))
    with pytest.raises(CtInertiaError, match=r"the Zarr codec must be one of blosc.*; got sz3"):
        read_volume(path)
    path = f.ome_zarr(tmp_path / "b.zarr", picture(), leading=("c",))
    array = json.loads((path / "0" / ".zarray").read_text())
    (path / "0" / ".zarray").write_text(json.dumps(array | {"shape": [2, *array["shape"][1:]]}))
    with pytest.raises(CtInertiaError, match=r"one grey value per voxel; got 2 c \(channels"):
        read_volume(path)
    path = f.ome_zarr(tmp_path / "c.zarr", picture())
    chunk = next(p for p in (path / "0").rglob("*") if p.is_file() and not p.name.startswith("."))
    chunk.write_bytes(b"damaged")
    with pytest.raises(CtInertiaError, match="readable Zarr chunk"):
        np.asarray(read_volume(path).array)
    for name, content in ((".zattrs", "{"), (".zattrs", "{}"), (".zattrs", '{"multiscales": [{}]}')):
        (path / name).write_text(content)
        with pytest.raises(CtInertiaError, match=r"readable (Zarr folder|OME-Zarr image)"):
            read_volume(path)


def test_bad_raw_layouts(tmp_path):
    path = f.raw(tmp_path / "a.raw", picture(), header=12)
    with pytest.raises(CtInertiaError, match=r"420 bytes\); got 432 bytes .*--header-bytes 12 would fit"):
        read_volume(path, 0.02, raw=RawLayout((5, 6, 7), "uint16"))
    with pytest.raises(CtInertiaError, match=r"the raw file must be as long as 50000 x 60000 x 70000 voxels"):
        read_volume(path, 0.02, raw=RawLayout((50000, 60000, 70000), "uint16"))
    for layout, message in (
        (((5, 6), "uint16"), "--shape must be three whole numbers"),
        (((5, 6, 1), "uint16"), "--shape must be three whole numbers"),
        (((5, 6, 7), "uint12"), "--dtype must be one of uint8, int8"),
        (((5, 6, 7), "uint16", "middle"), "--byte-order must be one of little, big; got middle"),
        (((5, 6, 7), "uint16", "big", -1), "--header-bytes must be 0 or more; got -1"),
    ):
        with pytest.raises(CtInertiaError, match=message):
            RawLayout(*layout)


def test_bad_mirror(tmp_path):
    with pytest.raises(CtInertiaError, match="--mirror must be x, y or z"):
        read_volume(f.imagej(tmp_path / "a.tif", picture()), mirror="u")
