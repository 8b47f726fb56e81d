"""The noise of every value as its file states it: sd, else coherence and averages, else averages alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kinematics.readers.recording import Recording
from stapeskit.arrays import Array, ComplexArray


def sd_from_coherence(value: ComplexArray, coherence: Array, n_avg: Array | float) -> Array:
    """Return the standard deviation of the real (= imaginary) part of averaged responses, in their unit.

    NaN where the coherence says nothing: at 0, beyond 1, or missing.

    Notes
    -----
    |v| sqrt((1 - g2) / (2 n g2)) with coherence g2 and n averages (Bendat and Piersol 2010, Random Data,
    section 9.2).
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        sd = np.abs(value) * np.sqrt((1.0 - coherence) / (2.0 * n_avg * coherence))
    return np.where(np.isfinite(sd), sd, np.nan)


def with_noise(recording: Recording) -> Recording:
    """Return the recording with the sd that follows from what its file states.

    Coherence without a number of averages and averages alone give an sd up to one factor (``relative``). The
    coherence of a single average is 1 by construction and says nothing.
    Rows of which nothing is known have an sd of NaN; a recording of which nothing is known has none.
    """
    if recording.sd is not None or (recording.coherence is None and recording.n_avg is None):
        return recording
    if recording.coherence is not None and recording.n_avg is not None and not np.any(recording.n_avg > 1.0):
        return recording
    counts = np.ones(recording.value.shape) if recording.n_avg is None else recording.n_avg
    if recording.coherence is None:
        return replace(recording, sd=1.0 / np.sqrt(counts), relative=True)
    sd = sd_from_coherence(recording.value, recording.coherence, counts)
    return replace(recording, sd=sd, relative=recording.n_avg is None)
