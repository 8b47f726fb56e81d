"""Points of a body that were read in another range or unit than its others, or in rms beside peak values."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.causes.misfit_causes import Explanation, MisfittingBody
from kinematics.fit.neglected_motion import extended_beams
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import list_some

# Ratios of rms and peak values, and of the ranges of vibrometers, in steps of 1, 2, 5.
_FACTORS = np.array([2.0**0.5, 2.0, 2.5, 4.0, 5.0, 10.0])
# How far a factor may lie off one of these: errors of positions change it.
_NEAR = 0.04
# Fewer points, or lines at which all are measured, show no two groups.
_LEAST_POINTS, _LEAST_LINES = 4, 2


def ranges(suspect: MisfittingBody) -> Iterator[Explanation]:
    """Yield the points that read a known factor more, or less, than the others.

    Notes
    -----
    Readings v times h, one real factor a point, of which a rigid motion leaves h' S h with
    S = P o Re(V V^H), P the projection onto what no rigid motion makes: the h that leaves least for its
    power is an eigenvector, whatever the size of the factors.
    """
    value, body = suspect.value, suspect.body
    value = value[:, np.all(np.isfinite(value), axis=0)]
    names, owner = np.unique(body.points, return_inverse=True)
    if len(names) < _LEAST_POINTS or value.shape[1] < _LEAST_LINES:
        return
    # The most probable errors of the positions would take the factors for their own.
    basis = extended_beams(body, suspect.beams.dof).basis
    factor = _relative_sizes(value, basis, owner)
    found = _two_groups(factor)
    if found is None:
        return
    ratio, other = found
    number = int(np.sum(other))
    channels = np.flatnonzero(other[owner]).tolist()
    points = list_some([str(name) for name in names[other]])
    text = (
        f"{number} of {len(names)} points read {ratio:.4g} times what the others show ({points}): in another "
        "range or unit, or in rms beside peak values"
    )
    step = "Check the range and the unit of their rows, and correct the values"
    remedied = suspect.value.copy()
    remedied[channels] /= ratio
    put_right = suspect.with_value(remedied)
    # The stated sd was multiplied with the readings, or was not.
    for sd in (put_right.sd, body.sd) if suspect.known else (put_right.sd,):
        one = replace(put_right, sd=sd)
        yield Explanation.of("unit_slip", "gain", channels, (text, step), ratio, one)


def _relative_sizes(value: ComplexArray, basis: Array, owner: NDArray[np.intp]) -> Array:
    """Return how large the readings (channel, line) of each point are, relative to a rigid motion of all."""
    rows = np.linalg.qr(basis)[0]
    left = (np.eye(len(rows)) - rows @ rows.T) * np.real(value @ value.conj().T)
    of_point = (owner == np.arange(owner.max() + 1)[:, None]).astype(float)
    root = 1.0 / np.sqrt(np.maximum(of_point @ np.sum(np.abs(value) ** 2, axis=1), 1e-300))
    vectors = np.linalg.eigh((of_point @ left @ of_point.T) * np.outer(root, root))[1]
    return np.asarray(1.0 / np.where(vectors[:, 0] == 0.0, np.nan, vectors[:, 0] * root))


def _two_groups(size: Array) -> tuple[float, NDArray[np.bool_]] | None:
    """Return the factor of the smaller of two groups, and which points (point,) are in it."""
    if not np.all(np.isfinite(size)) or np.ptp(np.sign(size)) > 0.0:
        return None
    logs = np.sort(np.log(np.abs(size)))
    gap = int(np.argmax(np.diff(logs)))
    low, high = np.median(logs[: gap + 1]), np.median(logs[gap + 1 :])
    nearest = _FACTORS[np.argmin(np.abs(np.log(_FACTORS) - (high - low)))]
    larger = np.log(np.abs(size)) > 0.5 * (low + high)
    spread = np.abs(np.log(np.abs(size)) - np.where(larger, high, low))
    if abs(np.log(nearest) - (high - low)) > _NEAR or np.max(spread) > _NEAR:
        return None
    few = bool(np.sum(larger) <= len(size) / 2)
    return (float(nearest), larger) if few else (float(1.0 / nearest), ~larger)
