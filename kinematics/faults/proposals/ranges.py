"""Points of a body that were read in another range or unit than its others, or in rms beside peak values."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.packed_readings import MOST_CHANNELS
from kinematics.faults.proposals.misfitting_body import Cause, MisfittingBody, Remedy
from kinematics.fit.neglected_motion import extended_beams
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import list_some

# Ratios of rms and peak values, and of the ranges of vibrometers, in steps of 1, 2, 5.
_FACTORS = np.array([2.0**0.5, 2.0, 2.5, 4.0, 5.0, 10.0])
# Fewer points show no two groups. Lines that are compared: they bound the time.
_LEAST_POINTS, _LINES = 4, 200


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
        words = {
            "others": int(np.sum(other)),
            "number": len(names),
            "ratio": ratio,
            "points": list_some([str(name) for name in names[other]]),
        }
        value = suspect.value.copy()
        value[channels] /= ratio
        put_right = suspect.with_value(value)
        # The stated sd was multiplied with the readings, or was not.
        for sd in (put_right.sd, body.sd) if suspect.known else (put_right.sd,):
            yield Remedy(channels, replace(put_right, sd=sd), ratio), words


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
