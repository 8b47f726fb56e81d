"""Writers of the open formats that scans come in, by other libraries or from their own description.

Each writes an array [z, y, x] with voxels of `SPACING` and returns the path to open.
"""

from __future__ import annotations

import json
import locale
import struct

import numpy as np
import SimpleITK as sitk
import tifffile

SPACING = np.array([0.02, 0.025, 0.03])
# The corners of the picture carry their own names: which of low/high x, y, z they are.
CORNERS = {(i, j, k): 10 + 10 * i + 20 * j + 40 * k for i in (0, 1) for j in (0, 1) for k in (0, 1)}


def picture(dtype="u2", shape=(7, 6, 5)):
    array = np.random.default_rng(1).integers(0, 9, shape).astype(dtype)
    for (i, j, k), value in CORNERS.items():
        array[-k, -j, -i] = value
    return array


def check_corners(scan, origin=(0, 0, 0), mirrored=""):
    """Assert that every corner is where its name says, looked up by scan coordinates."""
    voxels = scan.read()
    far = (scan.size - 1) * SPACING
    for corner, value in CORNERS.items():
        named = [1 - c if axis in mirrored else c for c, axis in zip(corner, "xyz", strict=True)]
        index = np.rint(scan.index_points(np.array(origin) + far * named)).astype(int)
        assert voxels[tuple(index[::-1].tolist())] == value


def plain(path, array, **options):
    tifffile.imwrite(path, array, photometric="minisblack", **options)
    return path


def pages(path, array, **options):
    """Pages written one by one, each with its own tags between the pictures."""
    with tifffile.TiffWriter(path, byteorder=options.pop("byteorder", None)) as tif:
        for plane in array:
            tif.write(plane, metadata=None, contiguous=False, photometric="minisblack", **options)
    return path


UNITS = {"mm": 1.0, "um": 1e3, "cm": 0.1, "inch": 1 / 25.4, "\\u00B5m": 1e3, "micron": 1e3, "nm": 1e6}


def imagej(path, array, unit="mm", spacing=SPACING, **options):
    x, y, z = np.asarray(spacing) * UNITS[unit]
    metadata = {"spacing": z, "unit": unit, "axes": "ZYX"} | options.pop("metadata", {})
    metadata = {key: value for key, value in metadata.items() if value is not None}
    tifffile.imwrite(path, array, imagej=True, resolution=(1 / x, 1 / y), metadata=metadata, **options)
    return path


def ome(path, array, unit="µm", **options):
    scale = {"µm": 1e3, "nm": 1e6, "mm": 1.0}[unit]
    metadata = {"axes": "ZYX"}
    for axis, value in zip("XYZ", SPACING, strict=True):
        metadata |= {f"PhysicalSize{axis}": value * scale, f"PhysicalSize{axis}Unit": unit}
    metadata |= options.pop("metadata", {})
    tifffile.imwrite(path, array, metadata=metadata, photometric="minisblack", **options)
    return path


def ome_files(path, array):
    """An OME image whose planes lie in two files."""
    half = len(array) // 2
    other = path.with_name("b.ome.tif")
    for file, part in ((path, array[:half]), (other, array[half:])):
        tifffile.imwrite(file, part, photometric="minisblack", metadata=None)
    planes = ""
    for name, first, count in ((path.name, 0, half), (other.name, half, len(array) - half)):
        for k in range(count):
            unique = f'<UUID FileName="{name}">urn:uuid:{name}</UUID>'
            planes += f'<TiffData IFD="{k}" FirstZ="{first + k}" PlaneCount="1">{unique}</TiffData>'
    sizes = "".join(f'Size{a}="{n}" ' for a, n in zip("ZYX", array.shape, strict=True))
    lengths = "".join(f'PhysicalSize{a}="{v * 1e3:g}" ' for a, v in zip("XYZ", SPACING, strict=True))
    xml = (
        '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" '
        f'UUID="urn:uuid:{path.name}"><Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="XYZCT" '
        f'Type="uint16" {sizes}SizeC="1" SizeT="1" {lengths}>{planes}</Pixels></Image></OME>'
    )
    tifffile.tiffcomment(path, xml.encode())
    return path


def itk(path, array, direction=None, origin=(0.0, 0.0, 0.0), packed=False, compressor=None):
    before = locale.setlocale(locale.LC_ALL)  # the DICOM writer sets it to "C"
    image = sitk.GetImageFromArray(array)
    image.SetSpacing(SPACING.tolist())
    image.SetOrigin(list(origin))
    if direction is not None:
        image.SetDirection(np.asarray(direction, dtype=float).ravel().tolist())
    writer = sitk.ImageFileWriter()
    writer.SetFileName(str(path))
    writer.SetUseCompression(packed)
    if compressor:
        writer.SetCompressor(compressor)
    writer.Execute(image)
    locale.setlocale(locale.LC_ALL, before)
    return path


NAMES = {"u1": "UCHAR", "i1": "CHAR", "u2": "USHORT", "i2": "SHORT", "u4": "UINT", "i4": "INT"}
NAMES |= {"f4": "FLOAT", "f8": "DOUBLE"}


def nrrd(path, array, big=False, **fields):
    kind = {"f4": "float", "f8": "double"}.get(array.dtype.str[1:], array.dtype.name)
    stated = {
        "type": kind,
        "dimension": 3,
        "sizes": " ".join(map(str, array.shape[::-1])),
        "endian": "big" if big else "little",
        "encoding": "raw",
        "spacings": " ".join(f"{s:g}" for s in SPACING),
    } | {name.replace("_", " "): value for name, value in fields.items()}
    text = "NRRD0004\n# made for a test\n"
    text += "".join(f"{key}: {value}\n" for key, value in stated.items() if value is not None)
    voxels = array.astype(array.dtype.newbyteorder(">" if big else "<")).tobytes()
    path.write_bytes(text.encode() + (b"" if "data file" in stated else b"\n" + voxels))
    return path


def meta(path, array, big=False, data=None, **fields):
    stated = {
        "ObjectType": "Image",
        "NDims": 3,
        "BinaryData": "True",
        "ElementByteOrderMSB": str(big),
        "DimSize": " ".join(map(str, array.shape[::-1])),
        "ElementSpacing": " ".join(f"{s:g}" for s in SPACING),
        "ElementType": "MET_" + NAMES[array.dtype.str[1:]],
    } | fields
    text = "".join(f"{key} = {value}\n" for key, value in stated.items() if value is not None)
    voxels = array.astype(array.dtype.newbyteorder(">" if big else "<")).tobytes()
    path.write_bytes(f"{text}ElementDataFile = {data or 'LOCAL'}\n".encode() + (b"" if data else voxels))
    return path


def nifti(path, array, big=False, slope=1.0, inter=0.0, unit=2, sform=None, qform=None):
    """NIfTI-1 from its description (nifti1.h); ``qform`` is (quaternion b c d, offset x y z)."""
    order = ">" if big else "<"
    kinds = {"u1": 2, "i2": 4, "i4": 8, "f4": 16, "f8": 64, "i1": 256, "u2": 512, "u4": 768}
    steps = SPACING * {1: 1e-3, 2: 1.0, 3: 1e3, 0: 1.0}[unit]
    head = bytearray(352)
    struct.pack_into(order + "i", head, 0, 348)
    struct.pack_into(order + "8h", head, 40, 3, *array.shape[::-1], 1, 1, 1, 1)
    struct.pack_into(order + "2h", head, 70, kinds[array.dtype.str[1:]], array.dtype.itemsize * 8)
    struct.pack_into(order + "8f", head, 76, 1.0, *steps, 0, 0, 0, 0)
    struct.pack_into(order + "3f", head, 108, 352, slope, inter)
    head[123] = unit
    struct.pack_into(order + "2h", head, 252, qform is not None, sform is not None)
    if qform is not None:
        struct.pack_into(order + "6f", head, 256, *qform)
    if sform is not None:
        struct.pack_into(order + "12f", head, 280, *np.asarray(sform, dtype=float).ravel())
    head[344:348] = b"n+1\0"
    path.write_bytes(bytes(head) + array.astype(array.dtype.newbyteorder(order)).tobytes())
    return path


def analyze(path, array, big=False):
    """A header of Analyze 7.5: that of NIfTI without its magic, its voxels beside it."""
    whole = bytearray(nifti(path, array, big).read_bytes())
    whole[108:112] = bytes(4)
    path.write_bytes(bytes(whole[:344]) + bytes(4))
    path.with_suffix(".img").write_bytes(whole[352:])
    return path


def slices(path, array, ending="tif", **options):
    path.mkdir()
    for k, image in enumerate(array):
        file = path / f"rec_{k + 8}.{ending}"
        if ending == "tif":
            tifffile.imwrite(file, image, photometric="minisblack", **options)
        else:
            from PIL import Image

            Image.fromarray(image).save(file)
    (path / "rec.txt").write_text("not an image")
    return path


LOG = """[System]
Camera Pixel Size (um)=74.8
[Acquisition]
Image Pixel Size (um)=9.9
[Reconstruction]
First Section=8
Section to Section Step=1
Sections Count={count}
Result Image Width (pixels)={width}
Result Image Height (pixels)={height}
Pixel Size (um)={size}
"""


def skyscan_log(array, size=20.0, **other):
    stated = {"count": array.shape[0], "height": array.shape[1], "width": array.shape[2], "size": size}
    return LOG.format(**stated | other)


def dicom(path, array, series="1", packed=False, spacing=SPACING, **tags):
    before = locale.setlocale(locale.LC_ALL)
    path.mkdir(exist_ok=True)
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    writer.SetUseCompression(packed)
    writer.SetCompressor("JPEG")
    for k, image in enumerate(array):
        slice_ = sitk.GetImageFromArray(image[None])
        slice_.SetSpacing(spacing.tolist())
        slice_.SetOrigin([0, 0, k * spacing[2]])
        stated = {
            "0008|0060": "CT",
            "0020|000e": f"1.2.826.0.1.3680043.2.1125.{series}",
            "0020|000d": "1.2.826.0.1.3680043.2.1125.2",
            "0008|0018": f"1.2.826.0.1.3680043.2.1125.3{series}.{k}",
            "0008|103e": f"ear {series}",
            "0020|0032": f"0\\0\\{k * spacing[2]}",
            "0020|0037": "1\\0\\0\\0\\1\\0",
            "0020|0013": str(len(array) - k),
        }
        for tag, value in (stated | tags).items():
            slice_.SetMetaData(tag, value)
        writer.SetFileName(str(path / f"{series}_{999 - k}.dcm"))
        writer.Execute(slice_)
    locale.setlocale(locale.LC_ALL, before)
    return path


def raw(path, array, big=False, header=0):
    path.write_bytes(bytes(header) + array.astype(array.dtype.newbyteorder(">" if big else "<")).tobytes())
    return path


def ome_zarr(path, array, version="0.4", unit="micrometer", leading=(), chunk=4, spacing=SPACING, **options):
    """An image of two levels by the zarr package; ``leading`` names further axes of one entry."""
    import zarr

    axes = [{"name": name, "type": "channel" if name == "c" else "time"} for name in leading]
    axes += [{"name": name, "type": "space", "unit": unit} if unit else {"name": name} for name in "zyx"]
    factor = {"micrometer": 1e3, "millimeter": 1.0}.get(unit, 1.0)
    scale = [1.0] * len(leading) + (spacing[::-1] * factor).tolist()
    full = array[(None,) * len(leading)]
    group = zarr.create_group(path, zarr_format=3 if version == "0.5" else 2)
    datasets = []
    for number, level in enumerate((full, full[..., ::2, ::2, ::2])):
        made = {"chunks": tuple(min(chunk, n) for n in level.shape), "dtype": level.dtype, **options}
        if "shards" in made:
            made["shards"] = tuple(-(-n // 4) * 4 if n > 1 else 1 for n in level.shape)
            made["chunks"] = tuple(4 if n > 1 else 1 for n in level.shape)
        group.create_array(str(number), shape=level.shape, **made)[...] = level
        steps = [s * (2**number if k >= len(leading) else 1) for k, s in enumerate(scale)]
        datasets.append(
            {"path": str(number), "coordinateTransformations": [{"type": "scale", "scale": steps}]}
        )
    entry = {"axes": axes, "datasets": datasets, "name": "ear"}
    stated = {"multiscales": [entry | ({} if version == "0.5" else {"version": version})]}
    group.attrs.update({"ome": {"version": "0.5", **stated}} if version == "0.5" else stated)
    return path


def change_zarr(path, change):
    """Change the multiscales entry of an image on disk."""
    file = path / (".zattrs" if (path / ".zattrs").is_file() else "zarr.json")
    content = json.loads(file.read_text())
    attributes = content if file.name == ".zattrs" else content["attributes"]["ome"]
    change(attributes["multiscales"][0])
    file.write_text(json.dumps(content))
