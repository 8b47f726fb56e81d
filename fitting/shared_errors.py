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

from fitting.draws import unit_errors
from fitting.mass import Inertia, parameter_changes
from stapeskit.arrays import Array, ComplexArray
from stapeskit.records.mass_matrix import FRAME_SOURCE, frame_derivative
from stapeskit.spatial import DOF_NAMES, matrix_from_parameters, parameters_from_matrix

if TYPE_CHECKING:
    from fitting.data import Data
    from stapeskit.records.motion import RigidMotion, SharedErrors

# A recorded change grows with frequency where that leaves less than this share of what a constant map leaves:
# noise of readings leaves all of it, a delay less than a hundredth.
_GROWS = 0.25
# Maps of two runs that differ by less than this share are one: rounding leaves less, other weights more.
_ALIKE = 1e-6


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
    run : int or None
        Of the one run that they hold for; None: for all.
    """

    power: int
    errors: NDArray[np.intp]
    values: ComplexArray
    run: int | None = None


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
            own = frame_derivative(parameters_from_matrix(inertia.matrix)).T
            slopes = np.array([matrix_from_parameters(one) for one in own])[:, places][:, :, places]
            for place, name in enumerate(shared.names):
                source, _, axis = name.partition(".")
                if source == "footplate_frame" and axis in DOF_NAMES:
                    along[place] = slopes[DOF_NAMES.index(axis)]
        changes.append(np.tensordot(columns, along, 1) / root)
        recorded = _recorded(shared, bodies)
        maps = _recorded_maps(data, shared, columns * recorded, bodies, unit)
        if not np.all(recorded):
            changes_of = _derivatives(shared, columns * ~recorded, bodies, keeps)
            maps += _regressed_maps(data, changes_of * unit)
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
    _, block = connected_components(csr_matrix(covariance != 0.0), directed=False)
    rows, sources = [np.zeros((0, len(size)))], []
    for number in dict.fromkeys(block[size > 0.0].tolist()):
        members = np.flatnonzero(block == number)
        own = unit_errors(covariance[np.ix_(members, members)])
        rows.append(np.zeros((len(own), len(size))))
        rows[-1][:, members] = own
        largest = np.argmax(np.abs(own / np.where(size[members] > 0.0, size[members], np.inf)), axis=1)
        sources += [names[member].partition(".")[0] for member in members[largest]]
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


def _recorded(shared: SharedErrors, bodies: tuple[int, int]) -> NDArray[np.bool_]:
    """Return which errors (p,) have one map for all runs; where runs differ, the recorded map is NaN."""
    if shared.maps is None or shared.powers is None:
        return np.zeros(len(shared.names), dtype=bool)
    return np.asarray(np.all(np.isfinite(np.asarray(shared.maps)[:, bodies]), axis=(1, 2, 3)))


def _recorded_maps(
    data: Data, shared: SharedErrors, columns: Array, bodies: tuple[int, int], unit: Array
) -> tuple[Maps, ...]:
    """Return the maps that were recorded with the motion, for errors of unit variance."""
    if shared.maps is None or shared.powers is None:
        return ()
    places = [DOF_NAMES.index(name) for name in data.measured]
    whole = np.nan_to_num(np.asarray(shared.maps)[:, bodies][:, :, places][..., places])
    m = len(places)
    scale = unit[:m, None] / unit[None, :m]
    found = []
    for power in sorted({int(value) for value in shared.powers}):
        own = np.asarray(shared.powers) == power
        values = np.tensordot(columns[:, own], whole[own], 1) * scale * data.reference**power
        used = np.flatnonzero(np.any(values != 0.0, axis=(1, 2, 3)))
        if len(used):
            found.append(Maps(power, used, np.moveaxis(values[used], 0, 3).astype(complex)))
    return tuple(found)


def _regressed_maps(data: Data, changes: ComplexArray) -> tuple[Maps, ...]:
    """Find the maps that make recorded changes (k, lines, 2 m) of the motion.

    Errors whose one map does not make them in all runs have a map in each: the map of an error of a position
    depends on the weights of the channels, which each excitation has of its own.
    """
    errors = np.flatnonzero(np.any(changes, axis=(1, 2)))
    if not len(errors):
        return ()
    maps, left = _maps_in(data, changes, errors, None)
    differs = left > _ALIKE**2 * np.sum(np.abs(changes[errors]) ** 2, axis=(1, 2))
    if len(data.runs) == 1 or not np.any(differs):
        return maps
    maps = _maps_in(data, changes, errors[~differs], None)[0] if not np.all(differs) else ()
    for run in range(len(data.runs)):
        maps += _maps_in(data, changes, errors[differs], run)[0]
    return maps


def _maps_in(
    data: Data, changes: ComplexArray, errors: NDArray[np.intp], run: int | None
) -> tuple[tuple[Maps, ...], Array]:
    """Return the maps of some errors in one run or in all, and what they leave of the changes, squared.

    Most are constant; those as of a delay grow with the frequency, and are found by a constant map and one
    times i w together: a constant map alone would be laid on columns of the motion that are nothing but
    noise.
    """
    places = data.lines_of(run)
    k, lines, m = len(errors), len(places), len(data.measured)
    growth, wanted_all = 1j * data.omega[places], changes[errors][:, places]
    constant, growing = np.zeros((2, m, m, k), dtype=complex), np.zeros((2, 2, m, m, k), dtype=complex)
    left = np.zeros((2, k))
    for body in (0, 1):
        own = slice(body * m, (body + 1) * m)
        y, wanted = data.y[places, own], np.moveaxis(wanted_all[:, :, own], 0, 2).reshape(lines, -1)
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
    size = np.sum(np.abs(wanted_all) ** 2, axis=(1, 2))
    freed = max(lines - 2 * m, 1) / max(lines - m, 1)
    grows = (lines > 2 * m) & (left[1] < _GROWS * freed * left[0]) & (left[0] > 1e-12 * size)
    maps: tuple[Maps, ...] = (Maps(0, errors, np.where(grows, growing[0], constant), run),)
    if np.any(grows):
        maps += (Maps(1, errors[grows], growing[1][..., grows], run),)
    return maps, np.where(grows, left[1], left[0])
