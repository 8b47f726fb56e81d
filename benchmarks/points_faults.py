"""Faults of channels are found, the culprit is named, the kind is right; 1 % of clean files raise an alarm.

``--what faults``: bodies at the points of a footplate, a stapes or the bone, seen by three lasers or one, in
motion with three resonances; each fault at a random place. ``--what clean``: files without a fault, also of
bodies that no search was developed on: a flat shell and a rod seen from heads 120 mm away, so that no two
beams are parallel.

    python -m benchmarks.points_faults --scenes 10
    python -m benchmarks.points_faults --what clean --scenes 100 --stated no
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks._table import NOTHING, arguments, print_table
from kinematics.faults.search import diagnose
from kinematics.faults.verdicts import channel_verdicts
from kinematics.fit.beams import beam_set
from kinematics.fit.noise import fit_with_noise
from kinematics.measurement import BodyChannels, Measurement
from simulate import (
    Experiment,
    MeasurementFault,
    Recording,
    measure_motion,
    resonant_motion,
    scattered_points,
)
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.spatial import DOF_NAMES

SQUARE_DEG = 54.7356
"""Half angle of the cone on which three lasers are at right angles to each other."""


@dataclass(frozen=True)
class Geometry:
    """Points of a body (count, on a flat footplate or scattered in a box), and lasers."""

    points: int
    lasers: int = 3
    cone_deg: float = SQUARE_DEG
    flat: bool = False
    box_mm: tuple[float, float, float] | None = None
    distance_mm: float | None = None

    def places_mm(self, rng: np.random.Generator) -> Array:
        """Return the points (count, 3)."""
        if self.box_mm is None:
            return scattered_points(rng, self.points, self.flat)
        return rng.uniform(-1.0, 1.0, (self.points, 3)) * self.box_mm


GEOMETRIES = {
    "footplate, 5 points 3D": Geometry(5, flat=True),
    "stapes, 10 points 3D": Geometry(10),
    "stapes, 9 points, lasers at 20 deg": Geometry(9, cone_deg=20.0),
    "bone, 12 points, lasers at 30 deg": Geometry(12, cone_deg=30.0, box_mm=(4.0, 1.2, 4.0)),
    "1D, 40 points": Geometry(40, lasers=1, box_mm=(1.4, 0.1, 0.65)),
}
STRANGE = {
    "shell, 5 points, 3 heads": Geometry(5, cone_deg=35.0, box_mm=(1.6, 0.5, 0.8), distance_mm=120.0),
    "shell, 12 points, 3 heads": Geometry(12, cone_deg=25.0, box_mm=(2.5, 1.2, 0.9), distance_mm=120.0),
    "rod, 8 points, 2-3 heads": Geometry(8, cone_deg=30.0, box_mm=(0.5, 4.0, 0.5), distance_mm=120.0),
    "disc, 40 points, 1 head": Geometry(40, lasers=1, box_mm=(1.8, 0.15, 0.8), distance_mm=120.0),
}
FAULTS = {
    "gain 5 %": ("gain", 0.05), "gain 2 %": ("gain", 0.02), "phase 3 deg": ("phase", 3.0),
    "delay 10 us": ("delay", 1e-5), "sign": ("sign", None), "direction 3 deg": ("direction", 3.0),
    "noise x4": ("noise", 4.0), "drift 6 %": ("drift", 0.06), "zeros": ("zeros", None),
    "position 200 um": ("position", 0.2), "point sign": ("point_sign", None),
    "label swap": ("label_swap", None), "beams swapped": ("beams_swap", None), "axes 2 deg": ("axes", 2.0),
    "laser gain 5 %": ("laser_gain", 0.05), "laser sign": ("laser_sign", None),
    "laser direction 3 deg": ("laser_direction", 3.0), "flexible 3 %": ("flexible", 0.03),
}  # fmt: skip
_THREE_LASERS = ("beams_swap", "axes", "laser_gain", "laser_sign", "laser_direction")


def record(geometry: Geometry, fault: tuple[str, float | None] | None, seed: int, lines: int) -> Recording:
    """Measure one body with a fault; what is left open of the fault is drawn."""
    rng = np.random.default_rng([seed, 53])
    faults = () if fault is None else (MeasurementFault(kind=fault[0], size=fault[1]),)
    experiment = Experiment(
        lines=lines, lasers=geometry.lasers, beam_cone_deg=geometry.cone_deg, noise_spread=(0.6, 0.8),
        head_distance_mm=geometry.distance_mm, in_footplate=True, position_sd_mm=0.0, faults=faults,
        seed=seed,
    )  # fmt: skip
    places = geometry.places_mm(rng)
    motion = resonant_motion(rng, experiment.freq_hz)
    return measure_motion({"stapes": motion[None]}, {"stapes": places}, experiment)


def accused(recording: Recording, stated: bool) -> dict[int, str] | None:
    """Return the verdict of every channel that is not in order; None where the file is refused."""
    parts = {
        "points": tuple(recording.point),
        "positions_m": recording.position_mm * 1e-3,
        "directions": recording.direction,
        "value": recording.velocity_m_s,
        "sd": recording.sd_m_s if stated else None,
    }
    one_laser = recording.laser.max() == 0
    dof = ("y", "alpha", "gamma") if one_laser else DOF_NAMES
    try:
        body = BodyChannels("stapes", **parts)
        placed = Measurement("footplate", ("1",), recording.freq_hz, (body,))
        zeros = {int(channel): "zeros" for channel in np.flatnonzero(np.all(body.value[0] == 0.0, axis=1))}
        body.value[:, list(zeros)] = np.nan
        beams = beam_set("stapes", body.arms_m, body.directions, dof)
        fit, _ = fit_with_noise(placed, 0, body, beams)
        found = diagnose(body, [fit], placed.freq_hz)
    except StapeskitError:
        return None
    verdicts = channel_verdicts("1", body, found, fit.channel_rms_m, fit.solution.weight, zeros)
    return {channel: one.verdict for channel, one in enumerate(verdicts) if one.verdict != "ok"}


def shortest(shares: Sequence[float]) -> str:
    """Return shares in percent; one where all are equal."""
    words = [f"{100.0 * share:.0f}" for share in shares]
    return words[0] if len(set(words)) == 1 else "/".join(words)


def fault_cell(recordings: Iterable[Recording], stated: bool) -> str:
    """Return how often a fault was found, its culprit named and its kind right."""
    hits = list[tuple[bool, bool, bool]]()
    for recording in recordings:
        right, seen = dict(recording.culprits), accused(recording, stated)
        # refused: found, and no culprit named
        hits.append(
            (True, False, False) if seen is None else (bool(seen), set(seen) == set(right), seen == right)
        )
    return shortest(list(np.mean(hits, axis=0)))


def fault_rows(scenes: int, lines: int, stated: bool) -> dict[str, list[str]]:
    """Return the cells of every fault, one for each geometry."""
    found = dict[str, list[str]]()
    for number, (name, fault) in enumerate(FAULTS.items()):
        found[name] = cells = list[str]()
        for place, geometry in enumerate(GEOMETRIES.values()):
            if geometry.lasers == 1 and fault[0] in _THREE_LASERS:
                cells.append(NOTHING)
                continue
            first = 100_000 * place + 1000 * number
            recordings = (record(geometry, fault, first + scene, lines) for scene in range(scenes))
            cells.append(fault_cell(recordings, stated))
    return found


def clean_counts(scenes: int, lines: int, stated: bool) -> dict[str, int]:
    """Return how many clean files of each geometry raise an alarm."""
    found = dict[str, int]()
    for place, (where, geometry) in enumerate((GEOMETRIES | STRANGE).items()):
        seen = [
            accused(record(geometry, None, 500_000_000 + 100_000 * place + scene, lines), stated)
            for scene in range(scenes)
        ]
        found[where] = sum(one is None or bool(one) for one in seen)
    return found


if __name__ == "__main__":
    given = arguments(__doc__, what="faults", scenes=3, lines=120, stated="yes")
    known = given.stated == "yes"
    if given.what == "clean":
        counts = clean_counts(given.scenes, given.lines, known)
        print_table(("geometry", "files with an alarm"), counts.items())
        print(f"Together {100 * sum(counts.values()) / given.scenes / len(counts):.2f} %.", end=" ")
    else:
        found = fault_rows(given.scenes, given.lines, known)
        always = [name for name, cells in found.items() if set(cells) <= {"100", NOTHING}]
        print(f"In all files found, the culprit named and the kind right: {', '.join(always)}.")
        print("Of the others, found/culprit named/right kind in percent, one figure where all are equal:\n")
        print_table(("fault", *GEOMETRIES), ([name, *found[name]] for name in found if name not in always))
    print(f"{given.scenes} files a cell, {given.lines} lines, noise {'' if known else 'not '}stated.")
