"""Finding the stapes and measuring it: accuracy, choices, corrections, refusals."""

from dataclasses import replace

import numpy as np
import pytest

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.frames.footplate_face import correct_blur
from legacy.ct_inertia.grey.partial_volume import as_vector
from legacy.ct_inertia.labelling.from_scan import find_bodies
from legacy.ct_inertia.read_scan import read_volume
from legacy.ct_inertia.segment.ambiguity import refuse_rivals
from legacy.ct_inertia.segment.candidates import Piece
from legacy.ct_inertia.segment.coarse_segmentation import SearchOptions
from legacy.ct_inertia.surface.surface import enclosed_volume
from legacy.ct_inertia.surface.surface_field import Diffusion, Mesh
from legacy.ct_inertia.volume.volume import Volume
from tests.ct_inertia.ears import AIR, BONE, ear, errors


def unblurred_volume(bodies):
    """Volume (mm3) of the frame surface, its shrinkage by the blur added: blur^2 times the mean curvature."""
    surface = bodies.frame_surface
    mesh = Mesh(surface.vertices_mm, surface.faces)
    points = correct_blur(Diffusion(mesh, 0.05), bodies.frame_blur_mm)
    return enclosed_volume(points, surface.faces)


def codes(bodies):
    return {notice.code for notice in bodies.notices}


def test_a_stapes_in_air_within_a_tenth_of_a_percent():
    scan = ear(h=0.03, rays=4)
    bodies = find_bodies(scan.volume)
    volume, centroid, inertia = errors(bodies.moments, scan.stapes)
    assert abs(volume) < 1.5e-3
    assert centroid < 0.6
    assert inertia < 2e-3
    assert bodies.stapes.euler_characteristic == 0
    assert bodies.stapes.volume_mm3 == pytest.approx(bodies.moments.volume_mm3, rel=1e-4)
    assert unblurred_volume(bodies) == pytest.approx(bodies.moments.volume_mm3, rel=4e-3)
    assert bodies.plate is None
    assert bodies.psf_sigma_mm == pytest.approx(1.2 * 0.03, rel=0.05)
    assert bodies.levels.air == pytest.approx(AIR, abs=0.002 * (BONE - AIR))
    assert bodies.levels.bone == pytest.approx(BONE, abs=0.002 * (BONE - AIR))
    assert codes(bodies) == {"bare_bone_assumed"}
    inside = bodies.labels.mask(1)
    assert inside.sum() * scan.volume.voxel_mm3 == pytest.approx(bodies.moments.volume_mm3, rel=0.01)


def test_the_error_is_covered_by_its_uncertainty():
    scores = []
    for seed in range(3):
        scan = ear(h=0.06, seed=seed, rays=4)
        moments = find_bodies(scan.volume).moments
        sd = np.sqrt(np.diag(sum(moments.contributions.values())))
        truth = as_vector(scan.stapes.moments())
        scores.append((as_vector(moments) - truth) / sd)
    assert np.sqrt(np.mean(np.array(scores) ** 2)) < 2.0


@pytest.mark.parametrize("gap", [0.2, 0.06])
def test_a_stapes_in_its_window_on_a_plate(gap):
    scan = ear(h=0.035, gap=gap, plate_gap=0.6, margin=0.3, rays=4)
    bodies = find_bodies(scan.volume)
    volume, centroid, inertia = errors(bodies.moments, scan.stapes)
    assert abs(volume) < 1.5e-3
    assert centroid < 1.0
    assert inertia < 2e-3
    assert bodies.plate.volume_mm3 == pytest.approx(scan.plate.volume_mm3, rel=0.02)
    assert bodies.stapes.euler_characteristic == 0
    assert np.unique(bodies.labels.labels).tolist() == [0, 1, 2, 3]
    assert bodies.evidence["stapes"]["holes"] == 1


def test_voxels_need_not_be_cubes():
    scan = ear(h=0.035, stretch=(1, 1, 1.4), rays=4)
    volume, centroid, inertia = errors(find_bodies(scan.volume).moments, scan.stapes)
    assert abs(volume) < 1.5e-3
    assert centroid < 1.5
    assert inertia < 2e-3


def test_labels_lie_on_the_scan(tmp_path):
    scan = ear(h=0.05, rays=4)
    bodies = find_bodies(scan.volume)
    bodies.labels.write(tmp_path / "labels.nrrd")
    labels = read_volume(tmp_path / "labels.nrrd")
    assert labels.handedness_confirmed
    assert labels.spacing_mm == pytest.approx(scan.volume.spacing_mm)
    index = np.argwhere(np.asarray(labels.array) == 1)[:, ::-1]
    assert labels.scan_points(index).mean(axis=0) == pytest.approx(bodies.moments.centroid_mm, abs=0.01)
    assert min(index.min(axis=0)) == 0
    assert np.array_equal(index.max(axis=0), labels.size - 1)


def test_given_labels_with_and_without_grey_values(tmp_path):
    scan = ear(h=0.04)
    bodies = find_bodies(scan.volume)
    bodies.labels.write(tmp_path / "labels.nrrd")
    labels = read_volume(tmp_path / "labels.nrrd")
    alone = find_bodies(None, SearchOptions(labels=labels))
    volume, centroid, _ = errors(alone.moments, scan.stapes)
    assert abs(volume) < 0.01
    assert centroid < 5.0
    assert "labels_alone" in codes(alone)
    assert "touches_border" not in codes(alone)
    grey = find_bodies(scan.volume, SearchOptions(labels=labels))
    volume, centroid, inertia = errors(grey.moments, scan.stapes)
    assert abs(volume) < 1.5e-3
    assert centroid < 1.0
    assert inertia < 2e-3
    assert grey.labels.origin_mm == pytest.approx(labels.origin_mm)


def test_labels_that_end_on_the_stapes_are_told():
    scan = ear(h=0.05, rays=4)
    labels = replace(scan.volume, array=(scan.volume.array > 11000).astype(np.uint8))
    index = np.argwhere(labels.array)
    tight = tuple(slice(a, b + 1) for a, b in zip(index.min(axis=0), index.max(axis=0), strict=True))

    def is_told(part):
        origin = scan.volume.scan_points(np.array([s.start for s in part])[::-1])
        short = replace(labels, array=labels.array[part], origin_mm=origin)
        return "touches_border" in codes(find_bodies(scan.volume, SearchOptions(labels=short)))

    assert not is_told(tight)
    for axis, sense in ((0, 1), (0, -1), (1, 1), (2, -1)):
        box = list(tight)
        middle = (box[axis].start + box[axis].stop) // 2
        ended = slice(box[axis].start, middle) if sense > 0 else slice(middle, box[axis].stop)
        assert is_told((*box[:axis], ended, *box[axis + 1 :]))


def test_bad_labels():
    scan = ear(h=0.05, rays=4)
    labels = replace(scan.volume, array=(scan.volume.array > 11000).astype(np.uint8))
    with pytest.raises(CtInertiaError, match=r"number 5\); got 0 of them; numbers present: 0, 1"):
        find_bodies(None, SearchOptions(labels=labels, stapes_label=5))
    with pytest.raises(CtInertiaError, match="whole numbers"):
        find_bodies(None, SearchOptions(labels=replace(labels, array=labels.array + np.float32(0.5))))
    elsewhere = Volume(labels.array[5:], labels.spacing_mm * 1.5, labels.origin_mm, np.eye(3))
    with pytest.raises(CtInertiaError, match="on the voxels of the scan"):
        find_bodies(scan.volume, SearchOptions(labels=elsewhere))
    empty = np.zeros_like(labels.array)
    empty[:8, :8, :8] = 1
    with pytest.raises(CtInertiaError, match="brighter than the air"):
        find_bodies(scan.volume, SearchOptions(labels=replace(labels, array=empty)))
    with pytest.raises(CtInertiaError, match="the scan must be given"):
        find_bodies(None)


def two_ears():
    scan = ear(h=0.05, rays=4)
    other = np.flip(scan.volume.array, 0)
    return scan, replace(scan.volume, array=np.concatenate([scan.volume.array, other], axis=0))


def test_two_stapedes_need_a_seed_or_a_box():
    scan, volume = two_ears()
    with pytest.raises(CtInertiaError, match=r"one body that can be the stapes; got 2: .*--seed"):
        find_bodies(volume)
    truth = scan.stapes.moments().centroid_mm
    on_bone = scan.volume.scan_points(np.argwhere(scan.volume.array > 19000)[1000][::-1])
    bodies = find_bodies(volume, SearchOptions(seed_mm=on_bone))
    assert bodies.moments.centroid_mm == pytest.approx(truth, abs=2e-3)
    high = scan.volume.scan_points(scan.volume.size - 1)
    box = np.concatenate([scan.volume.origin_mm, high])
    assert find_bodies(volume, SearchOptions(box_mm=box)).moments.centroid_mm == pytest.approx(
        truth, abs=2e-3
    )


def test_one_body_that_was_parted_in_two_ways_is_no_rival_of_itself():
    size = {"volume_mm3": 1.6, "extents_mm": np.array([3.4, 2.5, 1.2]), "at_border": False, "holes": 1}
    box = {"low": np.zeros(3, dtype=int), "high": np.ones(3, dtype=int), "centre": np.zeros(3)}
    first, again = (Piece(label, **size, **box) for label in (1, 2))
    refuse_rivals([first, again], [np.zeros(3), np.array([0.05, 0.02, 0.0])])
    with pytest.raises(CtInertiaError, match="got 2"):
        refuse_rivals([first, again], [np.zeros(3), np.array([2.0, 0.0, 0.0])])


def test_a_seed_must_lie_in_bone_and_in_the_scan():
    volume = ear(h=0.05, rays=4).volume
    with pytest.raises(CtInertiaError, match="a point without bone around it"):
        find_bodies(volume, SearchOptions(seed_mm=volume.scan_points([4, 4, 4])))
    with pytest.raises(CtInertiaError, match="--seed must be inside the scan"):
        find_bodies(volume, SearchOptions(seed_mm=np.full(3, 99.0)))


def test_a_threshold_between_the_levels_changes_next_to_nothing():
    scan = ear(h=0.05, rays=4)
    for threshold in (8000.0, 14000.0):
        bodies = find_bodies(scan.volume, SearchOptions(threshold=threshold))
        assert abs(errors(bodies.moments, scan.stapes)[0]) < 3e-3
    with pytest.raises(CtInertiaError, match="--threshold must be between the grey levels"):
        find_bodies(scan.volume, SearchOptions(threshold=30000.0))


def test_faulty_scans_are_named():
    scan = ear(h=0.05, rays=4)
    volume = scan.volume
    with pytest.raises(CtInertiaError, match="they are inverted"):
        find_bodies(replace(volume, array=np.uint16(25000) - volume.array))
    big = Volume(volume.array, volume.spacing_mm * 10, volume.origin_mm, np.eye(3))
    with pytest.raises(CtInertiaError, match=r"voxel spacing must be right.* mm high.*--spacing"):
        find_bodies(big)
    noise = np.random.default_rng(0).normal(1000, 50, (40, 40, 40)).astype(np.uint16)
    with pytest.raises(CtInertiaError, match="one material only"):
        find_bodies(replace(volume, array=noise))
    ball = np.linalg.norm(np.indices((60, 60, 60)) - 30, axis=0) < 8
    array = (2000 + 18000 * ball + np.random.default_rng(0).normal(0, 300, ball.shape)).astype(np.uint16)
    with pytest.raises(CtInertiaError, match=r"can be a stapes .* got .*--seed"):
        find_bodies(replace(volume, array=array))


def test_bone_so_uneven_that_it_looks_like_two_materials_is_one():
    from sample_volumes.phantom import Ear, render, scene, truth

    placed = scene(Ear(voxel_mm=(0.025,) * 3, gap_mm=0.1, gradient=0.1, pose_seed=3))
    bodies = find_bodies(Volume(render(placed), np.full(3, 0.025), np.zeros(3), np.eye(3)))
    assert abs(bodies.moments.volume_mm3 / (truth(placed)["volume_m3"] * 1e9) - 1.0) < 1e-3
    assert "stapes_uncertain" not in codes(bodies)
    assert "bone_inhomogeneous" in codes(bodies)


def test_what_the_border_cuts_is_told():
    scan = ear(h=0.05, rays=4)
    index = np.argwhere(scan.volume.array > 11000)
    cut = replace(scan.volume, array=scan.volume.array[:, :, : index[:, 2].max() - 3])
    assert "touches_border" in codes(find_bodies(cut))


def test_nan_counts_as_air_when_allowed():
    scan = ear(h=0.05, rays=4)
    array = scan.volume.array.astype(np.float32)
    array[:3] = np.nan
    bodies = find_bodies(replace(scan.volume, array=array, nan_as_air=True))
    assert abs(errors(bodies.moments, scan.stapes)[0]) < 3e-3
    with pytest.raises(CtInertiaError, match="must be finite"):
        find_bodies(replace(scan.volume, array=array))


def test_direction_and_origin_carry_through():
    scan = ear(h=0.05, rays=4)
    turn = np.array([[0.0, -1.0, 0.0], [0.6, 0.0, -0.8], [0.8, 0.0, 0.6]])
    placed = Volume(scan.volume.array, scan.volume.spacing_mm, np.array([5.0, 6.0, 7.0]), turn)
    here, there = find_bodies(scan.volume).moments, find_bodies(placed).moments
    shifted = turn @ (here.centroid_mm - scan.volume.origin_mm) + [5.0, 6.0, 7.0]
    assert there.centroid_mm == pytest.approx(shifted, abs=1e-9)
    assert there.second_mm5 == pytest.approx(turn @ here.second_mm5 @ turn.T, abs=1e-9)


@pytest.mark.parametrize("plate_gap", [0.1, 0.0])
def test_a_stapes_near_or_on_the_plate(plate_gap):
    scan = ear(h=0.045, plate_gap=plate_gap, margin=0.3, rays=4)
    bodies = find_bodies(scan.volume)
    volume, centroid, inertia = errors(bodies.moments, scan.stapes)
    assert abs(volume) < 2e-3
    assert centroid < 1.5
    assert inertia < 3e-3
    face = bodies.plate_face
    top = float(np.max(scan.plate.vertices_mm @ face.normal))
    assert face.offset_mm == pytest.approx(top, abs=2e-3)
    assert face.sigma_mm == pytest.approx(1.2 * 0.045, rel=0.02)


@pytest.mark.parametrize(("noise", "raised", "limit"), [(0.04, 0.0, 4e-3), (0.1, 2000.0, 8e-3)])
def test_air_clipped_at_zero_is_told_and_corrected(noise, raised, limit):
    scan = ear(h=0.04)
    rng = np.random.default_rng(3)
    share = scan.air_share + noise * rng.standard_normal(scan.air_share.shape, dtype=np.float32)
    array = np.clip(np.rint(raised + (BONE - AIR) * share), 0, 65535).astype(np.uint16)
    bodies = find_bodies(replace(scan.volume, array=array))
    assert "air_clipped" in codes(bodies)
    assert abs(errors(bodies.moments, scan.stapes)[0]) < limit
    assert bodies.levels.air == pytest.approx(raised, abs=50.0)


def test_big_voxels_and_wide_blur_fall_back_on_a_fit():
    scan = ear(h=0.07)
    bodies = find_bodies(scan.volume)
    volume, centroid, _ = errors(bodies.moments, scan.stapes)
    assert bodies.levels.bone_from == "fit"
    assert abs(volume) < 5e-3
    assert centroid < 5.0


def test_loud_noise_leaves_the_body_whole():
    scan = ear(h=0.05, noise=0.15, rays=4)
    bodies = find_bodies(scan.volume)
    assert bodies.stapes.euler_characteristic == 0
    error = errors(bodies.moments, scan.stapes)[0]
    stated = sum(part[0, 0] for part in bodies.moments.contributions.values()) ** 0.5
    assert abs(error) < 1.5 * stated / bodies.moments.volume_mm3
    assert abs(error) < 6e-3
    assert bodies.evidence["stapes"]["holes"] == 1


def test_anything_with_a_border_reports_what_it_saw():
    evidence = find_bodies(ear(h=0.05, rays=4).volume).evidence
    assert evidence["separation"] == "connected component"
    assert evidence["psf_from"]
    assert evidence["material_levels"] == sorted(evidence["material_levels"])


def test_bridges_to_the_bone_are_cut_and_told():
    from sample_volumes.phantom import Ear, render, scene, truth

    placed = scene(Ear(voxel_mm=(0.03,) * 3, gap_mm=0.08, bridges=2, bridge_radius_mm=0.06, plate=False))
    volume = Volume(render(placed), np.full(3, 0.03), np.zeros(3), np.eye(3))
    bodies = find_bodies(volume)
    known = truth(placed)
    assert bodies.moments.volume_mm3 * 1e-9 == pytest.approx(known["volume_m3"], rel=2e-3)
    assert bodies.moments.centroid_mm == pytest.approx(known["center_of_mass_in_scan_mm"], abs=2e-3)
    assert "cut_through_bone" in codes(bodies)
    assert bodies.moments.contributions["separation"][0, 0] > 0.0
    assert "parted at necks" in bodies.evidence["separation"]
