"""Finding the stapes in simulated ears: right within the stated deviation, or refused with the cause."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import shift

from ct_inertia.find.choose import Search
from ct_inertia.find.find import find_stapes
from ct_inertia.find.levels import material_levels, readings
from ct_inertia.find.necks import find_necks
from ct_inertia.find.overview import is_set, look_at, noise_of
from ct_inertia.find.pieces import count_holes, label_pieces
from ct_inertia.frames.footplate import footplate_frame
from ct_inertia.grey.measure import measure
from ct_inertia.scan.scan import Scan
from ct_inertia.surface.contour import contour
from ct_inertia.voxels.distance import capped_distance
from ct_inertia.voxels.grid import Grid
from simulate import Stapes
from simulate.solids import box
from stapeskit.faults import StapeskitError
from stapeskit.registration import displacement
from tests.bodies.body_scenes import AIR, BONE, ear, true_moments

ALONE = {"bone": False, "plate": False}


@pytest.mark.parametrize("incus", [{}, {"incus_gap_mm": -0.05}], ids=["alone", "grown incus"])
def test_ears_are_measured_within_the_stated_deviation(incus):
    """Ears in their window, over a plate and beside an incus: tests/scenes."""
    scan, placed = ear(**ALONE, **incus)
    found = measure(find_stapes(scan)).moments
    exact = true_moments(placed)
    off = abs(found.volume_mm3 - exact.volume_mm3)
    assert off < max(4.0 * found.volume_sd_mm3, 5e-4 * exact.volume_mm3)
    assert found.volume_sd_mm3 < 0.01 * exact.volume_mm3
    assert np.linalg.norm(found.centroid_mm - exact.centroid_mm) < 5e-3


@pytest.mark.parametrize("gap_mm", [-0.08, 0.0])
def test_a_stapes_on_a_plate_or_sunk_into_it_is_measured_as_one_in_air(gap_mm):
    stapes = Stapes(family="foreign base", seed=1503)
    scan, placed = ear(50.0, seed=503, stapes=stapes, bone=False, plate_gap_mm=gap_mm)
    found, exact = measure(find_stapes(scan)), true_moments(placed)
    off = abs(found.moments.volume_mm3 - exact.volume_mm3)
    assert off < 3.5 * found.moments.volume_sd_mm3
    assert found.moments.volume_sd_mm3 < 3e-3 * exact.volume_mm3
    frame = footplate_frame(contour(found.surface.field, found.surface.scan_from_index))
    step = displacement(placed.scan_from_footplate, frame.scan_from_footplate)
    turned = abs(frame.scan_from_footplate.rotation[:, 1] @ placed.scan_from_footplate.rotation[:, 1])
    assert np.linalg.norm(step[:3]) < 4e-6
    assert turned > np.cos(4e-3)


def test_a_seed_answers_that_an_unusual_body_is_the_stapes():
    scan, _ = ear(40.0, stapes=Stapes(scale=1.45), **ALONE)
    doubted = find_stapes(scan)
    assert "stapes_uncertain" in {notice.code for notice in doubted.notices}
    index = np.argwhere(doubted.stapes)[:, ::-1]
    seed = doubted.box.scan_points(index[len(index) // 2][None])[0]
    named = find_stapes(scan, Search(seed_mm=seed))
    assert "stapes_uncertain" not in {notice.code for notice in named.notices}


@pytest.mark.parametrize("gap_mm", [0.0, -0.05])
def test_the_face_under_the_stapes_counts_not_a_larger_wall_beside_it(gap_mm, monkeypatch):
    floor, wall = box([-1.6, -0.5, -1.3], [1.9, 0.0, 1.3]), box([1.9, -0.5, -1.3], [2.5, 5.0, 1.3])
    monkeypatch.setattr("simulate.ear._plate", lambda: [floor, wall])
    scan, placed = ear(seed=503, bone=False, plate_gap_mm=gap_mm)
    found, exact = measure(find_stapes(scan)).moments, true_moments(placed)
    assert abs(found.volume_mm3 - exact.volume_mm3) < 4.0 * found.volume_sd_mm3
    assert found.volume_sd_mm3 < 2e-3 * exact.volume_mm3


@pytest.mark.parametrize(
    ("value", "edge"), [(-20000.0, "resampled"), (15000.0, "resampled"), (0.0, "rising"), (60000.0, "rising")]
)
def test_padding_counts_as_not_measured_however_its_edge_looks(value, edge):
    scan, placed = ear(seed=503, gap_mm=0.12, plate=False)
    grey = scan.read().astype(np.float32)
    y, x = (np.arange(n) - 0.5 * (n - 1) for n in grey.shape[1:])
    inward = 0.47 * min(grey.shape[1:]) - np.hypot(y[:, None], x)
    if edge == "resampled":
        grey[:, inward < 0.0] = value
        grey = shift(grey, [0.3, 0.37, 0.21], order=1, mode="nearest")
    else:
        grey += (6.0 * 0.03 * (BONE - AIR) * np.exp(-inward.clip(0.0) / 3.0)).astype(np.float32)
        grey[:, inward < 0.0] = value
    labelled = find_stapes(Scan.from_array(grey, scan.spacing_mm))
    assert any("field of view" in notice.text for notice in labelled.notices)
    found, exact = measure(labelled).moments, true_moments(placed).volume_mm3
    assert abs(found.volume_mm3 - exact) < 4.0 * found.volume_sd_mm3


@pytest.mark.parametrize("factor", [0.7, 1.5])
def test_bone_of_another_density_around_does_not_shift_the_surface(factor):
    """The brightest material of the scan is not the stapes: its surface is half way up to its own bone."""
    scan, placed = ear(gap_mm=0.12, plate=False)
    grey = scan.read().astype(np.float32)
    found = find_stapes(scan)
    whole = Grid.of(scan, scan.shape, np.zeros(3), np.ones(3))
    own = whole.taken(found.stapes, found.box)
    around = capped_distance((grey > 0.5 * (AIR + BONE)) & ~own, scan.spacing_mm, 1.0)
    around = around < capped_distance(own, scan.spacing_mm, 1.0)
    grey[around] += (factor - 1.0) * (grey[around] - AIR)
    found = measure(find_stapes(Scan.from_array(grey.astype(np.uint16), scan.spacing_mm))).moments
    exact = true_moments(placed).volume_mm3
    assert abs(found.volume_mm3 - exact) < max(4.0 * found.volume_sd_mm3, 5e-4 * exact)
    assert found.volume_sd_mm3 < 0.01 * exact


def first_fault(scan, search=None):
    with pytest.raises(StapeskitError) as error:
        find_stapes(scan, search)
    return error.value.faults[0]


def test_a_wrong_unit_of_the_spacing_is_named():
    scan, _ = ear(**ALONE, spacing_factor=1e-3)
    fault = first_fault(scan)
    assert fault.thing == "the voxel spacing"
    assert "1000 times" in fault.next_step


def test_inverted_grey_values_are_named():
    scan, _ = ear(**ALONE)
    assert first_fault(Scan.from_array(65535 - scan.read(), scan.spacing_mm)).thing == "the grey values"


def test_two_bodies_that_can_be_the_stapes_are_refused_and_a_seed_chooses():
    scan, placed = ear(**ALONE)
    grey = scan.read()
    both = Scan.from_array(np.concatenate([grey, grey], axis=2), scan.spacing_mm)
    assert first_fault(both).thing == "the scan"
    inside = np.argwhere(grey > 28000)
    seed = both.scan_points(inside[len(inside) // 2][::-1])
    chosen = find_stapes(both, Search(seed_mm=seed))
    assert chosen.named
    found = measure(chosen).moments
    assert abs(found.volume_mm3 / true_moments(placed).volume_mm3 - 1.0) < 5e-3
    half = 0.5 * both.shape[2] * both.spacing_mm[0]
    boxed = find_stapes(both.part(both.box_of(np.array([0, 0, 0, half, 100.0, 100.0]))))
    assert measure(boxed).moments.centroid_mm == pytest.approx(true_moments(placed).centroid_mm, abs=5e-3)


@pytest.mark.parametrize(
    ("search", "thing"),
    [
        (Search(threshold=1e6), "--threshold"),
        (Search(seed_mm=np.array([99.0, 0.0, 0.0])), "--seed"),
        (Search(seed_mm=np.array([0.1, 0.1, 0.1])), "--seed"),
    ],
)
def test_options_that_do_not_fit_the_scan(search, thing):
    scan, _ = ear(**ALONE)
    assert first_fault(scan, search).thing == thing


def test_one_material_and_bone_everywhere_are_refused():
    rng = np.random.default_rng(0)
    noise = Scan.from_array((1000 + 50 * rng.standard_normal((40, 40, 40))).astype(np.int16), 0.05)
    assert first_fault(noise).thing == "the scan"
    solid = np.full((160, 160, 160), 3000, dtype=np.int16)
    solid[::20, ::20] = 0
    solid[:20] = 0
    fault = first_fault(Scan.from_array(solid + rng.integers(0, 60, solid.shape).astype(np.int16), 0.05))
    assert fault.thing in ("the scan", "the field of view", "the voxel spacing")


@pytest.mark.parametrize("value", [-32768, 65535])
def test_a_constant_however_near_the_bone_and_far_from_air_changes_nothing(value):
    scan, placed = ear(gap_mm=0.12)
    exact = true_moments(placed)
    y, x = np.indices(scan.shape[1:])
    middle = scan.index_points(exact.centroid_mm)
    far = (x - middle[0]) ** 2 + (y - middle[1]) ** 2 > (2.3 / scan.spacing_mm[0]) ** 2
    grey = np.where(far, value, scan.read().astype(np.int32)).astype(np.float32)
    found = measure(find_stapes(Scan.from_array(grey, scan.spacing_mm)))
    assert abs(found.moments.volume_mm3 - exact.volume_mm3) < 4.0 * found.moments.volume_sd_mm3
    assert found.moments.volume_sd_mm3 < 0.01 * exact.volume_mm3
    codes = {notice.code for notice in found.notices}
    assert any(one.code == "file_read" and f"({value})" in one.text for one in found.notices)
    assert not codes & {"touches_border", "grey_values_misfit", "soft_surroundings", "air_clipped"}


def test_a_stapes_that_the_field_of_view_cuts_is_reported():
    scan, placed = ear(gap_mm=0.12)
    exact = true_moments(placed)
    y, x = np.indices(scan.shape[1:])
    middle = scan.index_points(exact.centroid_mm)
    far = (x - middle[0]) ** 2 + (y - middle[1]) ** 2 > (1.4 / scan.spacing_mm[0]) ** 2
    grey = np.where(far, 0, scan.read()).astype(np.float32)
    found = measure(find_stapes(Scan.from_array(grey, scan.spacing_mm)))
    assert "touches_border" in {notice.code for notice in found.notices}
    assert abs(found.moments.volume_mm3 - exact.volume_mm3) < 2.0 * found.moments.volume_sd_mm3


def test_fluid_on_the_footplate_is_subtracted_within_its_deviation():
    scan, placed = ear(fluid_depth_mm=0.4)
    exact = true_moments(placed)
    found = measure(find_stapes(scan))
    assert "soft_surroundings" in {notice.code for notice in found.notices}
    assert abs(found.moments.volume_mm3 - exact.volume_mm3) < 3.0 * found.moments.volume_sd_mm3
    assert found.moments.volume_sd_mm3 < 0.02 * exact.volume_mm3


def test_a_block_that_a_copy_has_lost_was_not_measured():
    """A box of one value amid the picture, as of a missing chunk, cuts the stapes as a border does."""
    scan, placed = ear(gap_mm=0.12)
    exact = true_moments(placed)
    corners = placed.solids[0][0].vertices_mm
    x, y, z = np.rint(scan.index_points(corners[np.argmax(corners[:, 2])])).astype(int)
    grey = scan.read()
    grey[z - 16 : z, y : y + 16, x : x + 16] = 0
    overview = look_at(Scan.from_array(grey, scan.spacing_mm))
    assert overview.padding == 0.0
    assert np.count_nonzero(overview.unmeasured) == 16**3 // np.prod(overview.grid.block)
    found = measure(find_stapes(Scan.from_array(grey, scan.spacing_mm)))
    assert "touches_border" in {notice.code for notice in found.notices}
    assert abs(found.moments.volume_mm3 - exact.volume_mm3) < 2.0 * found.moments.volume_sd_mm3


BROKEN = {
    "a part has moved": lambda grey, k: np.concatenate([grey[:k], np.roll(grey[k:], 3, axis=2)]),
    "six are missing": lambda grey, k: np.delete(grey, np.s_[k : k + 6], axis=0),
}


@pytest.mark.parametrize("name", BROKEN)
def test_slices_that_do_not_continue_their_neighbours_are_named(name):
    scan, placed = ear(gap_mm=0.12)
    middle = round(float(scan.index_points(true_moments(placed).centroid_mm)[2]))
    found = measure(find_stapes(Scan.from_array(BROKEN[name](scan.read(), middle), scan.spacing_mm)))
    (text,) = [notice.text for notice in found.notices if notice.code == "slices_out_of_place"]
    assert str(middle) in text


@pytest.mark.parametrize("contrast", [60.0, 150.0, 199.0, 250.0, 299.0, 20_000.0])
def test_clipped_air_was_not_set_whatever_its_steps(contrast):
    """Scans of 8 bits of which a twentieth of the air was clipped were refused as if it had been set to 0."""
    normal = np.random.default_rng(5).standard_normal(200_000)
    for sd in (0.02, 0.05, 0.07, 0.1):
        for begins in (0.5, 1.0, 1.4, 1.6):
            air = np.maximum(np.round(sd * contrast * (normal + begins)), 0.0).astype(np.float32)
            assert is_set(air, contrast) is None
            set_to_0 = np.where(air < np.float32(sd * contrast * begins), np.float32(0.0), air)
            if contrast > 100.0 and begins * sd > 0.05:
                assert is_set(set_to_0, contrast)[0] == 0.0


@pytest.mark.parametrize("begins", [0.0, 0.06])
def test_air_that_the_export_has_clipped_was_measured(begins):
    """A window that begins up to two deviations of the noise above air leaves one value nearly everywhere."""
    scan, _ = ear(**ALONE)
    grey = np.maximum(scan.read(), np.uint16(AIR + begins * (BONE - AIR)))
    overview = look_at(Scan.from_array(grey, scan.spacing_mm))
    assert overview.unmeasured is None
    assert len(overview.levels) == 2


def test_a_mask_is_measured_as_a_mask():
    scan, placed = ear(**ALONE)
    exact = true_moments(placed).volume_mm3
    for low, high in ((0, 1), (0, 255)):
        mask = np.where(scan.read() > 19000, high, low).astype(np.uint8)
        found = measure(find_stapes(Scan.from_array(mask, scan.spacing_mm)))
        assert "grey_values_missing" in {notice.code for notice in found.notices}
        assert found.scene is None
        assert set(found.moments.contributions) == {"voxels"}
        assert abs(found.moments.volume_mm3 - exact) < 2.0 * found.moments.volume_sd_mm3


def test_blocks_of_fine_voxels_measure_the_same():
    scan, _placed = ear(voxel_um=24.0, noise=0.02, **ALONE)
    fine = np.repeat(np.repeat(np.repeat(scan.read(), 2, 0), 2, 1), 2, 2)
    coarse = measure(find_stapes(scan)).moments
    halved = measure(find_stapes(Scan.from_array(fine, scan.spacing_mm / 2, origin_mm=-scan.spacing_mm / 4)))
    assert halved.labelled.box.block.tolist() == [2, 2, 2]
    assert halved.moments.volume_mm3 == pytest.approx(coarse.volume_mm3, rel=1e-5)
    assert halved.moments.centroid_mm == pytest.approx(coarse.centroid_mm, abs=1e-4)


def test_levels_are_those_of_the_materials_however_little_of_them_there_is():
    rng = np.random.default_rng(2)
    grey = np.full((50, 50, 50), 1000.0)
    grey[5:25, 5:45, 5:45] = 2000.0
    grey[35:41, 35:41, 35:41] = 5000.0
    grey = (grey + 60.0 * rng.standard_normal(grey.shape)).astype(np.float32)
    levels = material_levels(grey, noise_of(grey), 1.0, None)
    assert levels == pytest.approx([1000.0, 2000.0, 5000.0], abs=40.0)
    assert next((r.plastic, r.bone) for r in readings(levels, None)) == pytest.approx((levels[1], levels[2]))


def test_holes_of_a_ring_a_ball_and_a_pair_of_spectacles():
    z, y, x = np.indices((12, 40, 70)) - np.array([6, 20, 20])[:, None, None, None]
    ring = (np.hypot(y, x) < 14) & (np.hypot(y, x) > 6) & (abs(z) < 4)
    other = (np.hypot(y, x - 24) < 14) & (np.hypot(y, x - 24) > 6) & (abs(z) < 4)
    assert [count_holes(ring), count_holes(ring | other), count_holes(np.hypot(y, x) < 8)] == [1, 2, 0]
    grid = Grid.of(Scan.from_array(ring.astype(np.uint8), 0.1), ring.shape, np.zeros(3), np.ones(3))
    pieces = label_pieces(ring, grid)
    assert [(piece.label, piece.holes) for piece in pieces] == [(1, 1)]


def test_the_neck_of_an_hourglass():
    z, y, x = (np.indices((120, 50, 50)) * 0.04).astype(float)
    along = z - 2.4
    radius = 0.3 + 0.35 * np.clip(np.abs(along - 1.0), 0.0, 1.0)
    body = (np.hypot(y - 1.0, x - 1.0) < radius) & (np.abs(along) < 1.9)
    points = np.argwhere(body)[:, ::-1] * 0.04
    neck = find_necks(points, np.full(3, 0.04))[0]
    assert abs(neck.normal[2]) > 0.98
    assert neck.height_mm * np.sign(neck.normal[2]) == pytest.approx(3.4, abs=0.1)
    assert neck.area_mm2 == pytest.approx(np.pi * 0.3**2, rel=0.15)


def test_the_box_keeps_its_place_in_a_turned_scan():
    scan, _placed = ear(**ALONE)
    turned = replace(scan, origin_mm=np.array([5.0, -3.0, 2.0]), direction=np.diag([-1.0, -1.0, 1.0]))
    here, there = measure(find_stapes(scan)).moments, measure(find_stapes(turned)).moments
    assert there.volume_mm3 == pytest.approx(here.volume_mm3, rel=1e-6)
    expected = turned.scan_points(scan.index_points(here.centroid_mm))
    assert there.centroid_mm == pytest.approx(expected, abs=1e-5)
