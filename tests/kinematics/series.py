"""Time series of the sample study's kind: rigid bodies driven by a known excitation, sampled with noise."""

import numpy as np

from legacy.fitting.examples.paper import PAPER_DAMPING_CORRECTED, PAPER_STIFFNESS
from sample_volumes.vibrometer import base_motion, stapes_motion

MASS = np.diag([3.2e-6, 3.2e-6, 3.2e-6, 5e-12, 4e-12, 5e-12])
RATE_HZ = 16384.0
POINTS_MM = np.array(
    [[-1.2, 0.1, -0.5], [1.3, 0.0, 0.4], [0.2, 1.1, 0.6], [-0.3, 3.0, 0.1], [0.4, 2.1, -0.6]]
)
BEAMS = np.array([[0.342, 0.93969, 0.0], [-0.171, 0.93969, 0.296], [-0.171, 0.93969, -0.296]])
BEAMS = BEAMS / np.linalg.norm(BEAMS, axis=1)[:, None]


def motions(freq_hz):
    """Return the displacement of both bodies, m per volt of the generator, (freq, 6) by name."""
    base = base_motion(freq_hz, "y")
    return {
        "base": base,
        "stapes": stapes_motion(freq_hz, base, MASS, PAPER_STIFFNESS, PAPER_DAMPING_CORRECTED),
    }


def channels():
    """Return (name, body, point, position mm, beam) of every channel."""
    return [
        (f"{body[0]}{point}{'abc'[beam]}", body, str(point), POINTS_MM[point - 1], BEAMS[beam])
        for body in ("stapes", "base")
        for point in range(1, 6)
        for beam in range(3)
    ]


def responses(freq_hz):
    """Return the velocity of every channel along its beam, (channel, freq), m/s per volt."""
    q = motions(freq_hz)
    return np.array(
        [
            2j * np.pi * freq_hz * ((q[body][:, :3] + np.cross(q[body][:, 3:], place * 1e-3)) @ beam)
            for _, body, _, place, beam in channels()
        ]
    )


def table(path, unit="mm/s", reference="V"):
    """Write the channel table."""
    rows = ["channel,role,body,point,dir_x,dir_y,dir_z,unit,x_mm,y_mm,z_mm"]
    for name, body, point, place, beam in channels():
        numbers = ",".join(f"{value:.9g}" for value in beam)
        rows.append(f"{name},response,{body},{point},{numbers},{unit}," + ",".join(map(str, place)))
    if reference:
        rows.append(f"drive,reference,,,,,,{reference},,,")
    path.write_text("\n".join(rows) + "\n")
    return path


def multisine(rng, samples, periods, noise, every=8, low=400.0, high=5000.0):
    """Return lines (freq,), the generator (sample,) in V and velocities (channel, sample) in m/s."""
    lines = np.arange(int(low * samples / RATE_HZ), int(high * samples / RATE_HZ), every)
    freq = lines * RATE_HZ / samples
    phase = rng.uniform(0.0, 2.0 * np.pi, len(lines))
    response = responses(freq)
    spectrum = np.zeros((len(response) + 1, samples // 2 + 1), dtype=complex)
    spectrum[0, lines] = np.exp(1j * phase)
    spectrum[1:, lines] = response * np.exp(1j * phase)
    signal = np.tile(np.fft.irfft(spectrum * samples / 2.0, samples, axis=1), (1, periods))
    loud = noise * np.sqrt(np.mean(signal[1:] ** 2, axis=1))[:, None]
    return freq, signal[0], signal[1:] + loud * rng.standard_normal(signal[1:].shape)


def stepped(rng, freq, seconds, noise, clock=1.0):
    """Return the set frequency, generator and velocities of a stepped sine over the samples."""
    count = int(seconds * RATE_HZ)
    time = np.arange(count) / RATE_HZ
    set_hz, drive, velocity = [], [], []
    for one in freq:
        wave = np.exp(2j * np.pi * one * clock * time + 1j * rng.uniform(0.0, 2.0 * np.pi))
        set_hz.append(np.full(count, one))
        drive.append(wave.real)
        velocity.append(np.real(responses(np.array([one * clock])) * wave))
    made = np.concatenate(velocity, axis=1)
    loud = noise * np.sqrt(np.mean(made**2, axis=1))[:, None]
    return (
        np.concatenate(set_hz),
        np.concatenate(drive),
        made + loud * rng.standard_normal(made.shape),
    )
