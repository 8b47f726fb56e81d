"""A stapes that touches other bone: wide bridges, blurred gaps, an incus grown onto its head."""

import numpy as np
import pytest

from legacy.ct_inertia.frames.footplate import footplate_frame
from legacy.ct_inertia.frames.window_gap import window_gap
from legacy.ct_inertia.labelling.from_scan import find_bodies
from legacy.ct_inertia.segment.coarse_segmentation import SearchOptions
from legacy.ct_inertia.volume.volume import Volume
from sample_volumes.phantom import Ear, render, scene, truth


def hard_ear(voxel=0.03, **settings):
    placed = scene(Ear(voxel_mm=(voxel,) * 3, plate=False, pose_seed=4, noise_seed=4, **settings))
    return Volume(render(placed), np.full(3, voxel), np.zeros(3), np.eye(3)), truth(placed)


def relative(moments, known):
    """Error of the volume and the stated standard deviation, both relative."""
    exact = known["volume_m3"] * 1e9
    stated = np.sqrt(sum(part[0, 0] for part in moments.contributions.values()))
    return moments.volume_mm3 / exact - 1.0, stated / exact


@pytest.mark.parametrize(
    ("settings", "limit"),
    [
        ({"gap_mm": 0.08, "bridges": 2, "bridge_radius_mm": 0.15}, 5e-3),
        ({"voxel": 0.05, "gap_mm": 0.06}, 1e-2),
        ({"bone": False, "incus_gap_mm": -0.05}, 1e-2),
    ],
)
def test_the_stapes_is_parted_from_what_it_touches(settings, limit):
    volume, known = hard_ear(**settings)
    bodies = find_bodies(volume)
    error, stated = relative(bodies.moments, known)
    assert abs(error) < limit
    assert abs(error) < 3.0 * stated
    assert bodies.moments.centroid_mm == pytest.approx(known["center_of_mass_in_scan_mm"], abs=0.01)
    codes = {notice.code for notice in bodies.notices}
    assert "cut_through_bone" in codes
    assert ("separation_weak" in codes) == ("incus_gap_mm" in settings)
    assert bodies.evidence["stapes"]["holes"] == 1
    gap = window_gap(
        footplate_frame(bodies.frame_surface), bodies.frame_surface, bodies.frame_blur_mm, bodies.wall
    )
    assert (gap is not None) == ("gap_mm" in settings)
    if gap is not None:
        assert abs(gap.median_mm - settings["gap_mm"]) < 2.0 * gap.sd_mm + 0.004
        assert gap.rim_share < 1.0 if "bridges" in settings else gap.rim_share == 1.0


def test_seed_box_and_labels_serve_where_bone_touches():
    volume, known = hard_ear(0.04, gap_mm=0.06, bridges=2, bridge_radius_mm=0.08)
    inside = np.array(known["scan_from_footplate"])[:3] @ [0.0, 0.2, 0.0, 1.0]
    high = volume.scan_points(volume.size - 1)
    seeded = find_bodies(volume, SearchOptions(seed_mm=inside))
    boxed = find_bodies(volume, SearchOptions(box_mm=np.concatenate([volume.origin_mm, high])))
    labels = np.zeros(volume.array.shape, dtype=np.uint8)
    first = seeded.labels.first_index[::-1]
    part = tuple(slice(a, a + n) for a, n in zip(first, seeded.labels.labels.shape, strict=True))
    labels[part] = seeded.labels.labels
    drawn = Volume(labels, volume.spacing_mm, volume.origin_mm, np.eye(3), handedness_confirmed=True)
    labelled = find_bodies(volume, SearchOptions(labels=drawn))
    for bodies in (seeded, boxed, labelled):
        assert abs(relative(bodies.moments, known)[0]) < 1e-2


def test_an_incus_grown_deep_into_the_head_is_cut_at_the_neck_and_told():
    volume, known = hard_ear(0.025, gap_mm=0.06, incus_gap_mm=-0.1)
    bodies = find_bodies(volume)
    error, stated = relative(bodies.moments, known)
    assert abs(error) < 5e-3
    assert abs(error) < 3.0 * stated
    (told,) = [notice.text for notice in bodies.notices if notice.code == "separation_weak"]
    assert "at a neck" in told
    assert "narrowest" in told
    assert "least cross-section" in bodies.evidence["separation"]


def test_walls_thinner_than_the_blur_leave_one_hole_and_the_window_is_not_taken(tmp_path):
    from sample_volumes.gutter import write_gutter_stapes

    volume, known = hard_ear(0.04, gap_mm=0.1, stapes=write_gutter_stapes(tmp_path / "gutter.ply", 0.04))
    bodies = find_bodies(volume)
    assert abs(relative(bodies.moments, known)[0]) < 1.2e-2
    assert bodies.evidence["stapes"]["holes"] == 1
    assert "stapes_uncertain" not in {notice.code for notice in bodies.notices}
