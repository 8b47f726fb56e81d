"""Causes of a misfit on many channels that change whole lasers, lines or points of a body."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.faults.packed_readings import MOST_CHANNELS
from legacy.kinematics.faults.proposals.misfitting_body import Cause, MisfittingBody, Remedy
from legacy.kinematics.fit.laser_groups import laser_channels
from legacy.kinematics.fit.neglected_motion import extended_beams
from legacy.kinematics.fit.rigid_fit import fit_noise
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.faults import list_some

# Share of the misfit that must go.
_MOST = 0.5
# Public grids: 50 Hz in most countries, 60 Hz in the Americas and parts of Asia (IEC 60038).
_MAINS_HZ = (50.0, 60.0)
# How far from a multiple a line may lie: windows and the drift of the mains widen it.
_WIDTHS_HZ = (0.6, 1.5, 3.0, 6.0)
# Probability of a loud line by chance, and of so many of them near multiples.
_LOUD, _CHANCE = 1e-3, 1e-4
# Of the loud lines so many lie near multiples; the lines near multiples are at most this share of all.
_NEAR, _OF_ALL = 0.7, 0.6
_LEAST = 2
_LISTED = 8
# Ratios of rms and peak values, and of the ranges of vibrometers, in steps of 1, 2, 5.
_FACTORS = np.array([2.0**0.5, 2.0, 2.5, 4.0, 5.0, 10.0])
# Fewer points show no two groups. Lines that are compared: they bound the time.
_LEAST_POINTS, _LINES = 4, 200


def conjugated(suspect: MisfittingBody) -> Iterator[Cause]:
    """Yield the laser whose conjugate fits the others best.

    Notes
    -----
    The file holds the conjugate: of velocities, i w times displacements, that turns the sign of
    the displacements too.
    """
    value, fit = suspect.value, suspect.plain
    sign = (-1.0) ** suspect.placed.order
    groups = laser_channels(suspect.body.directions, list(range(len(value))))
    if not 1 < len(groups) <= 8:
        return
    tried = []
    for own in groups:
        turned = value.copy()
        turned[own] = sign * turned[own].conj()
        tried.append((float(np.nansum(fit_noise(fit.beams, turned, fit.noise).chi2)), own, turned))
    misfit, own, turned = min(tried, key=lambda entry: (entry[0], len(entry[1])))
    if misfit > _MOST * float(np.nansum(fit.chi2)):
        return
    name = suspect.body.channel_name(own[0]).split(" ", 1)[1]
    yield Remedy(own, suspect.with_value(turned), 1.0), {"number": len(own), "beam": name}


def mains(suspect: MisfittingBody) -> Iterator[Cause]:
    """Yield lines near multiples of 50 or 60 Hz, when loud lines are mostly these.

    Notes
    -----
    The residuals of a line over those that most have, as chi2 of its degrees of freedom over the median of
    all lines, and the number of loud lines near multiples by the hypergeometric distribution.
    """
    from scipy.special import chdtrc
    from scipy.stats import hypergeom

    freedom, freq = suspect.robust.n_dof, suspect.freq_hz
    free = (freedom > 0) & np.any(np.isfinite(suspect.size), axis=0)
    if np.sum(free) < 5:
        return
    mean = np.nanmean(suspect.size[:, free], axis=0)
    loud = np.zeros(len(freq), dtype=bool)
    loud[free] = chdtrc(freedom[free], freedom[free] * mean / max(float(np.median(mean)), 1e-300)) < _LOUD
    best: tuple[float, float, NDArray[np.bool_]] | None = None
    for base in _MAINS_HZ:
        for width in _WIDTHS_HZ:
            multiple = np.round(freq / base)
            near = (np.abs(freq - base * multiple) <= width) & (multiple >= 1.0)
            both = int(np.sum(near & loud))
            if both < _LEAST or both < _NEAR * np.sum(loud) or np.mean(near) > _OF_ALL:
                continue
            p = float(hypergeom.sf(both - 1, len(freq), int(np.sum(loud)), int(np.sum(near))))
            if p < _CHANCE and (best is None or p < best[0]):
                best = p, base, near
    if best is None:
        return
    _p, base, near = best
    mains_hz = freq[near & loud]
    names = ", ".join(f"{value:.6g}" for value in mains_hz[:_LISTED])
    names += f" and {len(mains_hz) - _LISTED} more" if len(mains_hz) > _LISTED else ""
    ranges = " ".join(f"{value - 1.0:.6g}-{value + 1.0:.6g}" for value in mains_hz[:_LISTED])
    remedied = suspect.with_value(np.where(near[None], np.nan, suspect.value))
    remedy = Remedy(list(range(len(suspect.body.points))), remedied, float(np.mean(near & loud)))
    yield remedy, {"base": base, "lines": names, "ranges": ranges}


def ranges(suspect: MisfittingBody) -> Iterator[Cause]:
    """Yield the points that read a known factor more, or less, than the others.

    Notes
    -----
    Readings v of a line times h, one real factor a point, of which a rigid motion leaves h' S h with
    S = P o Re(v v^H), P the projection onto what no rigid motion makes of the channels that were measured
    there: the h that leaves least for its power over all lines is an eigenvector, whatever the size of the
    factors. Positions count as given: their most probable errors would take the factors for their own.
    """
    body = suspect.body
    live = np.flatnonzero(np.any(np.nan_to_num(suspect.value) != 0.0, axis=1))
    names, owner = np.unique([body.points[channel] for channel in live], return_inverse=True)
    if len(names) < _LEAST_POINTS or len(live) > MOST_CHANNELS:
        return
    basis = extended_beams(body, suspect.beams.dof).basis[live]
    size = _relative_sizes(suspect.value[live], basis, owner)
    for ratio, other in _two_groups(size):
        channels = live[other[owner]].tolist()
        half = 2 * int(np.sum(other)) == len(names)
        words = {
            "others": int(np.sum(other)),
            "number": len(names),
            "ratio": ratio,
            "points": list_some([str(name) for name in names[other]]),
            "which": "; which half is right does not show here" if half else "",
        }
        value = suspect.value.copy()
        value[channels] /= ratio
        put_right = suspect.with_value(value)
        # The stated sd was multiplied with the readings, or was not.
        for sd in (put_right.sd, body.sd) if suspect.known else (put_right.sd,):
            yield Remedy(channels, replace(put_right, sd=sd), ratio, one_sided=not half), words


def _relative_sizes(value: ComplexArray, basis: Array, owner: NDArray[np.intp]) -> Array:
    """Return how large the readings (channel, line) of each point are, relative to a rigid motion of all."""
    measured = np.flatnonzero(np.sum(np.isfinite(value), axis=0) > basis.shape[1])
    if not len(measured):
        return np.full(owner.max() + 1, np.nan)
    value = value[:, measured[np.unique(np.linspace(0, len(measured) - 1, _LINES).astype(int))]]
    left, power = np.zeros((2, owner.max() + 1, owner.max() + 1))
    patterns, same = np.unique(np.isfinite(value), axis=1, return_inverse=True)
    for number, seen in enumerate(patterns.T):
        some = value[np.ix_(seen, same.ravel() == number)]
        products = np.real(some @ some.conj().T)
        rows = np.linalg.qr(basis[seen])[0]
        own = (owner[seen] == np.arange(len(left))[:, None]).astype(float)
        left += own @ ((np.eye(len(rows)) - rows @ rows.T) * products) @ own.T
        power += np.diag(own @ np.diag(products))
    root = 1.0 / np.sqrt(np.maximum(np.diag(power), 1e-300))
    vectors = np.linalg.eigh(left * np.outer(root, root))[1]
    return np.asarray(1.0 / np.where(vectors[:, 0] == 0.0, np.nan, vectors[:, 0] * root))


def _two_groups(size: Array) -> Iterator[tuple[float, NDArray[np.bool_]]]:
    """Yield likely factors of the smaller of two groups, and which points (point,) are in it.

    Where a body moves along one axis alone, a factor that changes over it looks like a rotation: the sizes
    are uncertain then. They must form two groups; what is left decides between the two nearest factors.
    """
    if not np.all(np.isfinite(size)) or np.ptp(np.sign(size)) > 0.0:
        return
    logs = np.sort(np.log(np.abs(size)))
    gap = int(np.argmax(np.diff(logs)))
    low, high = logs[: gap + 1], logs[gap + 1 :]
    if high[0] - low[-1] <= max(np.ptp(low), np.ptp(high)):
        return
    larger = np.log(np.abs(size)) >= high[0]
    few = bool(np.sum(larger) <= len(size) / 2)
    off = np.abs(np.log(_FACTORS) - (np.median(high) - np.median(low)))
    for ratio in _FACTORS[np.argsort(off)[:2]]:
        yield (float(ratio), larger) if few else (float(1.0 / ratio), ~larger)
