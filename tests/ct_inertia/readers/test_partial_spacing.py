"""What a file says of its spacing counts, though it does not say all: a given spacing is compared with it."""

import numpy as np
import pytest
import tifffile

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.read_scan import read_volume
from tests.ct_inertia.readers import writers as f
from tests.ct_inertia.readers.writers import picture

PLANE = (0.025, 0.03)  # mm


def tagged(path, array):
    per_cm = tuple(10.0 / step for step in PLANE)
    return f.plain(path, array, resolution=per_cm, resolutionunit="CENTIMETER", metadata=None)


def imagej(path, array):
    per_mm = tuple(1.0 / step for step in PLANE)
    return f.plain(path, array, imagej=True, resolution=per_mm, metadata={"unit": "mm", "axes": "ZYX"})


def ome(path, array):
    sizes = {"axes": "ZYX", "PhysicalSizeX": 25.0, "PhysicalSizeY": 30.0}
    tifffile.imwrite(path, array, metadata=sizes, photometric="minisblack")
    return path


def folder(path, array):
    per_cm = tuple(10.0 / step for step in PLANE)
    return f.slices(path, array, resolution=per_cm, resolutionunit="CENTIMETER", metadata=None)


@pytest.mark.parametrize(
    ("write", "name"), [(tagged, "a.tif"), (imagej, "a.tif"), (ome, "a.ome.tif"), (folder, "slices")]
)
def test_a_given_spacing_that_contradicts_the_size_in_a_slice_is_told(tmp_path, write, name):
    path = write(tmp_path / name, picture())
    with pytest.raises(CtInertiaError) as refused:
        read_volume(path)
    assert "0.025" in refused.value.faults[0].got
    for given, told in (((0.026, 0.03, 0.05), True), (0.026, True), ((*PLANE, 0.05), False)):
        codes = [notice.code for notice in read_volume(path, given).notices]
        assert ("spacing_overridden" in codes) is told


def test_each_axis_of_imagej_may_have_its_unit(tmp_path):
    x, y, z = f.SPACING
    tifffile.imwrite(
        tmp_path / "a.tif",
        picture(),
        imagej=True,
        resolution=(1.0 / x, 1e-3 / y),
        metadata={"spacing": 1e3 * z, "unit": "mm", "yunit": "um", "zunit": "micron", "axes": "ZYX"},
    )
    np.testing.assert_allclose(read_volume(tmp_path / "a.tif").spacing_mm, f.SPACING, rtol=1e-5)


@pytest.mark.parametrize("dpi", [1, 72, 300, 600])
def test_the_resolution_of_a_printer_is_no_spacing(tmp_path, dpi):
    path = f.plain(tmp_path / "a.tif", picture(), resolution=(dpi, dpi), resolutionunit="INCH", metadata=None)
    assert "spacing_overridden" not in [notice.code for notice in read_volume(path, 0.02).notices]
