"""A simulated 3D laser Doppler vibrometer that looks at a shaken stapes and at the bone around it.

Signals are e^{+i w t}, velocities are peak; a channel reads v . d with d the unit vector towards its laser.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from simulate.faults import MeasurementFault, TrueState, apply_fault
from stapeskit.arrays import Array, ComplexArray
from stapeskit.frames import RigidTransform, rotation_from_vector

NOISE_COLUMNS = ("sd", "coherence", "n_avg", "none")
AVERAGES = 16
"""Of a spectrum, stated with ``coherence`` and ``n_avg``: few, as in a scan of many points."""


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """How an ear is shaken and measured."""

    lines: int = 200  # frequencies, evenly spaced
    band_hz: tuple[float, float] = (400.0, 5000.0)
    excitations: tuple[str, ...] = ("y",)  # main direction (x, y or z) of the shaker in each run
    # runs of one direction are stated as repeats of one run; ldv.csv alone can say so
    repeats: bool = False
    # how much the bone moves in its other degrees of freedom, 1: rocking and in-plane motion as usual
    others: float = 1.0
    stapes_points: int = 10
    bone_points: int = 9
    # on a cone of ``beam_cone_deg`` around the optical axis; one laser looks along the axis
    lasers: int = 3
    beam_cone_deg: float = 20.0
    # distance of the laser heads, so that no two beams of one are parallel; None: parallel beams
    head_distance_mm: float | None = None
    # positions and directions are given in footplate axes; else in coordinates of the vibrometer
    in_footplate: bool = False
    # standard deviation of a channel's real part over its root mean square; each channel has its own,
    # between ``noise_spread`` times this
    noise: float = 0.01
    noise_spread: tuple[float, float] = (0.6, 1.6)
    stated: str = "sd"  # what the file says of the noise, one of NOISE_COLUMNS
    position_sd_mm: float = 0.01  # error with which points and fiducials are known, per coordinate
    fiducial_sd_mm: float = 0.01
    laser_scatter: float = 0.0  # of gain, phase and delay of the lasers, in 1 %, 0.5 degrees and 1 us (sd)
    # fiducials are stated as read off the scan; else as in the drawing of the plate, where there is one
    marks_in_scan: bool = False
    # share of single values that are missing; one channel is missing over half of the lines
    missing: float = 0.0
    missing_band: bool = False
    faults: tuple[MeasurementFault, ...] = ()
    # axis of the vibrometer's coordinates that points the wrong way (a left-handed scanner), or empty
    mirror: str = ""
    exact: bool = False  # leave all random errors away: the data obey the equation of motion to rounding
    format: str = "csv"  # one of simulate.files.recordings.WRITERS
    seed: int = 1

    @property
    def freq_hz(self) -> Array:
        """Frequencies (L,), Hz."""
        return np.linspace(*self.band_hz, self.lines)

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the runs: their excitation, numbered where one is repeated."""
        names = self.excitations
        return tuple(
            name if names.count(name) == 1 or self.repeats else f"{name}{names[: k + 1].count(name)}"
            for k, name in enumerate(names)
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """What the vibrometer writes, in its own coordinates, and what was wrong with it."""

    runs: tuple[str, ...]
    freq_hz: Array  # (L,)
    body: tuple[str, ...]
    point: tuple[str, ...]
    laser: Array  # (C,)
    position_mm: Array  # (C, 3): As reported
    direction: Array
    velocity_m_s: ComplexArray  # (R, C, L): NaN where missing
    sd_m_s: Array  # (R, C, L): True standard deviation of the real (= imaginary) part, but for faults
    stated: str = "sd"  # what the file says of it
    position_sd_mm: float = 0.0  # 0 for exact data
    fiducial_sd_mm: float = 0.0
    fiducials: tuple[tuple[str, Array, Array], ...] = ()
    fiducial_frame: str = "plate"  # frame of the references
    frame: str = "vibrometer"  # ``vibrometer`` or ``footplate``: coordinates of positions and directions
    # channels at fault, each with the right verdict
    culprits: Mapping[int, str] = field(default_factory=dict)
    # (R, L, 6): True motion of each body about the footplate centre in footplate axes, m and rad
    motion_m: Mapping[str, ComplexArray] = field(default_factory=dict)
    vibrometer_from_footplate: RigidTransform

    def channels(self, body: str, point: str | None = None) -> list[int]:
        """Return the channels of a body, or of one of its points."""
        pairs = zip(self.body, self.point, strict=True)
        return [c for c, pair in enumerate(pairs) if pair[0] == body and point in (None, pair[1])]

    def coherence(self) -> Array:
        """Return g2 (R, C, L) of `AVERAGES`; the noise |v| sqrt((1 - g2) / (2 n g2)) scatters by it."""
        relative = self.sd_m_s / np.maximum(np.abs(self.velocity_m_s), 1e-300)
        energy = np.random.default_rng(AVERAGES).chisquare(2 * (AVERAGES - 1), relative.shape)
        return np.asarray(1.0 / (1.0 + energy * relative**2))


def measure_motion(
    motions: Mapping[str, ComplexArray],
    places_mm: Mapping[str, Array],
    experiment: Experiment,
    pose: RigidTransform | None = None,
    rng: np.random.Generator | None = None,
    references: tuple[RigidTransform, Mapping[str, Array]] | None = None,
) -> Recording:
    """Measure bodies of any motion at any points.

    Parameters
    ----------
    motions : mapping of str to ndarray, (R, L, 6), complex
        Displacement of each body about the footplate centre in footplate axes, m and rad.
    places_mm : mapping of str to ndarray, (P, 3)
        True points of each body, footplate coordinates.
    pose : RigidTransform, optional
        vibrometer_from_footplate; drawn when not given.
    references : (RigidTransform, mapping), optional
        footplate_from_reference, and places of fiducials in that frame, mm.
    """
    rng = np.random.default_rng([experiment.seed, 7]) if rng is None else rng
    pose = vibrometer_pose(rng) if pose is None else pose
    wobble = 0.0 if experiment.exact else experiment.position_sd_mm
    names = [(body, str(k + 1)) for body, places in places_mm.items() for k in range(len(places))]
    truly = np.concatenate([np.asarray(places, dtype=float) for places in places_mm.values()])
    seen = pose.points(truly)
    reported = seen + wobble * rng.standard_normal(seen.shape)
    towards = laser_directions(experiment.lasers, experiment.beam_cone_deg)
    direction = np.broadcast_to(towards, (len(names), *towards.shape))
    if experiment.head_distance_mm is not None:
        beams = experiment.head_distance_mm * direction - seen[:, None]
        direction = beams / np.linalg.norm(beams, axis=-1, keepdims=True)
    direction = direction.reshape(-1, 3)
    bodies, points = (tuple(np.repeat(part, len(towards)).tolist()) for part in zip(*names, strict=True))
    state = TrueState(
        rng=np.random.default_rng([experiment.seed, 13]),
        freq_hz=experiment.freq_hz,
        body=bodies,
        point=points,
        laser=np.tile(np.arange(len(towards)), len(names)),
        place_mm=np.repeat(truly, len(towards), axis=0),
        beam=pose.inverse().vectors(direction),
        motion_m={body: np.array(motion) for body, motion in motions.items()},
        runs=len(experiment.excitations),
    )
    faultless = state.readings()
    if experiment.laser_scatter:
        state.factor *= _laser_factors(experiment)[state.laser]
    for fault in experiment.faults:
        apply_fault(state, fault)
    size = np.sqrt(np.mean(np.abs(faultless) ** 2, axis=2))
    sd = experiment.noise * size * rng.uniform(*experiment.noise_spread, size.shape)
    sd = np.broadcast_to(sd[:, :, None], faultless.shape)[:, state.order]
    noise = rng.standard_normal((*faultless.shape, 2)) @ np.array([1.0, 1j])
    velocity = state.faulty()
    if not experiment.exact:
        noisy = state.loud * np.any(state.factor != 0.0, axis=1)
        velocity = velocity + sd * noisy[:, None] * noise
    marks = _fiducials(pose, references, experiment, rng)
    place_mm = np.repeat(reported, len(towards), axis=0)
    if experiment.in_footplate:
        back, marks = pose.inverse(), ()
        place_mm, direction = back.points(place_mm), back.vectors(direction)
    flip = np.where([axis == experiment.mirror for axis in "xyz"], -1.0, 1.0)
    return Recording(
        runs=experiment.runs,
        freq_hz=experiment.freq_hz,
        body=bodies,
        point=points,
        laser=state.laser,
        position_mm=place_mm * flip,
        direction=direction * flip,
        velocity_m_s=_with_gaps(velocity, experiment),
        sd_m_s=sd,
        stated="none" if experiment.exact else experiment.stated,
        position_sd_mm=wobble,
        fiducial_sd_mm=0.0 if experiment.exact else experiment.fiducial_sd_mm,
        fiducials=tuple((name, seen * flip, place) for name, seen, place in marks),
        fiducial_frame="plate" if references is None else references[0].source,
        frame="footplate" if experiment.in_footplate else "vibrometer",
        culprits=dict(state.culprits),
        motion_m=dict(motions),
        vibrometer_from_footplate=pose,
    )


def _laser_factors(experiment: Experiment) -> ComplexArray:
    """Return by what each laser multiplies its readings, (lasers, L)."""
    draws = np.random.default_rng([experiment.seed, 1]).standard_normal((3, experiment.lasers, 1))
    gain, phase, delay = experiment.laser_scatter * draws
    angle = np.radians(0.5 * phase) - 2.0 * np.pi * experiment.freq_hz * 1e-6 * delay
    return np.asarray((1.0 + 0.01 * gain) * np.exp(1j * angle))


def _with_gaps(velocity: ComplexArray, experiment: Experiment) -> ComplexArray:
    rng = np.random.default_rng([experiment.seed, 61])
    gappy = velocity.copy()
    if experiment.missing:
        gappy[rng.random(gappy.shape) < experiment.missing] = np.nan
    if experiment.missing_band:
        half = gappy.shape[2] // 2
        start = int(rng.integers(half))
        gappy[:, int(rng.integers(gappy.shape[1])), start : start + half] = np.nan
    return gappy


def _fiducials(
    pose: RigidTransform,
    references: tuple[RigidTransform, Mapping[str, Array]] | None,
    experiment: Experiment,
    rng: np.random.Generator,
) -> tuple[tuple[str, Array, Array], ...]:
    if references is None:
        return ()
    frame, places = references
    wobble = 0.0 if experiment.exact else experiment.fiducial_sd_mm
    seen_from = pose @ frame
    return tuple(
        (name, seen_from.points(place) + wobble * rng.standard_normal(3), np.asarray(place, dtype=float))
        for name, place in places.items()
    )


def vibrometer_pose(rng: np.random.Generator) -> RigidTransform:
    """Return vibrometer_from_footplate: the optical axis (z) looks down on the stapes, up to some degrees."""
    lay = rotation_from_vector([np.pi / 2.0, 0.0, 0.0])
    turn = rotation_from_vector([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    lean = rotation_from_vector(np.radians(rng.uniform(-8.0, 8.0, 3)))
    return RigidTransform.from_parts(
        lean @ turn @ lay, rng.uniform(-20.0, 20.0, 3), "vibrometer", "footplate"
    )


def laser_directions(count: int, cone_deg: float) -> Array:
    """Return the unit vectors towards laser heads on a cone around z, (count, 3); a single one is z."""
    if count == 1:
        return np.array([[0.0, 0.0, 1.0]])
    turn = np.radians(90.0 + 360.0 / count * np.arange(count))
    cone = np.radians(cone_deg)
    return np.column_stack(
        [np.sin(cone) * np.cos(turn), np.sin(cone) * np.sin(turn), np.full(count, np.cos(cone))]
    )
