"""How far the lasers agree: gain, phase and delay of each, estimated from the redundancy of all beams.

Shapes: c channels of all bodies together, p parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.search import Diagnosis
from kinematics.fit.lasers import laser_numbers
from kinematics.joint.estimate import joint
from kinematics.joint.pack import Packed, pack
from kinematics.joint.tangents import DELAY, GAIN, PHASE, SHIFT, Geometry, Parameters
from kinematics.measurement import Measurement, direction_name
from stapeskit.arrays import Array
from stapeskit.warnings import Notice

KINDS = {"laser_gain": GAIN, "laser_phase": PHASE, "laser_delay": DELAY}
SHOWN = {"laser_gain": ("gain", 100.0, "%"), "laser_phase": ("phase", 180.0 / np.pi, "°"),
         "laser_delay": ("delay", 1e6, "µs")}  # fmt: skip
"""What a parameter is, the factor from SI to the unit in which it is shown, and this unit."""

_UNLIKELY = 1e-3  # probability of an estimate below which the lasers disagree by more than stated
_LEAST_GAINED = 0.05  # share of the prior variance below which the data say nothing


@dataclass(frozen=True)
class LaserAgreement:
    """Errors of the lasers as shared parameters, as far as the beams themselves leave them open.

    Attributes
    ----------
    names : tuple of str, (p,)
        ``laser_gain.1`` ..., ``laser_phase.1`` ..., ``laser_delay.1`` ...: a reading is the true value times
        1 + gain, e^(i phase) and e^(-i w delay).
    prior_sd, values : ndarray, (p,)
        As stated and as estimated; 1, rad and s.
    covariance : ndarray, (p, p)
        After the data; motion and stated errors of positions left free.
    across : mapping of str to ndarray, (p,)
        Covariance of what the estimate leaves with each error of a position, by its name.
    of_channel : tuple of ndarray, int
        By body: the laser of each channel, from 0.
    directions : ndarray, (lasers, 3)
        Mean direction of the beams of each.
    """

    names: tuple[str, ...]
    prior_sd: Array
    values: Array
    covariance: Array
    across: Mapping[str, Array]
    of_channel: tuple[NDArray[np.intp], ...]
    directions: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def sd(self) -> Array:
        """Standard deviation (p,) after the data."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def p_value(self) -> float:
        """Probability of an estimate so far from 0, each kind of error against the mean of all lasers.

        If the priors hold, the estimate has the covariance prior - posterior.
        """
        from scipy.special import chdtrc

        count = len(self.directions)
        mean_free = np.kron(np.eye(len(self.values) // count), np.eye(count) - 1.0 / count)
        gained, vectors = np.linalg.eigh(
            mean_free - mean_free @ (self.covariance / np.outer(self.prior_sd, self.prior_sd)) @ mean_free
        )
        seen = gained > _LEAST_GAINED
        along = vectors.T @ (self.values / self.prior_sd)
        chi2 = float(np.sum(along[seen] ** 2 / gained[seen]))
        return float(chdtrc(int(np.sum(seen)), chi2)) if seen.any() else 1.0

    def rows(self) -> list[tuple[str, float, float, float, str]]:
        """Return name, estimate, sd, stated sd and unit of every parameter, in shown units."""
        found = []
        for name, *sizes in zip(self.names, self.values, self.sd, self.prior_sd, strict=True):
            kind, _, number = name.partition(".")
            what, factor, unit = SHOWN[kind]
            beams = direction_name(self.directions[int(number) - 1])
            value, sd, stated = (factor * float(size) for size in sizes)
            found.append((f"{what} of laser {number} ({beams})", value, sd, stated, unit))
        return found

    def notices(self) -> list[Notice]:
        """Return the warning that the lasers disagree by more than was stated."""
        if self.p_value > _UNLIKELY:
            return []
        worst = int(np.argmax(np.abs(self.values) / self.prior_sd))
        name, value, sd, stated, unit = self.rows()[worst]
        text = (
            f"the lasers disagree by more than stated: most the {name}, by {value:+.3g} +- {sd:.2g} {unit} "
            f"(stated sd {stated:.2g} {unit}). The motion is corrected by what the beams say together; "
            "calibrate the lasers, or state --gain-sd, --phase-sd, --delay-sd."
        )
        return [Notice("lasers_disagree", text)]


def laser_agreement(
    placed: Measurement, diagnoses: Mapping[int, Diagnosis], prior_sd: Mapping[str, float]
) -> LaserAgreement | None:
    """Estimate gain, phase and delay of every laser from all bodies together, without channels at fault.

    Parameters
    ----------
    diagnoses : mapping of int to Diagnosis
        By body.
    prior_sd : mapping of str to float
        By the names of `KINDS`: 1, rad and s; those that are exact are left out.

    Returns
    -------
    LaserAgreement or None
        None for one laser, or where all agree exactly.
    """
    of_channel, directions = lasers_of(placed)
    kinds = {kind: prior_sd[kind] for kind in KINDS if prior_sd.get(kind, 0.0) > 0.0}
    if len(directions) < 2 or not kinds:
        return None
    count = len(directions)
    names = tuple(f"{kind}.{number + 1}" for kind in kinds for number in range(count))
    prior = np.repeat(list(kinds.values()), count)
    sound = {number: found for number, found in diagnoses.items() if not _bends(found)}
    if not sound:
        return LaserAgreement(
            names, prior, np.zeros(len(prior)), np.diag(prior**2), {}, of_channel, directions
        )
    packs = [_sound_values(found) for found in sound.values()]
    packed = merged(packs)
    mean_hz = float(np.mean(next(iter(sound.values())).last.readings.freq_hz))
    unit = {"laser_gain": 1.0, "laser_phase": 1.0, "laser_delay": 2.0 * np.pi * mean_hz}
    laser = np.concatenate([of_channel[number] for number in sound])
    scale = np.repeat([unit[kind] for kind in kinds], count)
    entries = [
        (np.flatnonzero(laser == number).tolist(), KINDS[kind], sd * unit[kind])
        for kind, sd in kinds.items()
        for number in range(count)
    ]
    positions, labels = _position_entries(placed, list(sound))
    parameters = Parameters.of(len(laser), entries + positions)
    found = joint(packed, parameters)
    size = len(names)
    covariance = found.covariance[:size, :size] / np.outer(scale, scale)
    across = found.covariance[:size, size:] / scale[:, None]
    return LaserAgreement(
        names,
        prior,
        found.values[:size] / scale,
        covariance,
        dict(zip(labels, across.T, strict=True)),
        of_channel,
        directions,
    )


def lasers_of(placed: Measurement) -> tuple[tuple[NDArray[np.intp], ...], Array]:
    """Return the laser of each channel by body, from 0, and the mean directions (lasers, 3)."""
    directions = np.concatenate([body.directions for body in placed.bodies])
    laser = laser_numbers(directions)
    ends = np.cumsum([len(body.points) for body in placed.bodies])[:-1]
    mean = np.array([directions[laser == number].mean(axis=0) for number in range(int(laser.max()) + 1)])
    return tuple(np.split(laser, ends)), mean / np.linalg.norm(mean, axis=1)[:, None]


def _bends(found: Diagnosis) -> bool:
    return bool(found.causes) or any(finding.kind == "flexible" for finding in found.findings)


def _sound_values(found: Diagnosis) -> Packed:
    """Return the values of a body without channels at fault; faults of whole lasers are left in."""
    readings = found.last.readings
    geometry = readings.geometry.with_factor(np.ones((1, len(readings.noise_factor)), dtype=complex))
    level = float(np.sqrt(found.last.noise.level))
    packed = pack(replace(readings, geometry=geometry))
    return packed.scaled(np.full(len(packed.y), level))


def _position_entries(
    placed: Measurement, bodies: Sequence[int]
) -> tuple[list[tuple[list[int], int, float]], list[str]]:
    """Return the stated errors of positions as parameters of the merged channels, with their names."""
    entries: list[tuple[list[int], int, float]] = []
    labels = []
    start = 0
    for number in bodies:
        body = placed.bodies[number]
        for point in dict.fromkeys(body.points):
            own = body.channels_of(point)
            sd = float(body.position_sd_m[own[0]])
            if sd > 0.0:
                entries += [([start + channel for channel in own], shift, sd) for shift in SHIFT]
                labels += [f"position.{body.body}.{point}.{axis}" for axis in "xyz"]
        start += len(body.points)
    return entries, labels


def merged(packs: Sequence[Packed]) -> Packed:
    """Return the values of several bodies as those of one, so that parameters may belong to all of them.

    Every group of lines keeps its own motion, which only the channels of its own body see.
    """
    channels = [packed.w.shape[1] for packed in packs]
    starts = np.concatenate([[0], np.cumsum(channels)])
    groups = sum(len(packed.y) for packed in packs)
    y = np.zeros((groups, starts[-1], max(packed.y.shape[2] for packed in packs)), dtype=complex)
    w = np.zeros(y.shape[:2])
    first = 0
    for start, packed in zip(starts, packs, strict=False):
        own = slice(first, first + len(packed.y)), slice(start, start + packed.w.shape[1])
        y[(*own, slice(packed.y.shape[2]))], w[own] = packed.y, packed.w
        first += len(packed.y)
    geometry = Geometry(
        np.concatenate([packed.geometry.positions_m for packed in packs]),
        np.concatenate([packed.geometry.directions for packed in packs]),
        np.ones((1, starts[-1]), dtype=complex),
    )
    return Packed(
        y,
        w,
        np.concatenate([packed.columns for packed in packs]),
        np.concatenate([packed.tau for packed in packs]),
        np.concatenate([packed.rho for packed in packs]),
        np.zeros((groups, starts[-1], 0), dtype=complex),
        np.zeros(groups, dtype=np.intp),
        geometry,
        np.eye(6),
        np.max([packed.scale for packed in packs], axis=0),
        np.concatenate([packed.live + start for start, packed in zip(starts, packs, strict=False)]),
    )
