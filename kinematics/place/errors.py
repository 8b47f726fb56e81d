"""Errors of lasers, beams and positions that all lines share: what is stated of them, and their estimate.

The redundancy of the beams shows how far the lasers agree, within what is stated of them and of the
positions; with ``--calibrate`` the axes of the beams and the direction of each laser are estimated as well.

Shapes: c channels of all bodies side by side, p errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.search import Diagnosis
from kinematics.joint.estimate import State, joint
from kinematics.joint.expected import LASER_KINDS, ChannelError, body_starts, lasers_of, stated_errors
from kinematics.joint.pack import Packed
from kinematics.joint.tangents import Geometry, Parameters
from kinematics.measurement import Measurement
from stapeskit.arrays import Array
from stapeskit.warnings import Notice

_SHOWN = {
    "laser_gain": ("gain of laser", 100.0, "%"),
    "laser_phase": ("phase of laser", 180.0 / np.pi, "°"),
    "laser_delay": ("delay of laser", 1e6, "µs"),
    "beam": ("beam of laser", 180.0 / np.pi, "°"),
    "axes": ("turn of all beams about", 180.0 / np.pi, "°"),
    "position": ("position", 1e6, "µm"),
}
"""Words for each kind of error, the factor from SI to the unit in which it is shown, and this unit."""

_UNLIKELY = 1e-3  # probability of an estimate below which errors are larger than stated
_LEAST_GAINED = 0.1  # share of the prior variance below which the data say nothing


@dataclass(frozen=True)
class ErrorEstimate:
    """Errors as the redundancy of the beams shows them, the motion at every line left free.

    Attributes
    ----------
    values, covariance : ndarray, (p,) and (p, p)
        1, rad, s and m; after the data.
    beams : tuple of str
        Mean direction of the beams of each laser.
    share_left : float
        Share of the disagreement beyond noise, root mean square, that the estimate leaves.
    """

    errors: tuple[ChannelError, ...]
    values: Array
    covariance: Array
    beams: tuple[str, ...] = ()
    share_left: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each error."""
        return tuple(error.name for error in self.errors)

    @property
    def prior_sd(self) -> Array:
        """Standard deviation (p,) that is stated."""
        return np.array([error.sd for error in self.errors])

    @property
    def sd(self) -> Array:
        """Standard deviation (p,) after the data."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def calibrated(self) -> bool:
        """Whether axes and beams were estimated as well."""
        return any(error.kind == "axes" for error in self.errors)

    @property
    def shown(self) -> ErrorEstimate:
        """All errors of a calibration, else those of the lasers."""
        own = [k for k, error in enumerate(self.errors) if self.calibrated or error.kind in LASER_KINDS]
        errors, spread = tuple(self.errors[k] for k in own), self.covariance[np.ix_(own, own)]
        return replace(self, errors=errors, values=self.values[own], covariance=spread)

    @property
    def p_value(self) -> float:
        """Probability of an estimate so far from 0.

        If what is stated holds, the estimate has the covariance before less that after the data.
        """
        from scipy.special import chdtrc

        scale = np.outer(self.prior_sd, self.prior_sd)
        gained, vectors = np.linalg.eigh(np.eye(len(scale)) - self.covariance / scale)
        seen = gained > _LEAST_GAINED
        along = vectors.T @ (self.values / self.prior_sd)
        return float(chdtrc(seen.sum(), np.sum(along[seen] ** 2 / gained[seen]))) if seen.any() else 1.0

    def rows(self) -> list[tuple[str, float, float, float, str]]:
        """Return words, estimate, sd, stated sd and unit of every error, in shown units."""
        found = []
        for error, *sizes in zip(self.errors, self.values, self.sd, self.prior_sd, strict=True):
            words, factor, unit = _SHOWN[error.kind]
            which = error.name.partition(".")[2]
            beams = f" ({self.beams[int(which.partition('.')[0]) - 1]})" if "laser" in words else ""
            value, sd, stated = (factor * float(size) for size in sizes)
            found.append((f"{words} {which}{beams}", value, sd, stated, unit))
        return found

    def notices(self) -> list[Notice]:
        """Return a warning of errors that go beyond what was stated."""
        shown = self.shown
        if not shown.errors or shown.p_value >= _UNLIKELY:
            return []
        name, value, sd, stated, unit = shown.rows()[int(np.argmax(np.abs(shown.values) / shown.prior_sd))]
        what = "the calibration moves the geometry" if self.calibrated else "the lasers disagree"
        text = (
            f"{what} by more than stated (p {shown.p_value:.1g}): most the {name}, by {value:+.3g} +- "
            f"{sd:.2g} {unit} (stated sd {stated:.2g} {unit}). The motion is corrected by what is stated of "
            f"them: {100.0 * self.share_left:.0f} % of the disagreement is left. Check beams, positions and "
            "channels with a verdict, or state larger errors: --gain-sd, sd_mm."
        )
        return [Notice("stated_errors_exceeded", text)]


def agreement(
    placed: Measurement,
    diagnoses: Mapping[int, Diagnosis],
    laser_sd: Mapping[str, float],
    calibrate: bool = False,
    corrected: bool = False,
) -> ErrorEstimate | None:
    """Estimate the stated errors from values without channels at fault; None where nothing is stated.

    Faults of whole lasers are left in, unless the motion is corrected for them. Bodies that bend say nothing,
    except to calibrate: a wrong geometry looks like bending. Positions alone remain as stated.

    ``corrected`` says whether the measurement holds what was found corrected.
    """
    errors = stated_errors(placed.bodies, laser_sd, calibrate)
    alone = all(error.kind == "position" for error in errors)
    packs = {}
    for number, found in diagnoses.items() if not alone else ():
        bends = any(cause.last is None for cause in found.causes)
        bends |= any(finding.kind == "flexible" for finding in found.findings)
        if calibrate or not bends:
            packed = found.last.packed  # over the noise as it was found; factors are taken as 1
            if corrected:
                size = np.abs(packed.geometry.factor)
                y = packed.y * (packed.geometry.factor.conj() / size)[:, :, None]
                packed = replace(packed, y=y, w=packed.w * size)
            packs[number] = packed.scaled(np.full(len(packed.y), np.sqrt(found.last.noise.level)))
    return estimate_errors(placed, errors, packs) if errors else None


def estimate_errors(
    placed: Measurement, errors: Sequence[ChannelError], packs: Mapping[int, Packed]
) -> ErrorEstimate:
    """Estimate errors together with the motion of all bodies, within what is stated of them.

    ``packs`` are values by body; bodies that are missing say nothing.

    Notes
    -----
    Maximum a posteriori by `kinematics.joint`, the motion projected out. Where the noise is small against the
    motion, the information that the noise of the estimated motion itself adds is negligible.
    """
    stated = np.array([error.sd for error in errors])
    beams = lasers_of(placed.bodies)[1]
    if not packs:
        return ErrorEstimate(tuple(errors), 0.0 * stated, np.diag(stated**2), beams)
    packed = _side_by_side(placed, packs)
    found = joint(packed, parameters_of(placed, errors))
    before, after = (max(one.energy - one.freedom, 0.0) for one in (State(packed), found.state))
    left = float(np.sqrt(after / before)) if before > 0.0 else 0.0
    return ErrorEstimate(tuple(errors), found.values, found.covariance, beams, left)


def parameters_of(placed: Measurement, errors: Sequence[ChannelError]) -> Parameters:
    """Return the parameters (p,) of errors out of the channels of all bodies."""
    entries = [(one.channels, one.tangent, one.sd) for one in errors]
    return Parameters.of(body_starts(placed.bodies)[-1], entries)


def with_errors(placed: Measurement, found: ErrorEstimate) -> Measurement:
    """Return the measurement with positions, directions and values as an estimate makes them."""
    parameters = parameters_of(placed, found.errors)
    omega = 2.0 * np.pi * placed.freq_hz
    bodies = []
    for start, body in zip(body_starts(placed.bodies), placed.bodies, strict=False):
        count = len(body.points)
        own = replace(parameters, mask=parameters.mask[:, start : start + count])
        as_given = Geometry(body.arms_m, body.directions, np.ones((1, count), dtype=complex))
        moved = as_given.moved(own, found.values, np.zeros(len(omega)), omega)
        factor = moved.factor.T
        changed = replace(
            body,
            positions_m=moved.positions_m,
            directions=moved.directions,
            value=body.value / factor,
            sd=None if body.sd is None else body.sd / np.abs(factor),
        )
        bodies.append(changed)
    return replace(placed, bodies=tuple(bodies))


def _side_by_side(placed: Measurement, packs: Mapping[int, Packed]) -> Packed:
    """Return the values of several bodies as those of one, so that parameters may belong to all of them.

    Every group of lines keeps its own motion, which only the channels of its own body see.
    """
    starts = body_starts(placed.bodies)
    groups = sum(len(packed.y) for packed in packs.values())
    y = np.zeros((groups, starts[-1], max(packed.y.shape[2] for packed in packs.values())), dtype=complex)
    w = np.zeros(y.shape[:2])
    geometry = Geometry(
        np.concatenate([body.arms_m - body.arms_m.mean(axis=0) for body in placed.bodies]),
        np.concatenate([body.directions for body in placed.bodies]),
        np.ones((1, starts[-1]), dtype=complex),
    )
    first = 0
    for number, packed in packs.items():
        own = slice(first, first + len(packed.y)), slice(starts[number], starts[number + 1])
        y[(*own, slice(packed.y.shape[2]))], w[own] = packed.y, packed.w
        geometry.positions_m[own[1]] = packed.geometry.positions_m
        geometry.directions[own[1]] = packed.geometry.directions
        first += len(packed.y)

    def joined(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(packed, name) for packed in packs.values()])

    nothing = np.zeros((groups, starts[-1], 0), dtype=complex), np.zeros(groups, dtype=np.intp)
    scale = np.max([packed.scale for packed in packs.values()], axis=0)
    live = [starts[number] + packed.live for number, packed in packs.items()]
    return Packed(
        y, w, joined("columns"), joined("tau"), joined("omega"), *nothing, geometry, np.eye(6), scale,
        np.concatenate(live),
    )  # fmt: skip
