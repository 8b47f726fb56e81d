"""Formats of a scan: one writer each, entered in a table by its name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulate.coverage import coverage_of
from simulate.ear import Placed
from simulate.scanner import Scan, render, render_into

IMAGEJ_BYTES = 1 << 31
_ROOT = "1.2.826.0.1.3680043.8.498"  # of pydicom, for unique names of no registered maker
Writer = Callable[[Path, Placed, Scan], Path]


def write_scan(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write a scan into a folder in the format it asks for; return the file, or folder of slices."""
    return WRITERS[scan.format](folder, placed, scan)


def _tif(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write an uncompressed ImageJ stack (big-endian, as ImageJ has it), or above 2 GiB an OME BigTIFF."""
    import tifffile

    nx, ny, nz = placed.shape
    dx, dy, dz = placed.voxel_mm
    dtype = np.dtype(scan.dtype)
    if dtype.itemsize * nx * ny * nz > IMAGEJ_BYTES:
        return _ome(folder, placed, scan)
    path = folder / "scan.tif"
    stack = tifffile.memmap(
        path,
        shape=(nz, ny, nx),
        dtype=dtype.newbyteorder(">"),
        imagej=True,
        resolution=(1.0 / dx, 1.0 / dy),
        metadata={"spacing": dz, "unit": "mm", "axes": "ZYX"},
    )
    return _rendered(stack, placed, scan, path)


def _ome(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write an OME BigTIFF in the machine's byte order."""
    import tifffile

    path = folder / "scan.ome.tif"
    stack = tifffile.memmap(
        path,
        shape=placed.shape[::-1],
        dtype=np.dtype(scan.dtype),
        bigtiff=True,
        ome=True,
        metadata=_ome_sizes(placed),
    )
    return _rendered(stack, placed, scan, path)


def _deflated(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write an OME TIFF with deflated pages."""
    import tifffile

    path, volume = folder / "scan_deflate.ome.tif", render(placed, scan)
    tifffile.imwrite(path, volume, compression="zlib", photometric="minisblack", metadata=_ome_sizes(placed))
    return path


def _ome_sizes(placed: Placed) -> dict[str, Any]:
    sizes = {f"PhysicalSize{axis}": float(size) for axis, size in zip("XYZ", placed.voxel_mm, strict=True)}
    return {"axes": "ZYX", **sizes, **{f"{name}Unit": "mm" for name in sizes}}


def _rendered(stack: Any, placed: Placed, scan: Scan, path: Path) -> Path:
    """Render slab by slab into an array that a file is mapped to."""
    render_into(stack, placed, scan)
    stack.flush()
    return path


def _by_itk(name: str, packed: bool = False) -> Writer:
    """Return a writer of one file by SimpleITK: origin 0, identity direction (LPS)."""

    def write(folder: Path, placed: Placed, scan: Scan) -> Path:
        import SimpleITK as sitk

        image = sitk.GetImageFromArray(render(placed, scan))
        image.SetSpacing(placed.voxel_mm.tolist())
        sitk.WriteImage(image, str(folder / name), useCompression=packed)
        return folder / name

    return write


def _slices(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write a folder of plain TIFF slices; the voxel size stands nowhere but in the study."""
    import tifffile

    target = folder / "slices"
    target.mkdir(exist_ok=True)
    for number, picture in enumerate(render(placed, scan)):
        tifffile.imwrite(target / f"slice_{number:04d}.tif", picture, photometric="minisblack", metadata=None)
    return target


def _dicom(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write a folder of DICOM CT slices by pydicom (integers only), slice positions along +z."""
    import pydicom
    from pydicom.dataset import FileDataset, FileMetaDataset
    from pydicom.uid import UID, CTImageStorage, ExplicitVRLittleEndian

    volume = render(placed, scan)
    if volume.dtype.kind == "f":
        raise ValueError("DICOM slices hold integers; choose another dtype.")
    target = folder / "dicom"
    target.mkdir(exist_ok=True)
    dx, dy, dz = (float(f"{size:.9g}") for size in placed.voxel_mm)
    for number, picture in enumerate(volume):
        meta = FileMetaDataset()
        meta.MediaStorageSOPClassUID = CTImageStorage
        meta.MediaStorageSOPInstanceUID = UID(f"{_ROOT}.{scan.seed + 1}.{number + 1}")
        meta.TransferSyntaxUID = ExplicitVRLittleEndian
        path = target / f"slice_{number:04d}.dcm"
        slice_set = FileDataset(str(path), {}, file_meta=meta, preamble=bytes(128))
        for name, value in {
            "SOPClassUID": CTImageStorage,
            "SOPInstanceUID": meta.MediaStorageSOPInstanceUID,
            "StudyInstanceUID": f"{_ROOT}.9",
            "SeriesInstanceUID": f"{_ROOT}.10",
            "FrameOfReferenceUID": f"{_ROOT}.11",
            "Modality": "CT",
            "PatientName": "Simulated^Ear",
            "PatientID": "simulated",
            "InstanceNumber": number + 1,
            "ImagePositionPatient": [0.0, 0.0, float(f"{number * dz:.9g}")],
            "ImageOrientationPatient": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0],
            "PixelSpacing": [dy, dx],
            "SliceThickness": dz,
            "SamplesPerPixel": 1,
            "PhotometricInterpretation": "MONOCHROME2",
            "Rows": picture.shape[0],
            "Columns": picture.shape[1],
            "BitsAllocated": 8 * picture.itemsize,
            "BitsStored": 8 * picture.itemsize,
            "HighBit": 8 * picture.itemsize - 1,
            "PixelRepresentation": int(picture.dtype.kind == "i"),
            "RescaleIntercept": 0.0,
            "RescaleSlope": 1.0,
        }.items():
            setattr(slice_set, name, value)
        slice_set.PixelData = picture.tobytes()
        pydicom.dcmwrite(path, slice_set, enforce_file_format=True)
    return target


def _isq(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write a Scanco ISQ (16 bit, halved where unsigned); the extent is stored in whole micrometres.

    Layout: https://github.com/KitwareMedical/ITKIOScanco
    """
    volume = render(placed, scan)
    if volume.dtype == np.uint16:
        volume = (volume // 2).astype(np.int16)
    head = bytearray(1024)
    head[:16] = b"CTDATA-HEADER_V1"
    extent = np.rint(placed.voxel_mm * 1e3 * placed.shape)
    head[44:68] = np.array([*placed.shape, *extent], "<i4").tobytes()
    head[88:92] = np.array([4096], "<i4").tobytes()
    head[508:512] = np.array([1], "<i4").tobytes()
    path = folder / "scan.isq"
    path.write_bytes(bytes(head) + volume.astype("<i2").tobytes())
    return path


def _raw(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write plain voxels, little-endian, and the header that VGStudio puts beside them; return the header."""
    volume = render(placed, scan)
    kind = {"u": "unsigned integer", "i": "signed integer", "f": "float"}[volume.dtype.kind]
    (folder / "scan.vol").write_bytes(volume.astype(volume.dtype.newbyteorder("<")).tobytes())
    size = " ".join(str(count) for count in placed.shape)
    lines = [
        "{volume1}",
        "[representation]",
        f"size = {size}",
        f"datatype = {kind}",
        f"bitsperelement = {8 * volume.itemsize}",
        "[file1]",
        "SkipHeader = 0",
        "FileFormat = raw",
        f"Size = {size}",
        "Name = scan.vol",
        f"Datatype = {kind}",
        f"BitsPerElement = {8 * volume.itemsize}",
        "{volumeprimitive1}",
        "[geometry]",
        "resolution = " + " ".join(f"{size:.9g}" for size in placed.voxel_mm),
        "unit = mm",
    ]
    path = folder / "scan.vgi"
    path.write_text("\n".join(lines) + "\n", newline="\r\n", encoding="utf-8")
    return path


def _zarr(folder: Path, placed: Placed, scan: Scan) -> Path:
    """Write an OME-Zarr 0.4 (Zarr format 2) of one level."""
    import zarr

    path = folder / "scan.zarr"
    group = zarr.open_group(str(path), mode="w", zarr_format=2)
    volume = render(placed, scan)
    array = group.create_array("0", shape=volume.shape, chunks=(64, 64, 64), dtype=volume.dtype)
    array[...] = volume
    scale = [float(size) * 1e3 for size in placed.voxel_mm[::-1]]
    axes: list[Any] = [{"name": axis, "type": "space", "unit": "micrometer"} for axis in "zyx"]
    level: dict[str, Any] = {"path": "0", "coordinateTransformations": [{"type": "scale", "scale": scale}]}
    group.attrs["multiscales"] = [{"version": "0.4", "name": "scan", "axes": axes, "datasets": [level]}]
    return path


def _surface(folder: Path, placed: Placed, _: Scan) -> Path:
    """Write the exact stapes alone as a closed mesh in scan coordinates, mm (PLY, double precision)."""
    solid = placed.solids[0][0]
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment scan coordinates, mm, normals outward\n"
        f"element vertex {len(solid.vertices_mm)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(solid.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(solid.faces), dtype=[("n", "u1"), ("corner", "<i4", (3,))])
    rows["n"], rows["corner"] = 3, solid.faces
    path = folder / "stapes.ply"
    path.write_bytes(header.encode() + solid.vertices_mm.astype("<f8").tobytes() + rows.tobytes())
    return path


def label_volume(placed: Placed, samples: int = 4) -> NDArray[np.uint8]:
    """Return the true labels (z, y, x): 1 stapes, 2 plate, 3 other bone, each where it fills half a voxel."""
    labels = np.zeros(placed.shape[::-1], dtype=np.uint8)
    parts = {2: [s for s, material in placed.solids if material == "plastic"]}
    parts[3] = [s for s, material in placed.solids[1:] if material == "bone"]
    parts[1] = [placed.solids[0][0]]
    for value, solids in parts.items():
        filled = sum(coverage_of(solid, placed.shape, placed.voxel_mm, samples) for solid in solids)
        labels[np.asarray(filled) >= 0.5] = value
    return labels


def write_labels(path: Path, placed: Placed) -> Path:
    """Write the true labels by SimpleITK; NRRD, NIfTI or MetaImage by the suffix."""
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(label_volume(placed))
    image.SetSpacing(placed.voxel_mm.tolist())
    sitk.WriteImage(image, str(path), useCompression=True)
    return path


WRITERS: dict[str, Writer] = {
    "tif": _tif,
    "ome.tif": _ome,
    "deflate.tif": _deflated,
    "nrrd": _by_itk("scan.nrrd", packed=True),
    "nhdr": _by_itk("scan.nhdr"),
    "nii.gz": _by_itk("scan.nii.gz", packed=True),
    "mha": _by_itk("scan.mha"),
    "slices": _slices,
    "dicom": _dicom,
    "isq": _isq,
    "vgi": _raw,
    "zarr": _zarr,
    "ply": _surface,
}
"""Writers by format: they write into a folder and return what to open; ``ply`` is a surface."""
WITHOUT_SPACING = ("slices",)
"""Formats that do not say the voxel size: the study does."""
