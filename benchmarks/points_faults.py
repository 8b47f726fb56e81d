"""Faults of channels are found, the culprit is named, the kind is right; 1 % of clean files raise an alarm.

``--what faults``: bodies at the points of a footplate, a stapes or the bone, seen by three lasers or one, in
motion with three resonances; each fault at a random place. ``--what two``: two of these faults at once, at
different points. ``--what clean``: files without a fault, also of bodies that no search was developed on: a
flat shell and a rod seen from heads 120 mm away, so that no two beams are parallel.

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
ALONE = ("gain 5 %", "phase 3 deg", "delay 10 us", "sign", "direction 3 deg", "noise x4", "drift 6 %",
         "position 200 um")  # fmt: skip
"""Faults of one channel or point, of which two may meet."""
_THREE_LASERS = ("beams_swap", "axes", "laser_gain", "laser_sign", "laser_direction")


def record(geometry: Geometry, faults: Sequence[MeasurementFault], seed: int, lines: int) -> Recording:
    """Measure one body with faults; what is left open of them is drawn."""
    rng = np.random.default_rng([seed, 53])
    experiment = Experiment(
        lines=lines, lasers=geometry.lasers, beam_cone_deg=geometry.cone_deg, noise_spread=(0.6, 0.8),
        head_distance_mm=geometry.distance_mm, in_footplate=True, position_sd_mm=0.0, faults=tuple(faults),
        seed=seed,
    )  # fmt: skip
    places = geometry.places_mm(rng)
    motion = resonant_motion(rng, experiment.freq_hz)
    return measure_motion({"stapes": motion[None]}, {"stapes": places}, experiment)


Hits = list[tuple[bool, bool, bool]]
"""Whether a fault was found, the culprits named, the kinds right; by file."""


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


def hits_of(recordings: Iterable[Recording], stated: bool) -> Hits:
    """Return for each file whether a fault was found, its culprit named and its kind right."""
    hits: Hits = []
    for recording in recordings:
        right, seen = dict(recording.culprits), accused(recording, stated)
        # refused: found, and no culprit named
        hits.append(
            (True, False, False) if seen is None else (bool(seen), set(seen) == set(right), seen == right)
        )
    return hits


def fault_hits(scenes: int, lines: int, stated: bool) -> dict[str, list[Hits]]:
    """Return what was found of every fault, for each geometry; nothing where it cannot be."""
    found = dict[str, list[Hits]]()
    for number, (name, (kind, size)) in enumerate(FAULTS.items()):
        found[name] = cells = list[Hits]()
        fault = MeasurementFault(kind=kind, size=size)
        for place, geometry in enumerate(GEOMETRIES.values()):
            possible = geometry.lasers > 1 or kind not in _THREE_LASERS
            first = 100_000 * place + 1000 * number
            recordings = (
                record(geometry, [fault], first + scene, lines) for scene in range(scenes if possible else 0)
            )
            cells.append(hits_of(recordings, stated))
    return found


def two_faults(scenes: int, lines: int, stated: bool) -> dict[str, list[Hits]]:
    """Return what was found of two faults at different points, drawn out of `ALONE`, for each geometry."""
    found: list[Hits] = []
    for place, geometry in enumerate(GEOMETRIES.values()):
        recordings = list[Recording]()
        for scene in range(scenes):
            seed = 300_000_000 + 100_000 * place + scene
            rng = np.random.default_rng([seed, 59])
            names, points = rng.choice(ALONE, 2, replace=False), rng.permutation(geometry.points)[:2] + 1
            faults = [
                MeasurementFault(kind=FAULTS[name][0], size=FAULTS[name][1], point=str(point))
                for name, point in zip(names.tolist(), points.tolist(), strict=True)
            ]
            recordings.append(record(geometry, faults, seed, lines))
        found.append(hits_of(recordings, stated))
    return {"two faults": found}


def clean_counts(scenes: int, lines: int, stated: bool) -> dict[str, int]:
    """Return how many clean files of each geometry raise an alarm."""
    found = dict[str, int]()
    for place, (where, geometry) in enumerate((GEOMETRIES | STRANGE).items()):
        seen = [
            accused(record(geometry, [], 500_000_000 + 100_000 * place + scene, lines), stated)
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
        found = (two_faults if given.what == "two" else fault_hits)(given.scenes, given.lines, known)
        every = [hit for cells in found.values() for hits in cells for hit in hits]
        counts = [f"{int(number)}" for number in np.sum(every, axis=0)]
        words = f"a fault found, every culprit and no other named, every kind right: {', '.join(counts)}"
        print(f"Of {len(every)} files {words}.", end=" ")
        rows = {
            name: [shortest(list(np.mean(hits, axis=0))) if hits else NOTHING for hits in cells]
            for name, cells in found.items()
        }
        always = [name for name, cells in rows.items() if set(cells) <= {"100", NOTHING} and len(rows) > 1]
        if always:
            print(f"In all files so: {', '.join(always)}.", end=" ")
        print("In percent, one figure where all three are equal:\n")
        print_table(("fault", *GEOMETRIES), ([name, *rows[name]] for name in rows if name not in always))
    print(f"{given.scenes} files a cell, {given.lines} lines, noise {'' if known else 'not '}stated.")
