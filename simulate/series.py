"""Time series of a recording: what the channels and the generator give sample by sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulate.vibrometer import Recording
from stapeskit.arrays import Array

RATE_HZ = 16384.0


@dataclass(frozen=True, kw_only=True, eq=False)
class TimeSeries:
    """Sampled signals of one run.

    Attributes
    ----------
    rate_hz : float
    freq_hz : ndarray, (L,)
        Excited lines, Hz.
    drive_v : ndarray, (S,)
        Voltage of the generator, to which the recording's velocities per volt refer.
    velocity_m_s : ndarray, (C, S)
        Of the channels of the recording.
    set_hz : ndarray, (S,), or None
        The set frequency of a stepped sine.
    recording : Recording
        Bodies, points, places and directions of the channels.
    """

    rate_hz: float
    freq_hz: Array
    drive_v: Array
    velocity_m_s: Array
    set_hz: Array | None = None
    recording: Recording

    @property
    def names(self) -> list[str]:
        """Names of the channels, as in the channel table."""
        parts = zip(self.recording.body, self.recording.point, self.recording.laser, strict=True)
        return [f"{body[0]}{point}{'abcdefgh'[int(laser)]}" for body, point, laser in parts]


def multisine(
    recording: Recording,
    *,
    samples: int = 4096,
    periods: int = 4,
    noise: float = 0.01,
    run: int = 0,
    seed: int = 1,
) -> TimeSeries:
    """Return periods of a random-phase multisine on lines of the FFT near those of the recording.

    The recording's velocities are taken as per volt of the generator, each line of 1 V; between its lines
    they are interpolated. ``noise``: white, relative to the root mean square of a channel.
    """
    rng = np.random.default_rng([seed, 41])
    wanted = recording.freq_hz / RATE_HZ * samples
    lines = np.unique(np.round(wanted).astype(int))
    lines = lines[(lines >= wanted.min()) & (lines <= wanted.max())]
    freq = lines * RATE_HZ / samples
    phase = np.exp(1j * rng.uniform(0.0, 2.0 * np.pi, len(lines)))
    response = np.array([np.interp(freq, recording.freq_hz, row) for row in recording.velocity_m_s[run]])
    spectrum = np.zeros((len(response) + 1, samples // 2 + 1), dtype=complex)
    spectrum[0, lines] = phase
    spectrum[1:, lines] = response * phase
    signal = np.tile(np.fft.irfft(spectrum * samples / 2.0, samples, axis=1), (1, periods))
    return TimeSeries(
        rate_hz=RATE_HZ,
        freq_hz=freq,
        drive_v=signal[0],
        velocity_m_s=_noisy(signal[1:], noise, rng),
        recording=recording,
    )


def stepped_sine(
    recording: Recording, *, seconds: float = 0.05, noise: float = 0.01, run: int = 0, seed: int = 1
) -> TimeSeries:
    """Return a stepped sine: each line of the recording of 1 V for so many seconds."""
    rng = np.random.default_rng([seed, 43])
    time = np.arange(int(seconds * RATE_HZ)) / RATE_HZ
    set_hz, drive, velocity = [], [], []
    for line, freq in enumerate(recording.freq_hz):
        wave = np.exp(2j * np.pi * freq * time + 1j * rng.uniform(0.0, 2.0 * np.pi))
        set_hz.append(np.full(len(time), freq))
        drive.append(wave.real)
        velocity.append(np.real(recording.velocity_m_s[run, :, line, None] * wave))
    return TimeSeries(
        rate_hz=RATE_HZ,
        freq_hz=recording.freq_hz,
        drive_v=np.concatenate(drive),
        velocity_m_s=_noisy(np.concatenate(velocity, axis=1), noise, rng),
        set_hz=np.concatenate(set_hz),
        recording=recording,
    )


def _noisy(signal: Array, noise: float, rng: np.random.Generator) -> Array:
    level = noise * np.sqrt(np.mean(signal**2, axis=1))[:, None]
    return np.asarray(signal + level * rng.standard_normal(signal.shape))
