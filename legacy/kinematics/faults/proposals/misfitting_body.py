"""The body whose misfit is to be explained, and what a cause of it would be of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.faults.estimated_weights import equalise_noise
from legacy.kinematics.faults.nuisance import Marginal, Nuisance, estimate_nuisance
from legacy.kinematics.faults.packed_readings import Packed, Source, initial
from legacy.kinematics.fit.beams import BeamSet
from legacy.kinematics.fit.body_noise import fit_with_noise
from legacy.kinematics.fit.neglected_motion import extended_beams
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.spatial import DOF_NAMES


@dataclass(frozen=True)
class MisfittingBody:
    """One body in one run with a misfit on many channels.

    Attributes
    ----------
    beams : BeamSet
        For the fitted degrees of freedom.
    known : bool
        The noise is stated.
    offsets_m : ndarray, (channel, 3), optional
        Most probable errors of positions with a stated sd, by which the fits correct them.
    offset_covariance : ndarray, (channel, 3, 3), optional
        Of what then is unknown of the positions, m^2; that of the stated sd by default.
    size : ndarray, (channel, freq)
        Squares of the residuals over those that most have; NaN where missing. See ``with_far_values``.
    far : ndarray, (channel, freq), bool
        Single values that lie far off the motion.
    """

    placed: Measurement
    run: int
    body: BodyChannels
    beams: BeamSet
    known: bool
    offsets_m: Array | None = None
    offset_covariance: Array | None = None
    size: Array = field(default_factory=lambda: np.zeros((0, 0)))
    far: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))

    @property
    def value(self) -> ComplexArray:
        """Readings (channel, freq), m; NaN where missing."""
        return self.body.displacement[self.run]

    @property
    def freq_hz(self) -> Array:
        """Frequencies (freq,)."""
        return self.placed.freq_hz

    @cached_property
    def whole_beams(self) -> BeamSet:
        """For all degrees of freedom that the beams observe."""
        body = self.body
        if self.offsets_m is not None:
            body = replace(body, positions_mm=body.positions_mm + 1e3 * self.offsets_m)
        return extended_beams(body, self.beams.dof)

    @cached_property
    def plain(self) -> LineFit:
        """The least-squares fit of all observed degrees of freedom."""
        return self._fit("none")

    @cached_property
    def robust(self) -> LineFit:
        """The fit of all observed degrees of freedom that single outliers hardly move."""
        return self._fit("huber")

    @property
    def position_sd_m(self) -> Array:
        """Stated standard deviations of the positions (channel,); zero where there are none."""
        return np.nan_to_num(self.body.position_sd_mm) * 1e-3

    def packed(self, fit: LineFit, known: bool) -> Packed:
        """Return the readings of a fit in few columns, at the positions as given."""
        source = Source.of(fit, self.body, self.freq_hz, known, self.placed.line_spread)
        return initial(source, self.body)

    def settled(self, some: NDArray[np.bool_]) -> MisfittingBody:
        """Return the suspect with the most probable positions by the values that are not ``some``."""
        data = self.packed(self.without(some), self.known)
        nuisance = Nuisance.of(data, self.position_sd_m)
        if not self.known:
            data = equalise_noise(data, nuisance)
        state = estimate_nuisance(data, nuisance).state
        inverse = 0.5 * Marginal(state, nuisance).solved(np.eye(len(nuisance.sd)))
        own = nuisance.owner.T
        covariance = np.where(own[:, :1, None] >= 0, inverse[own[:, :, None], own[:, None, :]], 0.0)
        offsets = state.model.arms_m - data.assumed.arms_m
        return replace(self, offsets_m=offsets, offset_covariance=covariance)

    def position_variance(self, fit: LineFit, lines: NDArray[np.intp]) -> Array:
        """Return the variance of readings (channel, n) by what is unknown of the positions, m^2.

        A shift s of a point changes what a beam d reads by s . (d x omega).
        """
        covariance = self.offset_covariance
        if covariance is None:
            covariance = self.position_sd_m[:, None, None] ** 2 * np.eye(3)
        turn = np.zeros((len(lines), 3), dtype=complex)
        for column, name in enumerate(fit.beams.dof):
            if name in DOF_NAMES[3:]:
                turn[:, DOF_NAMES.index(name) - 3] = np.nan_to_num(fit.q[lines, column])
        slope = np.cross(self.body.directions[:, None], turn[None])
        return np.asarray(np.real(np.einsum("cfi,cij,cfj->cf", slope.conj(), covariance, slope)))

    def without(self, some: NDArray[np.bool_]) -> LineFit:
        """Return the least-squares fit without some values (channel, freq)."""
        body = self.with_value(np.where(some, np.nan, self.value))
        return fit_with_noise(self.placed, self.run, body, self.whole_beams, "none")[0]

    def _fit(self, robust: str) -> LineFit:
        return fit_with_noise(self.placed, self.run, self.body, self.whole_beams, robust)[0]

    def with_value(self, value: ComplexArray) -> BodyChannels:
        """Return the body with other readings (channel, freq) in this run, and the sd of those scaled."""
        if self.body.sd is None:
            return self.body.with_run(self.run, value)
        sd = self.body.sd[self.run].copy()
        for own, before, after in zip(sd, np.abs(self.value), np.abs(value), strict=True):
            both = np.isfinite(before) & np.isfinite(after) & (before > 0.0)
            factor = after[both] / before[both]
            if factor.size and np.ptp(factor) < 1e-9 * factor[0]:
                own *= factor[0]
        return self.body.with_run(self.run, value, sd)


@dataclass(frozen=True)
class Remedy:
    """The change that a cause implies: its channels, the body in this run without it, and its size.

    ``alike``: a body that bends would look alike. ``one_sided``: the other channels could not be at fault
    instead. ``judged``: nothing else was left with the cause, and the body is as it was.
    """

    channels: list[int]
    body: BodyChannels
    size: float
    alike: bool = False
    one_sided: bool = True
    judged: bool = False


# A remedy, and what the sentence says of it.
Cause = tuple[Remedy, Mapping[str, object]]
