"""Label volumes: names and numbers, islands and parts, the same measurement behind them."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion

from ct_inertia.bodies import OTHER_BONE, PLATE, STAPES
from ct_inertia.find.find import find_stapes
from ct_inertia.find.label_volume import body_numbers
from ct_inertia.find.labels import _check_place, label_stapes
from ct_inertia.grey.measure import measure
from ct_inertia.scan.scan import Scan
from stapeskit.faults import StapeskitError
from tests.bodies.body_scenes import ear, true_moments

PARTS = {"gap_mm": 0.12, "plate_gap_mm": 0.1}


FOUND = [
    ({5: "stapes", 6: "stapes tendon"}, [5, 6], None, None, (5, None)),
    ({1: "incus", 3: "bone"}, [1, 3], 3, None, (3, None)),
    ({1: "Segment_1", 2: "Segment_2"}, [1, 2], None, None, (1, 2)),
    ({}, [1], None, None, (1, None)),
    ({}, [1, 2, 3], None, None, (1, 2)),
    ({1: "plate", 2: "Stapes left"}, [1, 2], None, None, (2, 1)),
    ({1: "stapes", 4: "stapes muscle"}, [1, 4], None, None, (1, None)),
    ({1: "Segment_1"}, [1], None, None, (1, None)),
    ({1: "a", 2: "b"}, [1, 2, 7], 7, 2, (7, 2)),
    ({5: "footplate", 6: "stapes"}, [5, 6], 6, None, (6, None)),
    ({1: "left stapes", 2: "stapedius muscle"}, [1, 2], None, None, (1, None)),
]


@pytest.mark.parametrize(("names", "present", "stapes", "plate", "expected"), FOUND)
def test_names_win_over_numbers_and_options_over_names(names, present, stapes, plate, expected):
    assert body_numbers(names, present, stapes, plate, "a.nrrd") == expected


REFUSED = [
    ({1: "incus", 2: "malleus"}, [1, 2], None, None),
    ({}, [4], 4, 4),
    ({1: "incus"}, [1], None, None),
    ({}, [4], None, None),
    ({1: "Segment_1", 2: "Segment_2", 4: "Segment_4"}, [1, 2, 4], None, None),
    ({1: "stapes a", 2: "stapes b"}, [1, 2], None, None),
    ({1: "stapes", 2: "footplate"}, [1, 2], None, None),
    ({1: "stapes"}, [1, 2], None, 1),
    ({}, [1, 2], 3, None),
]


@pytest.mark.parametrize(("names", "present", "stapes", "plate"), REFUSED)
def test_labels_that_do_not_say_which_body_is_the_stapes(names, present, stapes, plate):
    with pytest.raises(StapeskitError) as caught:
        body_numbers(names, present, stapes, plate, "a.nrrd")
    assert caught.value.faults[0].where == "a.nrrd"


def drawn():
    """The scan, its labels as found (a copy), and the stapes as find and grey measure it."""
    scan, placed, labels, alone = drawn_once()
    return scan, placed, labels.copy(), alone


@cache
def drawn_once():
    scan, placed = ear(**PARTS)
    found = find_stapes(scan)
    labels = np.zeros(scan.shape, dtype=np.uint8)
    box = found.box
    place = tuple(slice(int(a), int(a) + n) for a, n in zip(box.first[::-1], box.shape, strict=True))
    part = labels[place]
    for number, mask in ((OTHER_BONE, found.other), (PLATE, found.plate), (STAPES, found.stapes)):
        part[mask] = number
    return scan, placed, labels, measure(found)


def test_labels_with_their_scan_measure_as_the_scan_alone_and_no_surer():
    scan, placed, labels, alone = drawn()
    exact = true_moments(placed).volume_mm3
    for given in (labels, (labels == STAPES).astype(np.uint8)):
        found = measure(label_stapes(Scan.from_array(given, scan.spacing_mm), scan))
        assert abs(found.moments.volume_mm3 - exact) < 4.0 * found.moments.volume_sd_mm3
        assert found.moments.volume_sd_mm3 > 0.8 * alone.moments.volume_sd_mm3
        assert found.surface.level_sd_mm == pytest.approx(alone.surface.level_sd_mm, rel=0.1)


@pytest.mark.parametrize("axis", [0, 2])
def test_bone_that_is_erased_and_bone_that_is_labelled_other_mean_the_same(axis):
    scan, _, labels, _ = drawn()
    places = np.flatnonzero((labels == STAPES).any(axis=tuple(k for k in range(3) if k != axis)))
    cut = places[-(len(places) // 5) :]
    taken = np.isin(np.indices(labels.shape, sparse=True)[axis], cut) & (labels == STAPES)
    found = []
    for number in (0, OTHER_BONE):
        given = np.where(taken, np.uint8(number), labels)
        found.append(label_stapes(Scan.from_array(given, scan.spacing_mm), scan).stapes)
    differing = np.count_nonzero(found[0] != found[1])
    assert differing < 0.01 * np.count_nonzero(found[1])  # a voxel or two of the surface around the cut


def test_a_crop_of_the_labels_lies_where_it_was_cut():
    scan, _, labels, alone = drawn()
    corner = np.array([4, 3, 5])
    crop = Scan.from_array(
        labels[5:, 3:, 4:], scan.spacing_mm, origin_mm=scan.scan_points(corner), handedness_confirmed=True
    )
    found = measure(label_stapes(crop, scan))
    assert found.moments.centroid_mm == pytest.approx(alone.moments.centroid_mm, abs=2e-3)
    moved = Scan.from_array(labels[5:, 3:, 4:], scan.spacing_mm, origin_mm=scan.scan_points(corner + 0.4))
    with pytest.raises(StapeskitError) as error:
        label_stapes(moved, scan)
    assert error.value.faults[0].thing == "the label volume"


def test_labels_beside_their_bone_are_refused_with_the_way_back_and_sloppy_ones_are_not():
    scan, placed, labels, _ = drawn()
    exact = true_moments(placed)
    stapes = (labels == STAPES).astype(np.uint8)
    for shift in ((5, 0, 0), (0, -4, 3)):
        with pytest.raises(StapeskitError) as caught:
            label_stapes(Scan.from_array(np.roll(stapes, shift, axis=(0, 1, 2)), scan.spacing_mm), scan)
        way = [-s * d for s, d in zip(shift[::-1], scan.spacing_mm, strict=True)]
        said = caught.value.faults[0].got.split("moved by ")[1].split(" mm")[0]
        assert [float(part) for part in said.split(",")] == pytest.approx(way, abs=1.5 * scan.spacing_mm[0])
    for other in (binary_dilation(stapes, iterations=2), binary_erosion(stapes)):
        labelled = label_stapes(Scan.from_array(other.astype(np.uint8), scan.spacing_mm), scan)
        found = measure(labelled).moments
        assert abs(found.volume_mm3 - exact.volume_mm3) < 4.0 * found.volume_sd_mm3


@pytest.mark.parametrize("beside", [2, 4, 7])
def test_labels_drawn_loosely_beside_a_wall_are_not_drawn_to_it(beside):
    """Two crura, and a wall of bone as many voxels beside them."""
    crura = np.zeros((40, 40, 50), dtype=bool)
    crura[8:32, 17:21, 14:18] = crura[8:32, 17:21, 26:30] = True
    bright = crura.copy()
    bright[:, :, 30 + beside : 44 + beside] = True
    box = SimpleNamespace(spacing_mm=np.full(3, 0.03))
    loose = (binary_dilation(crura, iterations=2) & ~(bright & ~crura)).astype(np.uint8) * STAPES
    _check_place(box, loose, bright)
    with pytest.raises(StapeskitError):
        _check_place(box, np.roll(crura.astype(np.uint8) * STAPES, 4, axis=1), bright)


def test_islands_are_left_out_or_refused_and_never_counted():
    scan, _, labels, _ = drawn()
    clean = measure(label_stapes(Scan.from_array(labels, scan.spacing_mm))).moments.volume_mm3
    labels[1:3, 1:3, 1:3] = STAPES
    found = label_stapes(Scan.from_array(labels, scan.spacing_mm))
    assert any("8 voxels" in notice.text for notice in found.notices)
    assert measure(found).moments.volume_mm3 == pytest.approx(clean)
    labels[:20, :12, :14] = STAPES
    with pytest.raises(StapeskitError) as error:
        label_stapes(Scan.from_array(labels, scan.spacing_mm))
    assert error.value.faults[0].thing == "the stapes of the label volume"


@pytest.mark.parametrize("wrong", ["grey values", "no stapes", "another scan"])
def test_what_is_no_label_volume_is_refused(wrong):
    scan, _, labels, _ = drawn()
    if wrong == "grey values":
        labels = labels + 0.3 * (labels > 0).astype(np.float32)
    if wrong == "no stapes":
        labels = np.where(labels == STAPES, 9, 0).astype(np.uint8)
    if wrong == "another scan":
        labels = np.roll(labels, 40, axis=2)
    with pytest.raises(StapeskitError):
        label_stapes(Scan.from_array(labels, scan.spacing_mm), scan)
