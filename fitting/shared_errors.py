"""The errors that all lines of motion and mass share: each of unit variance, as maps of the motion.

A shared error z of unit variance moves the motion of a body by z (i w)^p T y and the mass matrix by z dM.
Maps, unlike derivatives at the noisy motion, can be applied to the fitted motion: with derivatives of the
noisy motion an estimate is overconfident (7.5 % of entries outside 95 % intervals instead of 4.6 %).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fitting.mass import FRAME_SOURCE, Inertia, frame_slopes, parameter_changes
from stapeskit.arrays import Array, ComplexArray
from stapeskit.spatial import DOF_NAMES

if TYPE_CHECKING:
    from fitting.data import Data
    from stapeskit.records.motion import RigidMotion, SharedErrors

# Eigenvalues of a correlation matrix below this are combinations without an error.
_NO_ERROR = 1e-9
# A recorded change grows with frequency where that leaves less than this share of what a constant map leaves:
# noise of readings leaves all of it, a delay less than a hundredth.
_GROWS = 0.25


@dataclass(frozen=True)
class Maps:
    """Maps of some of the shared errors, all with one power of the frequency.

    Attributes
    ----------
    power : int
        p of (i w)^p, w scaled.
    errors : ndarray, (j,), int
        Places of the errors.
    values : ndarray, (2, m, m, j), complex
        T of structure and base: [body, to, from, error].
    """

    power: int
    errors: NDArray[np.intp]
    values: ComplexArray


def with_shared_errors(
    data: Data,
    motion: RigidMotion,
    inertia: Inertia,
    bodies: tuple[int, int],
    keeps: list[NDArray[np.bool_]],
    unit: Array,
) -> Data:
    """Add the errors of motion and mass that all lines share, each of unit variance.

    The displacement of the footplate frame is one error of motion and mass: it moves both.
    """
    shared, root, m = motion.shared, np.outer(data.root_mass, data.root_mass), len(data.measured)
    sources, changes, maps = list[str](), [np.zeros((0, m, m))], tuple[Maps, ...]()
    places = [DOF_NAMES.index(name) for name in data.measured]
    if shared is not None and shared.names:
        columns, sources = _unit_errors(shared.covariance, shared.names)
        along = np.zeros((len(shared.names), m, m))
        if inertia.complete:
            slopes = frame_slopes(inertia.matrix)[:, places][:, :, places]
            for place, name in enumerate(shared.names):
                source, _, axis = name.partition(".")
                if source == "footplate_frame" and axis in DOF_NAMES:
                    along[place] = slopes[DOF_NAMES.index(axis)]
        changes.append(np.tensordot(columns, along, 1) / root)
        maps = _recorded_maps(data, shared, columns, bodies, unit) or _regressed_maps(
            data, _derivatives(shared, columns, bodies, keeps) * unit
        )
    if inertia.complete:
        joined = any(name.startswith("footplate_frame.") for name in (shared.names if shared else ()))
        parts = {
            key: part for key, part in inertia.contributions.items() if key != FRAME_SOURCE or not joined
        }
        for source, part in parameter_changes(parts).items():
            changes.append(part[:, places][:, :, places] / root)
            sources += [f"mass.{source}"] * len(part)
    return replace(data, mass_changes=np.concatenate(changes), maps=maps, sources=tuple(sources))


def _unit_errors(covariance: Array, names: Sequence[str]) -> tuple[Array, list[str]]:
    """Return rows (k, p) of a root of a covariance, by blocks of correlated parameters, and their sources."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(size > 0.0, size, 1.0)
    correlation = covariance / np.outer(safe, safe)
    _, block = connected_components(csr_matrix(np.abs(correlation) > _NO_ERROR), directed=False)
    rows, sources = [np.zeros((0, len(size)))], []
    for number in dict.fromkeys(block[size > 0.0].tolist()):
        members = np.flatnonzero(block == number)
        values, vectors = np.linalg.eigh(correlation[np.ix_(members, members)])
        for value, direction in zip(values, vectors.T, strict=True):
            if value > _NO_ERROR:
                row = np.zeros(len(size))
                row[members] = size[members] * direction * np.sqrt(value)
                rows.append(row[None])
                sources.append(names[members[int(np.argmax(np.abs(direction)))]].partition(".")[0])
    return np.concatenate(rows), sources


def _derivatives(
    shared: SharedErrors, columns: Array, bodies: tuple[int, int], keeps: list[NDArray[np.bool_]]
) -> ComplexArray:
    """Return the changes (k, lines, 2 m) of the motion by errors of unit variance, SI."""
    recorded = np.asarray(shared.derivatives)
    parts = []
    for run, keep in enumerate(keeps):
        both = np.concatenate([recorded[:, run, body] for body in bodies], axis=-1)
        parts.append(both[:, keep])
    return np.tensordot(columns, np.nan_to_num(np.concatenate(parts, axis=1)), 1)


def _recorded_maps(
    data: Data, shared: SharedErrors, columns: Array, bodies: tuple[int, int], unit: Array
) -> tuple[Maps, ...]:
    """Return the maps that were recorded with the motion, for errors of unit variance; none: empty."""
    recorded, powers = shared.maps, shared.powers
    if recorded is None or powers is None or not np.all(np.isfinite(recorded)):
        return ()
    places = [DOF_NAMES.index(name) for name in data.measured]
    if np.shape(recorded)[-1] == len(data.measured):
        places = list(range(len(data.measured)))
    whole = np.asarray(recorded)[:, bodies][:, :, places][..., places]
    m = len(places)
    scale = unit[:m, None] / unit[None, :m]
    found = []
    for power in sorted({int(value) for value in powers}):
        own = np.asarray(powers) == power
        values = np.tensordot(columns[:, own], whole[own], 1) * scale * data.reference**power
        used = np.flatnonzero(np.any(values != 0.0, axis=(1, 2, 3)))
        if len(used):
            found.append(Maps(power, used, np.moveaxis(values[used], 0, 3).astype(complex)))
    return tuple(found)


def _regressed_maps(data: Data, changes: ComplexArray) -> tuple[Maps, ...]:
    """Find the maps that make recorded changes (k, lines, 2 m) of the motion.

    Most are constant; those as of a delay grow with the frequency, and are found by a constant map and one
    times i w together: a constant map alone would be laid on columns of the motion that are nothing but
    noise.
    """
    k, lines, m = len(changes), data.count, len(data.measured)
    growth = 1j * data.omega
    constant, growing = np.zeros((2, m, m, k), dtype=complex), np.zeros((2, 2, m, m, k), dtype=complex)
    left = np.zeros((2, k))
    for body in (0, 1):
        place = slice(body * m, (body + 1) * m)
        y, wanted = data.y[:, place], np.moveaxis(changes[:, :, place], 0, 2).reshape(lines, -1)
        both = np.concatenate([y, y * growth[:, None]], axis=1)
        for number, columns in enumerate((y, both)):
            size = np.sqrt(np.mean(np.abs(columns) ** 2, axis=0))
            size = np.where(size > 0.0, size, 1.0)
            found = np.linalg.lstsq(columns / size, wanted, rcond=1e-11)[0] / size[:, None]
            left[number] += np.sum(np.abs(wanted - columns @ found) ** 2, axis=0).reshape(m, k).sum(axis=0)
            parts = found.reshape(-1, m, m, k).transpose(0, 2, 1, 3)
            if number:
                growing[:, body] = parts
            else:
                constant[body] = parts[0]
    size = np.sum(np.abs(changes) ** 2, axis=(1, 2))
    freed = max(lines - 2 * m, 1) / max(lines - m, 1)
    grows = (lines > 2 * m) & (left[1] < _GROWS * freed * left[0]) & (left[0] > 1e-12 * size)
    constant = np.where(grows, growing[0], constant)
    maps: tuple[Maps, ...] = (Maps(0, np.arange(k), constant),)
    if np.any(grows):
        maps += (Maps(1, np.flatnonzero(grows), growing[1][..., grows]),)
    return maps if k else ()
