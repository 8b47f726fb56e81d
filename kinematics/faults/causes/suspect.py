"""The body whose misfit is to be explained, and an explanation with its remedy."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinematics.fit.beams import BeamSet
from kinematics.fit.body_noise import with_noise
from kinematics.fit.neglected_motion import extended_beams
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import BodyChannels, Measurement

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Suspect:
    """One body in one run with a misfit on many channels.

    Attributes
    ----------
    placed : Measurement
    run : int
    body : BodyChannels
    beams : BeamSet
        For the fitted degrees of freedom.
    known : bool
        The noise is stated.
    """

    placed: Measurement
    run: int
    body: BodyChannels
    beams: BeamSet
    known: bool

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
        return extended_beams(self.body, self.beams.dof)

    @cached_property
    def plain(self) -> LineFit:
        """The least-squares fit of all observed degrees of freedom."""
        return self._fit("none")

    @cached_property
    def robust(self) -> LineFit:
        """The fit of all observed degrees of freedom that single outliers hardly move."""
        return self._fit("huber")

    def without(self, some: NDArray[np.bool_]) -> LineFit:
        """Return the least-squares fit without some values (channel, freq)."""
        body = self.with_value(np.where(some, np.nan, self.value))
        return with_noise(self.placed, self.run, body, self.whole_beams, "none")[0]

    def _fit(self, robust: str) -> LineFit:
        return with_noise(self.placed, self.run, self.body, self.whole_beams, robust)[0]

    def with_value(self, value: ComplexArray) -> BodyChannels:
        """Return the body with other readings (channel, freq) in this run."""
        displacement = self.body.displacement.copy()
        displacement[self.run] = value
        return replace(self.body, displacement=displacement)


@dataclass(frozen=True)
class Explanation:
    """A cause of the misfit.

    Attributes
    ----------
    code : str
        Code of the warning.
    verdict : str
        Of the channels, as in ``dof.channels.csv``.
    channels : list of int
    text : str
        What was found, with its size.
    step : str
        What to do.
    size : float
        Relative size.
    remedied : BodyChannels
        The body without this cause.
    """

    code: str
    verdict: str
    channels: list[int]
    text: str
    step: str
    size: float
    remedied: BodyChannels
