"""Errors of gain, phase and delay that all channels of one laser share, with a stated sd."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.faults.packed_readings import Packed
from legacy.kinematics.faults.score_information import DELAY, IMAGINARY, REAL
from legacy.stapeskit.arrays import Array, ComplexArray

# Tangents of the logarithm of a laser's factor.
OF_LASERS = (REAL, IMAGINARY, DELAY)


@dataclass(frozen=True)
class LaserScatter:
    """The lasers of one body, and how well they agree.

    Attributes
    ----------
    of_channel : ndarray, (channel,), int
    gain_sd, phase_sd, delay_sd : float
        Standard deviations of each laser: 1, rad, s.
    """

    of_channel: NDArray[np.intp]
    gain_sd: float
    phase_sd: float
    delay_sd: float

    @property
    def count(self) -> int:
        """Number of lasers."""
        return int(np.max(self.of_channel)) + 1

    def live_channels(self, live: Sequence[int]) -> list[NDArray[np.intp]]:
        """Return the channels in use of each laser."""
        own = np.array(live, dtype=np.intp)
        return [own[self.of_channel[own] == laser] for laser in range(self.count)]

    def undone(self, data: Packed, errors: dict[int, Array]) -> Packed:
        """Return data whose readings are freed of errors (laser,) by their tangent, line by line."""
        logs = np.transpose([errors.get(k, np.zeros(self.count)) for k in OF_LASERS]).tolist()
        beams = self.live_channels(range(len(self.of_channel)))
        factors = tuple((own.tolist(), partial(_factor, log)) for own, log in zip(beams, logs, strict=True))
        whole = np.concatenate(list(errors.values()))
        return data.under(replace(data.assumed, lasers=factors, laser_errors=whole))


def _factor(log: Sequence[float], _tau: Array, ratio: Array) -> ComplexArray:
    """Return the factor of readings with some errors of gain, phase and lag."""
    gain, phase, lag = log
    return np.asarray(np.exp(gain + 1j * (phase - lag * ratio)))
