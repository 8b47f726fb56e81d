"""The vibrometer's registration is as good as it states, and a wrong fiducial is named.

target: error at the footplate centre by Monte Carlo against the predicted one and the formula of
Fitzpatrick, West and Maurer (1998, doi:10.1109/42.736021), and the squared distance of the pose over its
six degrees of freedom. faults: marks of 20 um with one fault, with their sd stated and not: how often there
is a warning or a refusal, and how often it names the culprit; the least over four sets of marks.

    python -m benchmarks.points_registration --draws 2000
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks._table import arguments, print_table
from simulate import FIDUCIALS_MM
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.frames import RigidTransform, rotation_from_vector
from stapeskit.registration import displacement, fit_rigid

CORNERS = np.array([[-10.0, 0.0, -8.0], [10.0, 0.0, -8.0], [10.0, 0.0, 8.0], [-10.0, 0.0, 8.0]])
MARKS = {
    "3 corners of a 20 x 16 mm plate": CORNERS[:3],
    "4 corners": CORNERS,
    "4 corners, 1 mark 3 mm above": np.vstack([CORNERS, [[0.0, 3.0, 0.0]]]),
    "4 corners, 2 marks above": np.vstack([CORNERS, [[0.0, 3.0, 0.0], [4.0, 5.0, -3.0]]]),
    "sample study: 4 corners and 2 pins of a 4 mm plate": np.array(list(FIDUCIALS_MM.values())),
    "10 marks in the volume": np.random.default_rng(3).uniform(-8.0, 8.0, (10, 3)),
}
FAULTY = dict(list(MARKS.items())[2:])
FAULTS = ("none", "one coordinate 0.3 mm off", "one coordinate 1 mm off", "two exchanged", "mirrored")
FOOTPLATE_MM = np.array([[0.0, 8.0, 0.0]])
SD_MM = 0.05  # of a mark and coordinate: the accuracy of marks that stapeskit.fiducial_faults takes


def drawn_pose(rng: np.random.Generator) -> RigidTransform:
    """Return a random plate_from_vibrometer."""
    turn = rotation_from_vector(rng.uniform(-1.8, 1.8, 3))
    return RigidTransform.from_parts(turn, rng.uniform(-60.0, 60.0, 3), "plate", "vibrometer")


def expected_error_mm(marks: Array, target: Array, sd_mm: float) -> float:
    """Return the target registration error by Fitzpatrick, West and Maurer, mm; sd_mm is per coordinate.

    TRE^2 = FLE^2 / n (1 + 1/3 sum over the principal axes of d^2 / f^2), d and f the distances of the target
    and, as a root mean square, of the marks from the axis.
    """
    centred = marks - marks.mean(axis=0)
    axes = np.linalg.svd(centred)[2]
    away = (target - marks.mean(axis=0)) @ axes.T
    along = centred @ axes.T
    share = 0.0
    for axis in range(3):
        others = [place for place in range(3) if place != axis]
        share += np.sum(away[others] ** 2) / np.mean(np.sum(along[:, others] ** 2, axis=1)) / 3.0
    return float(np.sqrt(3.0 * sd_mm**2 / len(marks) * (1.0 + share)))


def target_rows(draws: int) -> Iterator[list[object]]:
    """Yield errors at the footplate centre, found and predicted."""
    for number, (name, marks) in enumerate(MARKS.items()):
        rng = np.random.default_rng([1, number, 0])
        misses, distances, stated = [], [], []
        for _ in range(draws):
            pose = drawn_pose(rng)
            seen = pose.inverse().points(marks) + SD_MM * rng.standard_normal(marks.shape)
            fit = fit_rigid(seen, marks, SD_MM, to="plate", source="vibrometer")
            there = pose.inverse().points(FOOTPLATE_MM)
            misses.append(np.linalg.norm(fit.transform.points(there) - FOOTPLATE_MM))
            error = displacement(fit.transform, pose)
            distances.append(error @ np.linalg.solve(fit.covariance_si, error))
            stated.append(fit.target_registration_error(there)[0])
        found, predicted = (1e3 * np.sqrt(np.mean(np.square(part))) for part in (misses, stated))
        expected = 1e3 * expected_error_mm(marks, FOOTPLATE_MM[0], SD_MM)
        distance = np.mean(distances) / 6.0
        yield [name, f"{found:.1f}", f"{predicted:.1f}", f"{expected:.1f}", f"{distance:.3f}"]


def with_fault(rng: np.random.Generator, marks: Array, fault: str, stated: bool) -> tuple[str, list[str]]:
    """Return what is said of marks with a fault, and the names of those at fault."""
    names = tuple(f"m{place}" for place in range(len(marks)))
    seen = drawn_pose(rng).inverse().points(marks) + 0.02 * rng.standard_normal(marks.shape)
    known, culprits = marks.copy(), list[str]()
    first, second = rng.choice(len(marks), 2, replace=False)
    if fault.startswith("one"):
        known[first, rng.integers(3)] += 0.3 if "0.3" in fault else 1.0
        culprits = [names[first]]
    elif fault == "two exchanged":
        known[[first, second]] = known[[second, first]]
        culprits = [names[first], names[second]]
    elif fault == "mirrored":
        seen, culprits = seen * [1.0, -1.0, 1.0], ["--mirror"]
    try:
        fit = fit_rigid(seen, known, 0.02 if stated else None, to="plate", source="vibrometer", names=names)
    except StapeskitError as error:
        return str(error), culprits
    return " ".join(notice.text for notice in fit.notices if "inconsistent" in notice.code), culprits


def fault_rows(draws: int) -> Iterator[list[object]]:
    """Yield how often each fault is reported/named, in percent: the worst of the sets of marks."""
    for fault in FAULTS:
        cells = list[object]([fault])
        for stated in (True, False):
            shares = [fault_shares(marks, fault, stated, draws) for marks in FAULTY.values()]
            if fault == "none":
                cells.append(f"{100 * max(warned for warned, _ in shares):g}")
            else:
                cells.append("/".join(f"{100 * least:g}" for least in np.min(shares, axis=0)))
        yield cells


def fault_shares(marks: Array, fault: str, stated: bool, draws: int) -> tuple[float, float]:
    """Return how often a fault is reported, and how often the culprit is named."""
    said = [with_fault(np.random.default_rng([draw, 7]), marks, fault, stated) for draw in range(draws)]
    warned = np.mean([bool(text) for text, _ in said])
    named = np.mean([bool(text) and all(one in text for one in wrong) for text, wrong in said])
    return float(warned), float(named)


if __name__ == "__main__":
    given = arguments(__doc__, draws=200)
    few = max(given.draws // 5, 10)
    head = ("fiducials, sd 50 um", "error, um", "predicted", "Fitzpatrick-West", "squared distance / 6")
    print_table(head, target_rows(given.draws))
    print_table(("fault", "sd of marks stated", "not stated"), fault_rows(few))
    print(f"Reported/culprit named, in percent; {few} draws of a fault, {given.draws} above.")
