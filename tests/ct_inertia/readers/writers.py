"""Writers of every format that the readers know, made of other libraries or of the format's own description.

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


def picture(dtype=np.uint16, shape=(7, 6, 5)):
    array = np.random.default_rng(1).integers(0, 9, shape).astype(dtype)
    for (i, j, k), value in CORNERS.items():
        array[-k, -j, -i] = value
    return array


def check_corners(volume, spacing=SPACING, origin=(0, 0, 0), mirrored=""):
    far = (volume.size - 1) * spacing
    for corner, value in CORNERS.items():
        named = [1 - c if axis in mirrored else c for c, axis in zip(corner, "xyz", strict=True)]
        index = np.rint(volume.index_points(np.array(origin) + far * named)).astype(int)
        assert volume.array[tuple(index[::-1].tolist())] == value


def plain(path, array, **options):
    tifffile.imwrite(path, array, photometric="minisblack", **options)
    return path


def pages(path, array, **options):
    """Pages written one by one, each with its own tags between the pictures."""
    with tifffile.TiffWriter(path, byteorder=options.pop("byteorder", None)) as tif:
        for plane in array:
            tif.write(plane, metadata=None, contiguous=False, photometric="minisblack", **options)
    return path


def imagej(path, array, unit="mm", **options):
    scale = {"mm": 1.0, "um": 1e3, "cm": 0.1, "inch": 1 / 25.4, "\\u00B5m": 1e3, "micron": 1e3, "nm": 1e6}[
        unit
    ]
    x, y, z = SPACING * scale
    tifffile.imwrite(
        path,
        array,
        imagej=True,
        resolution=(1 / x, 1 / y),
        metadata={"spacing": z, "unit": unit, "axes": "ZYX"},
        **options,
    )
    return path


def ome(path, array, unit="µm", **options):
    scale = {"µm": 1e3, "nm": 1e6, "mm": 1.0}[unit]
    metadata = {"axes": "ZYX"}
    for axis, value in zip("XYZ", SPACING, strict=True):
        metadata |= {f"PhysicalSize{axis}": value * scale, f"PhysicalSize{axis}Unit": unit}
    tifffile.imwrite(path, array, metadata=metadata, photometric="minisblack", **options)
    return path


def itk(path, array, **options):
    image = sitk.GetImageFromArray(array)
    image.SetSpacing(SPACING.tolist())
    writer = sitk.ImageFileWriter()
    writer.SetFileName(str(path))
    writer.SetUseCompression(options.get("packed", False))
    if "compressor" in options:
        writer.SetCompressor(options["compressor"])
    writer.Execute(image)
    return path


def itk_turned(path, array, direction, origin=(0.0, 0.0, 0.0)):
    image = sitk.GetImageFromArray(array)
    image.SetSpacing(SPACING.tolist())
    image.SetOrigin(list(origin))
    image.SetDirection(np.asarray(direction, dtype=float).ravel().tolist())
    sitk.WriteImage(image, str(path))
    return path


def nrrd(path, array, big=False, **fields):
    names = {"u1": "uint8", "i1": "int8", "u2": "uint16", "i2": "int16", "u4": "uint32", "i4": "int32"}
    names |= {"f4": "float", "f8": "double"}
    told = {
        "type": names[array.dtype.str[1:]],
        "dimension": 3,
        "sizes": " ".join(map(str, array.shape[::-1])),
        "endian": "big" if big else "little",
        "encoding": "raw",
        "spacings": " ".join(f"{s:g}" for s in SPACING),
    } | fields
    text = "NRRD0004\n# made for a test\n" + "".join(f"{k}: {v}\n" for k, v in told.items() if v is not None)
    voxels = array.astype(array.dtype.newbyteorder(">" if big else "<")).tobytes()
    if told["encoding"] in ("ascii", "txt"):
        voxels = in_words(array)
    if told["encoding"] == "hex":
        digits = voxels.hex()
        voxels = "\n".join(digits[k : k + 35] for k in range(0, len(digits), 35)).encode()
    path.write_bytes(text.encode() + b"\n" + voxels)
    return path


def in_words(array):
    """The numbers of an array as text, a row a line."""
    rows = array.reshape(-1, array.shape[-1]).tolist()
    return "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()


def meta(path, array, big=False, data=None, **fields):
    names = {"u1": "UCHAR", "i1": "CHAR", "u2": "USHORT", "i2": "SHORT", "u4": "UINT", "i4": "INT"}
    names |= {"f4": "FLOAT", "f8": "DOUBLE"}
    told = {
        "ObjectType": "Image",
        "NDims": 3,
        "BinaryData": "True",
        "ElementByteOrderMSB": str(big),
        "DimSize": " ".join(map(str, array.shape[::-1])),
        "ElementSpacing": " ".join(f"{s:g}" for s in SPACING),
        "ElementType": "MET_" + names[array.dtype.str[1:]],
    } | fields
    text = "".join(f"{k} = {v}\n" for k, v in told.items() if v is not None)
    voxels = array.astype(array.dtype.newbyteorder(">" if big else "<")).tobytes()
    if told["BinaryData"] == "False":
        voxels = in_words(array)
    path.write_bytes(f"{text}ElementDataFile = {data or 'LOCAL'}\n".encode() + (b"" if data else voxels))
    return path


def analyze(path, array, big=False):
    """A header of Analyze 7.5: that of NIfTI without its magic, its voxels beside it."""
    nifti(path, array, big)
    whole = path.read_bytes()
    path.write_bytes(whole[:344] + bytes(4))
    path.with_suffix(".img").write_bytes(whole[352:])
    return path


def nifti(path, array, big=False, slope=1.0, inter=0.0, unit=2, sform=None):
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
    if sform is not None:
        struct.pack_into(order + "2h", head, 252, 0, 1)
        struct.pack_into(order + "12f", head, 280, *np.asarray(sform, dtype=float).ravel())
    head[344:348] = b"n+1\0"
    path.write_bytes(bytes(head) + array.astype(array.dtype.newbyteorder(order)).tobytes())
    return path


def slices(path, array, **options):
    path.mkdir()
    ending = options.pop("ending", "tif")
    for k, image in enumerate(array):
        file = path / f"rec_{k + 8}.{ending}"
        if ending == "tif":
            tifffile.imwrite(file, image, photometric="minisblack", **options)
        else:
            from imageio.v3 import imwrite

            imwrite(file, image)
    (path / "rec.txt").write_text("not an image")
    return path


def skyscan(path, array):
    slices(path, array)
    (path / "rec__spr.bmp").write_bytes(b"a preview")
    size = SPACING[0] * 1e3
    (path / "rec_.log").write_text(
        "[System]\nCamera Pixel Size (um)=74.8\n[Acquisition]\nImage Pixel Size (um)=9.9\n"
        f"[Reconstruction]\nPixel Size (um)={size}\nSection to Section Step=1\nFirst Section=8\n"
    )
    return path


def dicom(path, array, series="1", packed=False, **tags):
    before = locale.setlocale(locale.LC_ALL)  # the DICOM writer sets it to "C"
    path.mkdir(exist_ok=True)
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    writer.SetUseCompression(packed)
    writer.SetCompressor("JPEG")
    for k, image in enumerate(array):
        slice_ = sitk.GetImageFromArray(image[None])
        slice_.SetSpacing(SPACING.tolist())
        slice_.SetOrigin([0, 0, k * SPACING[2]])
        for tag, value in {
            "0008|0060": "CT",
            "0020|000e": f"1.2.826.0.1.3680043.2.1125.{series}",
            "0020|000d": "1.2.826.0.1.3680043.2.1125.2",
            "0008|0018": f"1.2.826.0.1.3680043.2.1125.3{series}.{k}",
            "0008|103e": f"ear {series}",
            "0020|0032": f"0\\0\\{k * SPACING[2]}",
            "0020|0037": "1\\0\\0\\0\\1\\0",
            "0020|0013": str(len(array) - k),
            **tags,
        }.items():
            slice_.SetMetaData(tag, value)
        writer.SetFileName(str(path / f"{series}_{9 - k}.dcm"))
        writer.Execute(slice_)
    locale.setlocale(locale.LC_ALL, before)
    return path


def frames(path, array):
    """One DICOM file of several frames."""
    before = locale.setlocale(locale.LC_ALL)  # the DICOM writer sets it to "C"
    itk(path, array)
    locale.setlocale(locale.LC_ALL, before)
    return path


def raw(path, array, big=False, header=0):
    path.write_bytes(bytes(header) + array.astype(array.dtype.newbyteorder(">" if big else "<")).tobytes())
    return path


def ome_zarr(path, array, version="0.4", unit="micrometer", leading=(), chunk=4, **options):
    """An image of two levels by the zarr package; ``leading`` names further axes of one entry."""
    import zarr

    third = version == "0.5"
    axes = [{"name": name, "type": "channel" if name == "c" else "time"} for name in leading]
    axes += [{"name": name, "type": "space", "unit": unit} for name in "zyx"]
    if not unit:
        axes = [{"name": a["name"]} for a in axes]
    scale = [1.0] * len(leading) + (
        SPACING[::-1] * {"micrometer": 1e3, "millimeter": 1.0}.get(unit, 1.0)
    ).tolist()
    full = array[(None,) * len(leading)]
    group = zarr.create_group(path, zarr_format=3 if third else 2)
    datasets = []
    for number, level in enumerate((full, full[..., ::2, ::2, ::2])):
        chunks = tuple(min(chunk, n) for n in level.shape)
        made = {"chunks": chunks, "dtype": level.dtype, **options}
        if "shards" in made:
            made["shards"] = tuple(-(-n // 4) * 4 if n > 1 else 1 for n in level.shape)
            made["chunks"] = tuple(4 if n > 1 else 1 for n in level.shape)
        group.create_array(str(number), shape=level.shape, **made)[...] = level
        steps = [s * (2**number if k >= len(leading) else 1) for k, s in enumerate(scale)]
        datasets.append(
            {"path": str(number), "coordinateTransformations": [{"type": "scale", "scale": steps}]}
        )
    entry = {"axes": axes, "datasets": datasets, "name": "ear"}
    if not third:
        entry["version"] = "0.4"
    told = {"multiscales": [entry]}
    group.attrs.update({"ome": {"version": "0.5", **told}} if third else told)
    return path


def zarr_attributes(path, change):
    """Change the multiscales entry of an image on disk."""
    file = path / (".zattrs" if (path / ".zattrs").is_file() else "zarr.json")
    content = json.loads(file.read_text())
    attributes = content if file.name == ".zattrs" else content["attributes"]["ome"]
    change(attributes["multiscales"][0])
    file.write_text(json.dumps(content))


def zarr_single(path, array, chunks):
    """A Zarr array alone, its chunks not packed."""
    import zarr

    made = zarr.create_array(path, shape=array.shape, chunks=chunks, dtype=array.dtype, compressors=None)
    made[...] = array
    return path
