"""The noise of a body's channels from its recordings: sd, or coherence and averages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.readers.recording import Recording
from legacy.kinematics.tidy.few_averages import steady_noise
from legacy.kinematics.tidy.noise_from_coherence import sd_from_coherence
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

Place = tuple[int, int, NDArray[np.intp]]


def body_noise(
    body: str, entries: Sequence[tuple[Place, Recording]], value: NDArray[np.complex128], order: int
) -> tuple[Array | None, bool, list[Notice]]:
    """Return the sd of displacement of one body (run, channel, freq), m, and whether it is relative only.

    Parameters
    ----------
    entries : sequence of (place, Recording)
        Place: run, channel and lines.
    value : ndarray, (run, channel, freq), complex
        Displacement, m.
    order : int
        Time derivatives of the quantity whose noise is level when only numbers of averages are known.
    """
    noises = [_noise(recording, order) for _, recording in entries]
    absolute = any(kind == "absolute" for kind, _ in noises)
    if not absolute and all(kind == "none" for kind, _ in noises):
        return None, True, []
    wanted = "absolute" if absolute else "relative"
    sd = np.full(value.shape, np.nan)
    for ((run, channel, lines), _), (kind, spread) in zip(entries, noises, strict=True):
        if kind == wanted and spread is not None:
            sd[run, channel, lines] = spread
    notices: list[Notice] = []
    if absolute:
        sd, notices = _steady(body, entries, sd)
    missing = int(np.sum(np.isnan(sd) & ~np.isnan(value.real)))
    if missing:
        text = f"{missing} values of body {body} have no standard deviation and were not used."
        notices.append(Notice("sd_missing", text))
    return sd, not absolute, notices


def _noise(recording: Recording, order: int) -> tuple[str, Array | None]:
    """Return ``absolute``, ``relative`` or ``none``, and the sd as displacement, m."""
    rate = (2.0 * np.pi * recording.freq_hz) ** recording.order
    if recording.sd is not None:
        return ("relative" if recording.relative else "absolute"), recording.sd / rate
    if recording.coherence is not None:
        sd = sd_from_coherence(recording.value, recording.coherence, recording.n_avg or 1.0)
        return ("relative" if recording.n_avg is None else "absolute"), sd / rate
    if recording.n_avg is not None:
        return "relative", np.full(len(rate), 1.0 / np.sqrt(recording.n_avg)) / (
            2.0 * np.pi * recording.freq_hz
        ) ** order
    return "none", None


def _steady(body: str, entries: Sequence[tuple[Place, Recording]], sd: Array) -> tuple[Array, list[Notice]]:
    """Smooth sd that were estimated from few averages; those from coherence and those stated separately.

    Estimates from time series, which have an sd and a coherence, are smoothed with those from coherence.
    """
    notices: list[Notice] = []
    for from_coherence in (True, False):
        counts = np.full(sd.shape[:2], np.nan)
        for (run, channel, _), recording in entries:
            if recording.sd is not None and recording.coherence is not None:
                continue
            if recording.n_avg is not None and (recording.sd is None) == from_coherence:
                counts[run, channel] = recording.n_avg
        if np.any(np.isfinite(counts)):
            sd, steady_notices = steady_noise(sd, counts[:, :, None], body, from_coherence=from_coherence)
            notices += steady_notices
    return sd, notices[:1]
