"""What a lab has in the scan beside the stapes: holders, tubes, foam, glue."""

from dataclasses import dataclass

import numpy as np
import pytest
import tifffile
from scipy.ndimage import binary_dilation

from ct_inertia.api import ct2mass
from ct_inertia.find.choose import Search
from ct_inertia.find.find import find_stapes
from ct_inertia.find.overview import look_at
from ct_inertia.frames.anatomy import AnatomyHints
from ct_inertia.frames.footplate import footplate_frame
from ct_inertia.frames.plate_frame import plate_frame
from ct_inertia.grey.measure import measure
from ct_inertia.scan.scan import Scan
from ct_inertia.surface.contour import contour
from simulate.ear import Ear
from simulate.scanner import Scan as Scanner
from simulate.scanner import render
from simulate.solids import box, ellipsoid, ring
from stapeskit.faults import StapeskitError
from stapeskit.frames import RigidTransform
from stapeskit.registration import displacement
from tests.bodies.body_scenes import true_moments


@dataclass(frozen=True, kw_only=True, eq=False)
class EarWith(Ear):
    """An ear and further bodies, each in footplate axes with its material."""

    more: tuple = ()

    def solids(self):
        return [*super().solids(), *self.more]


def scanned(*more, soft=0.2, **parts):
    """A scan of an ear with further bodies, and the placed bodies behind it."""
    scanner = Scanner(voxel_um=40.0, noise=0.03, soft=soft, tilt_deg=10.0)
    placed = scanner.placed(EarWith(more=more, **parts))
    return Scan.from_array(render(placed, scanner), placed.voxel_mm), placed


def tube():
    turn = np.linspace(0.0, 2.0 * np.pi, 96, endpoint=False)
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    return ring(3.0 * circle, 3.4 * circle, -2.2, 4.4)


OTHERS = {
    "a slab below it": (box([-2.5, -3.2, -2.0], [2.5, -2.4, 2.0]), "plastic"),
    "a wall beside it": (box([-3.0, -1.8, -2.6], [3.0, 4.5, -2.2]), "plastic"),
    "a tube around it": (tube(), "plastic"),
    "foam around it": (box([-2.6, -2.5, -2.6], [2.6, 4.8, 2.6]), "soft"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_the_plate_is_the_plastic_next_to_the_stapes_whatever_else_is_there(name):
    scan, placed = scanned(OTHERS[name], soft=0.12)
    found = measure(find_stapes(scan))
    frame = plate_frame(found.plate_faces, found.moments.centroid_mm)
    step = displacement(placed.scan_from_plate, frame.scan_from_plate)
    assert np.abs(step[:3]).max() < 10e-6
    assert np.abs(step[3:]).max() < 2e-3
    assert found.labelled.plate_region.one_of_several == (OTHERS[name][1] == "plastic")


def test_a_tube_alone_is_no_plate(tmp_path):
    scan, placed = scanned((tube(), "plastic"), plate=False)
    tifffile.imwrite(tmp_path / "a.tif", scan.read(), photometric="minisblack")
    found = ct2mass(tmp_path / "a.tif", spacing=scan.spacing_mm.tolist(), density=(1900, 10))
    assert found.plate_frame is None
    assert found.plate is None
    assert "plate_not_found" in {notice.code for notice in found.notices}
    exact = true_moments(placed).volume_mm3
    assert abs(found.moments.volume_mm3 - exact) < 4.0 * found.moments.volume_sd_mm3


def test_a_drop_of_glue_on_the_head_is_subtracted_and_named():
    corners = Ear().solid.vertices_mm
    top = corners[np.argmax(corners[:, 1])]
    scan, placed = scanned((ellipsoid(top + np.array([0.0, 0.05, 0.0]), (0.35, 0.25, 0.3)), "soft"))
    found = measure(find_stapes(scan))
    assert "soft_surroundings" in {notice.code for notice in found.notices}
    exact = true_moments(placed).volume_mm3
    assert abs(found.moments.volume_mm3 - exact) < 3.0 * found.moments.volume_sd_mm3 < 0.01 * exact


@pytest.mark.parametrize(("below", "value"), [(10_000, 0), (7_000, 0), (12_000, 4_000), (10_000, 15_000)])
def test_a_background_that_was_set_to_a_constant_is_refused(below, value):
    scan, _ = scanned()
    grey = scan.read()
    grey[grey < below] = value
    with pytest.raises(StapeskitError) as error:
        find_stapes(Scan.from_array(grey, scan.spacing_mm))
    assert error.value.faults[0].thing == "the scan"
    assert error.value.faults[0].expected.startswith("one that shows the air")


@pytest.mark.parametrize("value", [0, 4_000, 60_000])
def test_a_background_set_beyond_the_blur_of_the_bone_changes_nothing(value):
    scan, placed = scanned(plate=False)
    grey = scan.read()
    grey[~binary_dilation(grey > 19_000, iterations=6)] = value
    found, exact = measure(find_stapes(Scan.from_array(grey, scan.spacing_mm))).moments, true_moments(placed)
    assert abs(found.volume_mm3 - exact.volume_mm3) < 3.0 * found.volume_sd_mm3
    assert found.volume_sd_mm3 < 2e-3 * exact.volume_mm3


@pytest.mark.parametrize("count", [1, 2, 4])
def test_blank_slices_across_a_named_stapes_are_refused(count):
    scan, placed = scanned(plate=False)
    grey, seed = scan.read(), placed.scan_from_footplate.points(np.array([0.0, 0.1, 0.0]))
    middle = int(scan.index_points(true_moments(placed).centroid_mm)[2])
    grey[middle : middle + count] = 0
    for search in (Search(seed_mm=seed), None):
        with pytest.raises(StapeskitError) as error:
            find_stapes(Scan.from_array(grey, scan.spacing_mm), search)
        assert error.value.faults[0].expected == "without blank slices in the stapes"
        assert f" {middle}" in error.value.faults[0].got


SLICES = {
    "whole": lambda k, n: [*range(n)],
    "one is gone": lambda k, n: [*range(k), *range(k + 1, n)],
    "one was added": lambda k, n: [*range(k), k - 1, *range(k, n)],
    "one replaces another": lambda k, n: [*range(k), k - 1, *range(k + 1, n)],
    "two are exchanged": lambda k, n: [*range(k), k + 1, k, *range(k + 2, n)],
}


@pytest.mark.parametrize(
    ("name", "where"),
    [
        *((name, 0.12) for name in SLICES if name != "one was added"),
        ("one is gone", 0.5),
        ("one was added", 0.5),
    ],
)
def test_slices_out_of_place_are_named_and_in_the_budget(name, where):
    """One that was gone from the footplate changed the volume by 4 % without a word."""
    scan, placed = scanned(plate=False)
    heights = scan.index_points(placed.solids[0][0].vertices_mm)[:, 2]
    k = int(heights.min() + where * np.ptp(heights))
    grey = scan.read()[SLICES[name](k, int(scan.size[2]))]
    found, exact = measure(find_stapes(Scan.from_array(grey, scan.spacing_mm))), true_moments(placed)
    codes = {notice.code for notice in found.notices}
    assert abs(found.moments.volume_mm3 - exact.volume_mm3) < 3.0 * found.moments.volume_sd_mm3
    assert ("slices" in found.moments.contributions) == ("slices_out_of_place" in codes)
    assert ("slices_out_of_place" in codes) == (name != "whole")


@pytest.mark.parametrize(("upright", "seed"), [("z", 2), ("y", 2), ("x", 1)])
def test_slices_three_times_coarser_than_pixels_are_in_the_uncertainty_of_the_pose(upright, seed):
    """The stated deviation held errors of up to 20; and the side of the arch was taken for a footplate."""
    scanner = Scanner(voxel_um=(30.0, 30.0, 90.0), noise=0.03, tilt_deg=30.0, upright=upright, seed=seed)
    placed = scanner.placed(Ear(bone=False, plate=False))
    body = measure(find_stapes(Scan.from_array(render(placed, scanner), placed.voxel_mm))).surface
    hints = AnatomyHints(placed.scan_from_footplate.rotation[:, 0])
    frame = footplate_frame(contour(body.field, body.scan_from_index), hints, body)
    step = displacement(placed.scan_from_footplate, frame.scan_from_footplate)
    assert np.abs(step / np.sqrt(np.diag(frame.covariance))).max() < 4.0


@pytest.mark.parametrize("planes", [2, 8])
def test_a_footplate_that_the_border_cuts_is_in_the_uncertainty_of_the_pose(planes, tmp_path):
    """Its cut is a plane face: the pose was stated to micrometres and was wrong by up to 200 times that."""
    scanner = Scanner(voxel_um=40.0, noise=0.03, tilt_deg=10.0)
    placed = scanner.placed(Ear(bone=False, plate=False))
    grey, pose = render(placed, scanner), placed.scan_from_footplate
    first = int(np.argwhere(grey > 19_000)[:, 0].min()) + planes
    tifffile.imwrite(tmp_path / "a.tif", grey[first:], photometric="minisblack")
    options = {"density": (1900, 10), "anterior": pose.rotation[:, 0].tolist()}
    found = ct2mass(tmp_path / "a.tif", spacing=placed.voxel_mm.tolist(), **options)
    moved = pose.translation_mm - np.array([0.0, 0.0, first * placed.voxel_mm[2]])
    true = RigidTransform.from_parts(pose.rotation, moved, "scan", "footplate")
    step = displacement(true, found.footplate.scan_from_footplate)
    assert np.abs(step / np.sqrt(np.diag(found.footplate.covariance))).max() < 4.0
    assert "border" in found.footplate.contributions


@pytest.mark.parametrize("value", [6_500, 7_000, 9_000])
def test_padding_within_the_noise_of_air_is_not_measured_either(value):
    scanner = Scanner(voxel_um=40.0, noise=0.03, tilt_deg=10.0, round_field=True, padding=value)
    placed = scanner.placed(Ear(plate=False))
    overview = look_at(Scan.from_array(render(placed, scanner), placed.voxel_mm))
    assert overview.padding == value
    assert abs(overview.levels[0] - 8_000.0) < 0.01 * 22_000.0


@pytest.mark.parametrize(("noise", "seed"), [(0.02, 1), (0.03, 5)])
def test_a_mucosa_whose_trace_is_faint_is_in_the_budget(noise, seed):
    """Its trace beside the bone is 5 and 2 times its error, too little to be named by itself."""
    scanner = Scanner(voxel_um=40.0, noise=noise, soft=0.15, tilt_deg=10.0, seed=seed)
    placed = scanner.placed(Ear(bone=False, plate=False, coat_mm=0.035))
    found = measure(find_stapes(Scan.from_array(render(placed, scanner), placed.voxel_mm)))
    off = abs(found.moments.volume_mm3 - true_moments(placed).volume_mm3)
    assert off < 3.0 * np.sqrt(found.moments.contributions["coat"][0, 0])
    assert "grey_values_misfit" in {notice.code for notice in found.notices}


def streaks(shape, size):
    """Streaks from a wire, [z, y, x]: bright and dark rays that fade with the distance, some slices high."""
    z, y, x = np.indices(shape)
    along = np.exp(-np.abs(z - shape[0] // 2) / 8.0)
    return size * np.cos(9.0 * np.arctan2(y - 10, x - 10)) * along * 20.0 / (np.hypot(y - 10, x - 10) + 20.0)


def test_streaks_of_metal_are_named_and_in_the_budget():
    """Air that differs from place to place moved the volume by 6 stated standard deviations."""
    scan, placed = scanned(plate=False)
    grey = np.clip(scan.read() + streaks(scan.shape, 2000.0), 0, 65535).astype(np.uint16)
    found, exact = measure(find_stapes(Scan.from_array(grey, scan.spacing_mm))), true_moments(placed)
    assert abs(found.moments.volume_mm3 - exact.volume_mm3) < 3.0 * found.moments.volume_sd_mm3
    assert found.moments.volume_sd_mm3 < 2.5e-3 * exact.volume_mm3
    assert "grey_values_misfit" in {notice.code for notice in found.notices}


def test_noise_that_many_neighbours_share_is_in_the_level_of_bone():
    """Cells of 6 voxels scattered too little for it: 4.5 stated standard deviations."""
    scanner = Scanner(voxel_um=40.0, noise=0.06, noise_correlation_voxels=1.5, tilt_deg=10.0, seed=5)
    placed = scanner.placed(Ear(bone=False, plate=False))
    found = measure(find_stapes(Scan.from_array(render(placed, scanner), placed.voxel_mm))).moments
    assert abs(found.volume_mm3 - true_moments(placed).volume_mm3) < 3.0 * found.volume_sd_mm3
