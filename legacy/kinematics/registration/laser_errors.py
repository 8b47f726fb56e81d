"""Which beams belong to one laser, and what errors of its gain, phase and delay do to the motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.faults.laser_scatter import LaserScatter
from legacy.kinematics.fit import symmetric_batches
from legacy.kinematics.fit.laser_groups import group_lasers
from legacy.kinematics.fit.line_noise import blocks
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.measurement import Measurement
from legacy.kinematics.registration.laser_estimate import LaserEstimate, laser_estimate
from legacy.kinematics.registration.laser_moments import KINDS
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.faults import Fault, raise_all

Index = NDArray[np.intp]


@dataclass(frozen=True)
class LaserPriors:
    """How well the lasers agree with each other; 0: exactly.

    Attributes
    ----------
    gain_sd_percent, phase_sd_deg, delay_sd_us : float
        Standard deviation of the gain, phase and delay of each laser.

    Raises
    ------
    KinematicsError
        A number is negative, not finite or too large.
    """

    gain_sd_percent: float = 1.0
    phase_sd_deg: float = 0.5
    delay_sd_us: float = 1.0

    def __post_init__(self) -> None:
        limits = {
            "{gain_sd}": (self.gain_sd_percent, 20.0, "percent"),
            "{phase_sd}": (self.phase_sd_deg, 20.0, "degrees"),
            "{delay_sd}": (self.delay_sd_us, 1000.0, "us"),
        }
        raise_all(
            KinematicsError,
            [
                Fault(name, f"from 0 to {most:g} {unit}", f"{value:g}")
                for name, (value, most, unit) in limits.items()
                if not 0.0 <= value <= most
            ],
        )

    def sd_by_kind(self) -> dict[str, float]:
        """Return the standard deviations that are not zero, SI, by the kind of error."""
        sd = (self.gain_sd_percent / 100.0, np.deg2rad(self.phase_sd_deg), self.delay_sd_us * 1e-6)
        return {kind: float(size) for kind, size in zip(KINDS, sd, strict=True) if size > 0.0}


@dataclass(frozen=True)
class LaserErrors:
    """Errors of the lasers as shared parameters, as far as the beams themselves leave them open.

    Attributes
    ----------
    names : tuple of str, (p,)
        ``laser_gain.1`` ..., ``laser_phase.1`` ..., ``laser_delay.1`` ...: a reading is the true value times
        1 + gain, e^(i phase) and e^(-i w delay).
    prior_sd : ndarray, (p,)
        1, rad and s.
    estimate : LaserEstimate
        In the same units.
    derivatives : ndarray, (p, run, body, freq, m), complex
        Change of the motion when a parameter is corrected.
    directions : ndarray, (laser, 3)
        Mean direction of each laser's beams.
    """

    names: tuple[str, ...]
    prior_sd: Array
    estimate: LaserEstimate
    derivatives: ComplexArray
    directions: Array

    @property
    def correction(self) -> ComplexArray:
        """What the estimate adds to the motion, (run, body, freq, m)."""
        return np.asarray(np.tensordot(self.estimate.remaining, self.derivatives, axes=1))

    @property
    def sd(self) -> Array:
        """Standard deviation (p,) after the data."""
        return self.estimate.sd


@dataclass(frozen=True)
class Lasers:
    """The lasers of a measurement, and how well they are known to agree.

    Attributes
    ----------
    prior_sd : mapping of str to float
        By kind of error, SI; positive.
    of_channel : tuple of ndarray
        By body: the laser (from 0) of each channel.
    directions : ndarray, (laser, 3)
        Mean direction of the beams.
    """

    prior_sd: Mapping[str, float]
    of_channel: tuple[Index, ...]
    directions: Array

    @classmethod
    def of(cls, placed: Measurement, priors: LaserPriors) -> Lasers | None:
        """Return the lasers of a measurement; None for one laser, or when all agree exactly."""
        prior_sd = priors.sd_by_kind()
        if not prior_sd:
            return None
        lasers, directions = group_lasers([body.directions for body in placed.bodies])
        return None if len(directions) == 1 else cls(prior_sd, lasers, directions)

    @property
    def count(self) -> int:
        """Number of lasers."""
        return len(self.directions)

    def estimate(
        self,
        placed: Measurement,
        fits: Mapping[tuple[int, int], LineFit],
        left_out: Mapping[tuple[int, int], Sequence[int]] | None = None,
        applied: Array | None = None,
    ) -> LaserEstimate:
        """Return the errors of the lasers that the beams show; see `laser_estimate`."""
        return laser_estimate(
            fits, placed.bodies, self.of_channel, placed.freq_hz, self.prior_sd, left_out, applied
        )

    def scatter(self, body: int) -> LaserScatter:
        """Return the lasers of a body as parameters of the search for faults."""
        gain, phase, delay = (self.prior_sd.get(kind, 0.0) for kind in KINDS)
        return LaserScatter(self.of_channel[body], gain, phase, delay)

    def corrected(self, placed: Measurement, values: Array) -> Measurement:
        """Return a measurement whose readings are freed of some errors (p,) of the lasers."""
        errors = dict(zip(self.prior_sd, values.reshape(-1, self.count), strict=True))
        nothing = np.zeros(self.count)
        gain = 1.0 + errors.get("laser_gain", nothing)
        turn = np.multiply.outer(errors.get("laser_delay", nothing), 2.0 * np.pi * placed.freq_hz)
        factors = np.exp(1j * (turn - errors.get("laser_phase", nothing)[:, None])) / gain[:, None]
        bodies = tuple(
            replace(
                body,
                displacement=body.displacement * factors[lasers],
                sd=None if body.sd is None else body.sd / gain[lasers][:, None],
            )
            for body, lasers in zip(placed.bodies, self.of_channel, strict=True)
        )
        return replace(placed, bodies=bodies)

    def errors(
        self, placed: Measurement, fits: Mapping[tuple[int, int], LineFit], estimate: LaserEstimate
    ) -> LaserErrors:
        """Return the errors of the lasers with their effect on the fitted motion.

        Notes
        -----
        With fixed weights the motion is a sum of what the readings of each laser add to it
        (``laser_parts``). Correcting a relative error e of a laser subtracts e times its part.
        """
        lines = len(placed.freq_hz)
        changes = {
            "laser_gain": np.full(lines, -1.0 + 0.0j),
            "laser_phase": np.full(lines, -1.0j),
            "laser_delay": 2j * np.pi * placed.freq_hz,
        }
        shape = (len(placed.runs), len(placed.bodies), *fits[0, 0].q.shape)
        derivatives = np.zeros((len(self.prior_sd), self.count, *shape), dtype=complex)
        for (run, body), fit in fits.items():
            parts = laser_parts(fit, self.of_channel[body], self.count)
            for place, kind in enumerate(self.prior_sd):
                np.multiply(parts, changes[kind][:, None], out=derivatives[place, :, run, body])
        return LaserErrors(
            tuple(f"{kind}.{number + 1}" for kind in self.prior_sd for number in range(self.count)),
            np.repeat(list(self.prior_sd.values()), self.count),
            estimate,
            derivatives.reshape(-1, *shape),
            self.directions,
        )


def laser_parts(fit: LineFit, lasers: Index, count: int) -> ComplexArray:
    """Return what the readings of each laser add to the motion, (laser, freq, m); their sum is the motion."""
    parts = np.zeros((count, *fit.q.shape), dtype=complex)
    own = np.unique(lasers)
    parts[own[:-1]] = channel_parts(fit, lasers == own[:-1, None])
    parts[own[-1]] = fit.q - np.sum(parts[own[:-1]], axis=0)
    return parts


def channel_parts(fit: LineFit, sets: NDArray[np.bool_]) -> ComplexArray:
    """Return the parts (n, freq, m) of sets of channels (n, channel): (A^T W A)^-1 A^T W y over each."""
    beams, size = fit.beams, fit.beams.basis.shape[1]
    out = np.empty((len(sets), *fit.q.shape), dtype=complex)
    share, line = fit.common or (np.ones(len(beams.basis)), np.ones(fit.value.shape[1]))
    even = fit.common is not None and fit.complete and fit.robust == "none"
    weight = np.where(sets, 0.5 / share**2, 0.0) if even else 1.0 * sets
    rows = (weight[:, None] * beams.basis.T).reshape(len(sets) * size, len(beams.basis))
    for part in blocks(*fit.value.shape):
        value = fit.value[:, part]
        if even:
            value = value / line[part] ** 2
        else:
            weights = fit.at(part)[2]
            value = np.where(weights > 0.0, weights * value, 0.0)
        summed = (rows @ np.ascontiguousarray(value).view(float)).view(complex)
        for number, right in enumerate(summed.reshape(len(sets), size, value.shape[1])):
            solved = symmetric_batches.times(fit.solution.inverse[:, part], right)
            out[number, part] = (beams.to_dof @ solved).T
    out[:, ~np.isfinite(fit.q[:, 0].real)] = np.nan
    return out
