"""Files that nobody here made: those that come with installed packages, and those that may not be copied.

Each is read with the extent that its maker states, or refused for what it is; none ends in a traceback.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from ct_inertia.api import ct2mass
from ct_inertia.scan.open_scan import open_scan
from stapeskit.faults import StapeskitError

SHARED = Path(__file__).parents[3] / "shared" / "data"
FOLDERS = {
    "nibabel": "tests/data",
    "pydicom": "data/test_files",
    "pyvista": "examples",
    "pymeshlab": "tests/sample_meshes",
}
"""Where the packages of the tests keep the files that they are tested with."""

SINGLE, TIMES = "the DICOM file", "the volume"

SCANS: dict[tuple[str, str], tuple[int, ...] | str] = {
    ("nibabel", "standard.nii.gz"): (7, 5, 4),
    ("nibabel", "anatomical.nii"): (25, 41, 33),
    ("nibabel", "reoriented_anat_moved.nii"): (22, 26, 21),
    ("nibabel", "resampled_anat_moved.nii"): "the grey values",  # 40 voxels are NaN
    ("nibabel", "functional.nii"): TIMES,
    ("nibabel", "example_nifti2.nii.gz"): TIMES,
    ("nibabel", "row_major.dconn.nii"): "the scan",  # a matrix of connections
    ("nibabel", "analyze.hdr"): "the data file",  # its voxels are not beside it
    ("nibabel", "nifti1.hdr"): "the data file",
    ("nibabel", "test.mgz"): "the scan",
    ("pydicom", "rtdose.dcm"): SINGLE,  # frames in one file
    ("pydicom", "rtplan.dcm"): SINGLE,  # a plan, without an image
    ("pydicom", "CT_small.dcm"): SINGLE,
    ("pydicom", "MR_truncated.dcm"): SINGLE,
    ("pydicom", "JPEG2000.dcm"): SINGLE,
    ("pydicom", "SC_rgb_rle_32bit_2frame.dcm"): SINGLE,
    ("pydicom", "badVR.dcm"): "the scan",
    ("pydicom", "dicomdirtests"): "the folder",
    ("pyvista", "uniform.vtk"): "the scan",
}
"""Shape [z, y, x] of what is read, or the thing that a refusal names."""

MEASURED: dict[tuple[str, str], float | str] = {
    ("nibabel", "standard.nii.gz"): "the scan",  # two levels, a random mask
    ("nibabel", "anatomical.nii"): "the scan",  # a head
    ("pyvista", "nut.ply"): "the mesh",  # 46 mm
    ("pyvista", "sphere.ply"): "the mesh",
    ("pyvista", "ant.ply"): "the mesh",  # 15 bodies
    ("pyvista", "airplane.ply"): "the surface",  # open
    ("pymeshlab", "bone.ply"): "the mesh",  # 0.9 mm
    ("pymeshlab", "bunny.obj"): "the mesh",
    ("pymeshlab", "bunny10k_textured.obj"): "the surface",
    ("pymeshlab", "cube.obj"): 1.0,  # edges of 1 mm
}
"""Volume in mm3 of what ct2mass measures, or the thing that its refusal names."""

SHARED_MEASURED: dict[str, float | str] = {
    "openear_stapes/openear_alpha_stapes_mm.ply": 2.3148,
    "scanco/test_aim.AIM": "the scan",  # 1.5 mm of a bone: no stapes
    "scanco/test_isq.ISQ": "the scan",
    "scanco/test_mha.mha": "the scan",
    "scanco/test_nii.nii": "the scan",
    "scanco/test_nrrd.nrrd": "the scan",
    "lhdl_bone": "the voxel spacing",
}


def public(package: str, name: str) -> Path:
    """Return a file of an installed package."""
    found = find_spec(package)
    assert found is not None
    assert found.origin is not None
    path = Path(found.origin).parent / FOLDERS[package] / name
    assert path.exists(), f"{package} came without {name}"
    return path


def named(rows: dict[tuple[str, str], object]) -> list[object]:
    return [pytest.param(*key, value, id="/".join(key)) for key, value in rows.items()]


@pytest.mark.parametrize(("package", "name", "expected"), named(SCANS))
def test_a_scan_of_a_package_is_read_or_refused_for_what_it_is(package, name, expected):
    path = public(package, name)
    if isinstance(expected, str):
        with pytest.raises(StapeskitError) as caught:
            open_scan(path).read()
        assert [fault.thing for fault in caught.value.faults] == [expected]
    else:
        scan = open_scan(path)
        assert scan.read().shape == expected
        assert np.all(scan.spacing_mm > 0.0)


@pytest.mark.parametrize("name", ["standard.nii.gz", "anatomical.nii", "reoriented_anat_moved.nii"])
def test_voxels_of_nibabel_lie_where_nibabel_says(name):
    """Grey values by place, which are the same however an index axis was turned; nibabel is RAS."""
    import nibabel

    path = public("nibabel", name)
    scan, image = open_scan(path), nibabel.load(path)
    voxels, values = scan.read(), np.asanyarray(image.dataobj)
    index = np.stack(np.meshgrid(*map(np.arange, values.shape), indexing="ij"), axis=-1).reshape(-1, 3)
    places = nibabel.affines.apply_affine(image.affine, index) * [-1.0, -1.0, 1.0]
    mine = np.rint(scan.index_points(places)).astype(int)
    assert np.array_equal(voxels[tuple(mine[:, ::-1].T)], values.reshape(-1))


def check_measured(path: Path, expected: float | str) -> None:
    """Assert that ct2mass measures a volume, or names the thing that is wrong."""
    assert path.exists()
    if isinstance(expected, str):
        with pytest.raises(StapeskitError) as caught:
            ct2mass(path)
        assert [fault.thing for fault in caught.value.faults] == [expected]
    else:
        assert ct2mass(path).record.volume_m3 * 1e9 == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(("package", "name", "expected"), named(MEASURED))
def test_what_is_no_stapes_is_refused_by_ct2mass(package, name, expected):
    check_measured(public(package, name), expected)


@pytest.mark.shared
@pytest.mark.parametrize("name", SHARED_MEASURED)
def test_a_shared_scan_is_measured_or_refused_for_what_it_is(name):
    check_measured(SHARED / name, SHARED_MEASURED[name])


@pytest.mark.shared
def test_the_formats_of_a_scanner_hold_the_same_volume():
    """One volume of Scanco as ISQ, AIM, MHA, NIfTI and NRRD."""
    names = ("test_aim.AIM", "test_isq.ISQ", "test_mha.mha", "test_nii.nii", "test_nrrd.nrrd")
    scans = [open_scan(SHARED / "scanco" / name) for name in names]
    for scan in scans:
        assert scan.read().shape == (25, 25, 25)
        assert scan.spacing_mm == pytest.approx([0.0607] * 3, rel=1e-3)
