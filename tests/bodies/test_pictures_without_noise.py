"""Phantoms without noise: a constant is a material, not clipped and not padding, whatever its type."""

import numpy as np
import pytest

from ct_inertia.find.choose import Search
from ct_inertia.find.find import find_stapes
from ct_inertia.grey.measure import measure
from ct_inertia.scan.scan import Scan
from simulate.ear import Ear
from simulate.scanner import Scan as Scanner
from simulate.scanner import render
from stapeskit.faults import StapeskitError

PICTURES = {
    "float": ({"dtype": "float32"}, 1e-4),
    "8 bit": ({"dtype": "uint8"}, 0.02),
    "a narrow scale": ({"levels": (100.0, 180.0, 300.0)}, 0.02),
    "sharp": ({"blur_voxels": 0.0}, 0.02),
    "round field of view": ({"round_field": True}, 1e-4),
}


def scanned(**options):
    scanner = Scanner(voxel_um=40.0, noise=0.0, seed=3, **options)
    placed = scanner.placed(Ear())
    return Scan.from_array(render(placed, scanner), placed.voxel_mm), placed.solids[0][0].moments().volume_mm3


@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_without_noise_is_measured(name):
    options, most_sd = PICTURES[name]
    scan, volume = scanned(**options)
    found = measure(find_stapes(scan, Search(None, None)))
    sd = found.moments.volume_sd_mm3
    assert abs(found.moments.volume_mm3 - volume) < 4.0 * sd
    assert sd < most_sd * volume
    codes = {notice.code for notice in found.notices}
    assert not codes & {"air_clipped", "bone_clipped", "touches_border", "soft_surroundings"}
    padded = any("field of view" in notice.text for notice in found.notices)
    assert padded == ("round_field" in options)


@pytest.mark.parametrize(("blur", "dtype"), [(0.0, "uint16"), (0.5, "uint16"), (0.3, "uint8")])
def test_air_without_noise_and_blur_inside_padding_is_air(blur, dtype):
    """It was taken for the padding, which left no air."""
    scanner = Scanner(
        voxel_um=40.0, noise=0.0, seed=3, tilt_deg=10.0, round_field=True, blur_voxels=blur, dtype=dtype
    )
    placed = scanner.placed(Ear())
    found = measure(find_stapes(Scan.from_array(render(placed, scanner), placed.voxel_mm)))
    exact = placed.solids[0][0].moments().volume_mm3
    assert abs(found.moments.volume_mm3 - exact) < 4.0 * found.moments.volume_sd_mm3 < 0.04 * exact


def test_a_picture_whose_window_cuts_edges_is_refused():
    """Without noise as well, air that lies below the window leaves its level open."""
    with pytest.raises(StapeskitError) as error:
        measure(find_stapes(scanned(window=(12_000.0, 26_000.0))[0], Search(None, None)))
    assert error.value.faults[0].thing == "the range of the grey values"


def test_blank_slices_between_the_stapes_and_the_incus_are_air():
    """They were taken for slices that a copy had lost."""
    scanner = Scanner(voxel_um=40.0, noise=0.0, seed=3, tilt_deg=1.0, dtype="uint8")
    placed = scanner.placed(Ear(bone=False, plate=False, incus_gap_mm=0.3))
    grey = render(placed, scanner)
    assert np.ptp(grey, axis=(1, 2))[20:-20].min() == 0
    found = find_stapes(Scan.from_array(grey, placed.voxel_mm))
    assert np.count_nonzero(found.stapes) * found.box.voxel_mm3 == pytest.approx(
        placed.solids[0][0].moments().volume_mm3, rel=0.1
    )


@pytest.mark.parametrize("times", [1, 2])
def test_slices_that_are_alike_without_noise_or_by_interpolation_are_no_copies(times):
    """Those of air and padding were, and every second one of a scan interpolated from nearest slices."""
    noise = 0.03 * (times - 1)
    scanner = Scanner(voxel_um=40.0, noise=noise, blur_voxels=0.5, round_field=True, seed=3, tilt_deg=10.0)
    placed = scanner.placed(Ear())
    grey = np.repeat(render(placed, scanner), times, axis=0)
    found = find_stapes(Scan.from_array(grey, placed.voxel_mm / [1, 1, times]))
    assert found.box.repeated == ()
