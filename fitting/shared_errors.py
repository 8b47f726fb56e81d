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
from fitting.mass import Inertia
from stapeskit.arrays import Array, ComplexArray
from stapeskit.records.mass_matrix import FRAME_SOURCE, frame_derivative
from stapeskit.spatial import DOF_NAMES, dof_indices, matrix_from_parameters, parameters_from_matrix

if TYPE_CHECKING:
    from fitting.data import Data
    from stapeskit.records.motion_file import RigidMotion, SharedErrors

# A recorded change grows with frequency where that leaves less than this share of what a constant map leaves:
# noise of readings leaves all of it, a delay less than a hundredth.
_GROWS = 0.25


@dataclass(frozen=True)
class Maps:
    """Maps of some of the shared errors, all with one power of the frequency."""

    power: int  # p of (i w)^p, w scaled
    errors: NDArray[np.intp]  # (j,): places of the errors
    values: ComplexArray  # (2, m, m, j) complex: T of structure and base: [body, to, from, error]
    run: int | None = None  # of the one run that they hold for; None: for all


def with_shared_errors(
    data: Data, motion: RigidMotion, inertia: Inertia, bodies: tuple[int, int], keep: NDArray[np.bool_]
) -> Data:
    """Add the errors of motion and mass that all lines share, each of unit variance.

    The displacement of the footplate frame is one error of motion and mass: it moves both. ``keep`` (runs,
    freq) are the lines of the motion that are in the data.
    """
    shared, sources, maps = motion.shared, list[str](), tuple[Maps, ...]()
    names = () if shared is None else shared.names
    changes = [np.zeros((0, 6, 6))]
    if shared is not None and names:
        columns, sources = _independent(shared)
        changes.append(np.tensordot(columns, _mass_changes(inertia, names), 1))
        maps = _maps(data, shared, columns, list(bodies), keep)
    joined = any(name.startswith("footplate_frame.") for name in names)
    for source, part in (inertia.contributions if inertia.complete else {}).items():
        errors = unit_errors(np.asarray(part))
        if len(errors) and not (joined and source == FRAME_SOURCE):
            changes.append(np.stack([matrix_from_parameters(error) for error in errors]))
            sources += [f"mass.{source}"] * len(errors)
    measured, root = dof_indices(data.measured), np.outer(data.root_mass, data.root_mass)
    scaled = np.concatenate(changes)[:, measured][:, :, measured] / root
    return replace(data, mass_changes=scaled, maps=maps, sources=tuple(sources))


def _mass_changes(inertia: Inertia, names: Sequence[str]) -> Array:
    """Return the changes (p, 6, 6) of the mass matrix by errors of the motion: those of the frame."""
    changes = np.zeros((len(names), 6, 6))
    slopes = frame_derivative(parameters_from_matrix(inertia.matrix)).T if inertia.complete else ()
    by_name = {f"footplate_frame.{axis}": slope for axis, slope in zip(DOF_NAMES, slopes, strict=False)}
    for place, name in enumerate(names):
        if name in by_name:
            changes[place] = matrix_from_parameters(by_name[name])
    return changes


def _independent(shared: SharedErrors) -> tuple[Array, list[str]]:
    """Return rows (k, p) of a root of a covariance, by blocks of correlated parameters, and their sources."""
    size = np.sqrt(np.maximum(np.diag(shared.covariance), 0.0))
    linked = (shared.covariance != 0.0) | np.eye(len(size), dtype=bool)
    for _ in range(len(size).bit_length()):  # by steps of one, two, four ... to all of a block
        linked = linked.astype(float) @ linked > 0.0
    block = np.argmax(linked, axis=1)  # its first member
    rows, sources = [np.zeros((0, len(size)))], []
    for number in dict.fromkeys(block[size > 0.0].tolist()):
        members = np.flatnonzero(block == number)
        own = unit_errors(shared.covariance[np.ix_(members, members)])
        rows.append(np.zeros((len(own), len(size))))
        rows[-1][:, members] = own
        largest = np.argmax(np.abs(own / np.where(size[members] > 0.0, size[members], np.inf)), axis=1)
        sources += [shared.names[member].partition(".")[0] for member in members[largest]]
    return np.concatenate(rows), sources


def _maps(
    data: Data, shared: SharedErrors, columns: Array, bodies: list[int], keep: NDArray[np.bool_]
) -> tuple[Maps, ...]:
    """Return the maps of errors of unit variance: as recorded, or found from the recorded changes.

    Not recorded are those that differ between runs: the map of an error of a position depends on the weights
    of the channels, which each excitation has of its own; and those of ratios and of drifts, which no map
    makes exactly.
    """
    found, places = list[Maps](), dof_indices(data.measured)
    recorded = np.zeros(len(shared.names), dtype=bool)
    if shared.maps is not None and shared.powers is not None:
        whole = np.asarray(shared.maps)[:, bodies]
        recorded = np.all(np.isfinite(whole), axis=(1, 2, 3))
        scaled = whole[:, :, places][..., places] * (data.root_mass[:, None] / data.root_mass)
        for power in sorted(set(shared.powers[recorded].tolist())):
            own = recorded & (shared.powers == power)
            values = np.tensordot(columns[:, own], scaled[own], 1) * data.reference**power
            used = np.flatnonzero(np.any(values != 0.0, axis=(1, 2, 3)))
            if len(used):
                found.append(Maps(power, used, np.moveaxis(values[used], 0, 3).astype(complex)))
    if not np.all(recorded):
        both = np.concatenate([shared.derivatives[:, :, body] for body in bodies], axis=-1)[:, keep]
        changes = np.tensordot(columns * ~recorded, np.nan_to_num(both), 1)
        changes *= np.tile(data.root_mass, 2) / data.amplitude
        for run in range(len(data.runs)) if len(data.runs) > 1 else (None,):
            found += _regressed(data, changes, run)
    return tuple(found)


def _regressed(data: Data, changes: ComplexArray, run: int | None) -> list[Maps]:
    """Find the maps that make recorded changes (k, lines, 2 m) of the motion in one run.

    Most are constant; those as of a delay grow with the frequency, and are found by a constant map and one
    times i w together: a constant map alone would be laid on columns of the motion that are nothing but
    noise.
    """
    places, m = data.lines_of(run), len(data.measured)
    errors = np.flatnonzero(np.any(changes, axis=(1, 2)))
    y = data.y[places].reshape(len(places), 2, m).swapaxes(0, 1)
    changed = changes[errors][:, places].reshape(len(errors), len(places), 2, m).transpose(2, 1, 3, 0)
    wanted = changed.reshape(2, len(places), -1)
    values, left = [], []  # values: [body, power, to, from, error]
    for columns in (y, np.concatenate([y, 1j * data.omega[places, None] * y], axis=2)):
        size = np.sqrt(np.mean(np.abs(columns) ** 2, axis=1, keepdims=True))
        size = np.where(size > 0.0, size, 1.0)
        found = np.linalg.pinv(columns / size, rcond=1e-11) @ wanted / size.swapaxes(1, 2)
        rest = np.sum(np.abs(wanted - columns @ found) ** 2, axis=(0, 1))
        left.append(rest.reshape(m, -1).sum(axis=0))
        values.append(found.reshape(2, -1, m, m, len(errors)).swapaxes(2, 3))
    size = np.sum(np.abs(wanted) ** 2, axis=(0, 1)).reshape(m, -1).sum(axis=0)
    freed = max(len(places) - 2 * m, 1) / max(len(places) - m, 1)
    grows = (len(places) > 2 * m) & (left[1] < _GROWS * freed * left[0]) & (left[0] > 1e-12 * size)
    maps = [Maps(0, errors, np.where(grows, values[1][:, 0], values[0][:, 0]), run)] if len(errors) else []
    if np.any(grows):
        maps.append(Maps(1, errors[grows], values[1][:, 1][..., grows], run))
    return maps
