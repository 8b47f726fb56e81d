"""Faulty fiducials are found and named: off, exchanged, scaled, in other units, mirrored."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.stapeskit.alignment.exchanged_points import best_order, cycles
from legacy.stapeskit.alignment.registration import fit_rigid
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.frames import RigidTransform, rotation_from_vector

MARKS = np.array([[-10.0, 0, -8], [10, 0, -8], [10, 0, 8], [-10, 0, 8], [0, 3, 0], [4, 5, -3]])
POSE = RigidTransform.from_parts(
    rotation_from_vector([0.5, -1.2, 2.0]), [30.0, -400.0, 12.0], "plate", "vibrometer"
)
SEEN = POSE.inverse().points(MARKS)


def fit(seen=SEEN, known=MARKS, sd=None, **more):
    return fit_rigid(seen, known, sd, to="plate", source="vibrometer", **more)


def faulty_marks(rng, fault, sd):
    """Return seen points with noise, references with one fault, and the culprits' names."""
    seen, known = SEEN + sd * rng.normal(size=SEEN.shape), MARKS.copy()
    i, j = rng.choice(6, 2, replace=False)
    if fault == "swapped":
        known[[i, j]] = known[[j, i]]
        return seen, known, {"abcdef"[i], "abcdef"[j]}
    known[i, rng.integers(3)] += rng.choice([-1.0, 1.0]) * 20.0 * sd
    return seen, known, {"abcdef"[i]}


@pytest.mark.parametrize("stated", [True, False])
def test_one_faulty_fiducial_is_named(stated):
    right = 0
    for seed in range(60):
        seen, known, culprits = faulty_marks(np.random.default_rng([seed, 9]), "mistyped", 0.02)
        (notice,) = fit(seen, known, 0.02 if stated else None, names=tuple("abcdef")).notices
        assert notice.code == "fiducials_inconsistent"
        said = notice.text.split("fiducial")[2 if stated else 1]
        right += all(f" {name} " in said for name in culprits)
    assert right >= 58


@pytest.mark.parametrize("count", [6, 11])
@pytest.mark.parametrize(
    "moved", [((0, 1),), ((0, 1), (2, 3)), ((0, 1, 2),), ((0, 4, 2, 1),), ((0, 1, 2), (3, 5))]
)
@pytest.mark.parametrize("stated", [True, False])
def test_exchanged_fiducials_are_refused_by_name(moved, stated, count):
    rng = np.random.default_rng([count, len(moved), len(moved[0])])
    known = rng.uniform(-8.0, 8.0, (count, 3))
    seen = POSE.inverse().points(known) + 0.02 * rng.normal(size=known.shape)
    reported = known.copy()
    for cycle in moved:
        for one, two in zip(cycle, (*cycle[1:], cycle[0]), strict=True):
            reported[two] = known[one]
    names = tuple("abcdefghijk"[:count])
    with pytest.raises(StapeskitError) as caught:
        fit(seen, reported, 0.02 if stated else None, names=names)
    (fault,) = caught.value.faults
    assert fault.thing == "the names of the fiducials"
    said = str(fault.got).partition(" (residual")[0]
    for cycle in moved:
        steps = [
            f"{names[one]} is {names[two]}" for one, two in zip(cycle, (*cycle[1:], cycle[0]), strict=True)
        ]
        pair = [f"{names[cycle[0]]} and {names[cycle[1]]} exchanged"]
        assert all(step in said for step in (pair if len(cycle) == 2 else steps))


@pytest.mark.parametrize("sd", [0.02, None])
def test_two_pairs_exchanged_on_a_nearly_flat_plate_are_no_mirror_image(sd):
    rng = np.random.default_rng(4)
    corners = [[-2.2, 0.0, -1.5], [2.4, 0.1, -1.4], [2.3, 0.2, 1.7], [-2.1, 0.1, 1.4], [0.3, 1.5, 2.0]]
    known = np.array([*corners, [1.0, 0.9, -2.1]])
    seen = POSE.inverse().points(known) + 0.01 * rng.normal(size=known.shape)
    with pytest.raises(StapeskitError, match="got a and b exchanged; c and d exchanged"):
        fit(seen, known[[1, 0, 3, 2, 4, 5]], sd, names=tuple("abcdef"))


def test_the_order_of_a_symmetric_plate_moves_fewest_points():
    square = np.array([[1.0, 0, 1], [-1, 0, 1], [-1, 0, -1], [1, 0, -1], [0.3, 0.7, 0.0]])
    order, energy = best_order(square, square, np.ones(5))
    assert order == (0, 1, 2, 3, 4)
    assert energy < 1e-20
    assert cycles((1, 0, 3, 4, 2)) == [(0, 1), (2, 3, 4)]


def test_coplanar_marks_cannot_tell_which_is_off():
    known = MARKS[:4].copy()
    known[1, 1] += 0.5
    text = fit(SEEN[:4], known, 0.02, names=tuple("abcd")).notices[1].text
    assert "one of the fiducials" in text
    assert "cannot tell which" in text


def test_a_wrong_scale_is_named():
    text = fit(1.02 * SEEN, MARKS, 0.01).notices[0].text
    assert "references are 0.9804 times those that the vibrometer sees" in text


@pytest.mark.parametrize(
    ("factor", "match"),
    [(1e-3, r"vibrometer coordinates seem to be in m, or those of the plate frame in um"),
     (1e3, "plate coordinates seem to be in m"),
     (1.0 / 25.4, "vibrometer coordinates seem to be in inches"),
     (3.0, "distances that are 3 times as large")],
)  # fmt: skip
def test_other_units_are_refused(factor, match):
    with pytest.raises(StapeskitError, match=match):
        fit(factor * SEEN, MARKS, 0.01)


def test_one_mark_off_the_plane_leaves_two_readings():
    flat = np.vstack([MARKS[:4], [[2.0, 3.0, 1.0]]])
    with pytest.raises(StapeskitError, match=r"--mirror.*or correct fiducial 5"):
        fit(POSE.inverse().points(flat) * [1, 1, -1], flat, 0.02)
