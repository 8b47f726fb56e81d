"""Frequency responses by local polynomials: random, burst or swept excitation without windows and leakage.

Sources: Pintelon, Schoukens, Vandersteen and Barbe 2010, Mech. Syst. Signal Process. 24:573,
doi:10.1016/j.ymssp.2009.08.009; Pintelon and Schoukens, System Identification, 2nd ed. 2012, ch. 7.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.signals.frf import Records, checked_records
from legacy.kinematics.signals.frf_noise import Frf, common_notice, smoothed, split_noise, steady_common
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

# Degree of the polynomials (Pintelon et al. 2010 take 2).
_ORDER = 2
# Degrees of freedom for the noise of a line at the least, and to how many neighbours are gathered.
_LEAST_FREEDOM, _STEADY_DOF = 4, 60
# Share of the largest power of the reference from which a line counts as driven: a thousandth in amplitude,
# which is what leaks of a record without a window at the least.
_DRIVEN = 1e-6
# Numbers that are held at once.
_HELD = 2_000_000


@dataclass(frozen=True)
class Local:
    """How local polynomials are fitted.

    Attributes
    ----------
    resolution_hz : float
        Spacing of the lines: each is fitted to the lines of the whole record that lie as near to it.

    Raises
    ------
    KinematicsError
        It is not positive.
    """

    resolution_hz: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.resolution_hz) and self.resolution_hz > 0.0):
            raise KinematicsError.of("the resolution", "positive, in Hz", self.resolution_hz)


def local_frf(records: Records, sample_rate_hz: float, how: Local, where: str = "") -> Frf:
    """Estimate frequency responses and the noise from the lines of whole records.

    Parameters
    ----------
    records : sequence of (ndarray (sample,), ndarray (channel, sample))
        Reference and responses of every record, of the length of the shortest.
    where : str
        Place for messages.

    Raises
    ------
    KinematicsError
        Signals that are not finite, a reference without signal, or a resolution too fine for the records.

    Notes
    -----
    A record that does not begin and end at rest has the spectrum Y = H X + T, where T, made by the vibration
    before and after it, runs as smoothly over frequency as H; a window makes noise and a bias of it. In each
    block of lines with offsets r, H and the T of every record are polynomials of second degree, found by
    least squares:

        Y(r) = (h0 + h1 r + h2 r^2) X(r) + t0 + t1 r + t2 r^2 + V(r).

    H at the middle of the block is h0, E|dH|^2 = |V|^2 [(A^H A)^-1]_00 with A the regressors and |V|^2 the
    mean residual per degree of freedom. Blocks do not overlap, so that the noise of lines is independent. The
    price is the curvature: sd are larger by 1.5 than of a mean over the block, by 2.1 than those of segments
    with a window, whose lines are not independent.
    """
    checked = checked_records(records, sample_rate_hz, where)
    samples = min(len(x) for x, _ in checked)
    width = max(1, round(how.resolution_hz * samples / sample_rate_hz))
    unknown = (_ORDER + 1) * (1 + len(checked))
    freedom = width * len(checked) - unknown
    lines = (samples + 1) // 2 - 1
    if freedom < _LEAST_FREEDOM or lines < width:
        least = -(-(unknown + _LEAST_FREEDOM) // len(checked)) * sample_rate_hz / samples
        step = (
            f"Ask for a coarser {named('resolution')} (fewer {named('averages')} ask for a finer one) "
            "or record longer"
        )
        want = f"{least:.3g} Hz at least for records of {samples / sample_rate_hz:.3g} s"
        raise KinematicsError.of("the resolution", want, f"{how.resolution_hz:.3g} Hz", where, step)
    count = lines // width
    x = np.stack([_lines(signal, samples, width, count) for signal, _ in checked], axis=1)
    y = np.stack([_lines(many, samples, width, count) for _, many in checked], axis=2)
    freq = (1.0 + np.arange(count) * width + 0.5 * (width - 1)) * sample_rate_hz / samples
    power = np.mean(np.abs(x) ** 2, axis=(1, 2))
    if np.any(power == 0.0):
        step = "Restrict the band to where the reference has power"
        raise KinematicsError.of("the reference", "of some power at every line", 0, where, step)
    value, residual, lever = _fit(x, y)
    rows = residual.reshape(len(value), count, -1)
    raw = np.sum(np.abs(rows) ** 2, axis=2) / freedom
    own, common = split_noise(
        lambda: (rows[:, :, k] for k in range(rows.shape[2])), raw, value, float(freedom)
    )
    steady = -(-_STEADY_DOF // freedom)
    own, raw = smoothed(own, steady, freedom), smoothed(raw, steady)
    common_sd = np.sqrt(0.5 * lever * steady_common(common, steady))
    size = np.abs(value) ** 2 * power
    whole = size + raw
    notices = [*common_notice(common_sd)]
    if freedom < 2 * _LEAST_FREEDOM:
        text = f"{freedom} degrees of freedom are left for the noise of a line: it is rough."
        notices.append(Notice("few_averages", text))
    return Frf(
        freq,
        value,
        np.sqrt(0.5 * own * lever),
        np.where(whole > 0.0, size / np.where(whole > 0.0, whole, 1.0), 0.0),
        _averages(lever, power),
        common_sd,
        np.sqrt(power) * np.sqrt(2.0 * width) / samples,
        tuple(notices),
    )


def _averages(lever: Array, power: Array) -> float:
    """Return how many averages the lines have that the reference drives, one at least.

    ``lever`` (line,) is the variance of a value per variance of a reading, ``power`` that of the reference.
    """
    driven = power > _DRIVEN * np.max(power)
    return max(1.0, float(np.median(1.0 / (lever[driven] * power[driven]))))


def _lines(signal: Array, samples: int, width: int, count: int) -> ComplexArray:
    """Return the lines above 0 Hz in blocks, (..., block, width), their mean and trend taken out."""
    cut = signal[..., :samples]
    ramp = np.linspace(-1.0, 1.0, samples)
    slope = (cut @ ramp) / (ramp @ ramp)
    flat = cut - np.mean(cut, axis=-1, keepdims=True) - np.multiply.outer(slope, ramp)
    spectrum = np.fft.rfft(flat, axis=-1)[..., 1 : 1 + width * count]
    return np.asarray(spectrum.reshape(*signal.shape[:-1], count, width))


def _fit(x: ComplexArray, y: ComplexArray) -> tuple[ComplexArray, ComplexArray, Array]:
    """Fit every block.

    Parameters
    ----------
    x : ndarray, (block, record, width), complex
    y : ndarray, (channel, block, record, width), complex

    Returns
    -------
    value : ndarray, (channel, block), complex
    left : ndarray, (channel, block, record * width), complex
    lever : ndarray, (block,)
        First element of the inverse of the regressors' Gram matrix.
    """
    count, records, width = x.shape
    place = np.linspace(-1.0, 1.0, width)[:, None] ** np.arange(_ORDER + 1)
    size = np.sqrt(np.mean(np.abs(x) ** 2, axis=(1, 2)))
    transient = np.kron(np.eye(records), place)
    value = np.empty(y.shape[:2], dtype=complex)
    residual = np.empty((*y.shape[:2], records * width), dtype=complex)
    lever = np.empty(count)
    step = max(1, _HELD // (records * width * (transient.shape[1] + len(y))))
    for start in range(0, count, step):
        part = slice(start, start + step)
        scaled = (x[part] / size[part, None, None]).reshape(-1, records * width)
        moved = scaled[:, :, None] * np.tile(place, (records, 1))
        fixed = np.broadcast_to(transient, (len(moved), *transient.shape))
        base, upper = np.linalg.qr(np.concatenate([moved, fixed], axis=2))
        data = y[:, part].transpose(1, 2, 3, 0).reshape(len(moved), records * width, -1)
        inside = base.conj().transpose(0, 2, 1) @ data
        inverse = np.linalg.pinv(upper, rcond=1e-10)[:, 0]
        value[:, part] = (np.einsum("bk,bkc->bc", inverse, inside) / size[part, None]).T
        residual[:, part] = (data - base @ inside).transpose(2, 0, 1)
        lever[part] = np.sum(np.abs(inverse) ** 2, axis=1) / size[part] ** 2
    return value, residual, lever
