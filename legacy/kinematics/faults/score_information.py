"""The rigid fit of packed readings, and the score and information of any change of its rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.faults.packed_readings import RIDGE, Packed, real_parts, whitened
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.frames import cross_matrix
from legacy.stapeskit.spatial import cross

# Tangents of a reading: real and imaginary part of a factor, delay, both parts of a factor that runs with the
# lines, two turns of the beam, three shifts of the point, three turns of all beams.
REAL, IMAGINARY, DELAY, DRIFT, DRIFT_IMAGINARY = range(5)
TURNS, SHIFTS, AXES = (5, 6), (7, 8, 9), (10, 11, 12)
# Beams (n, 3) times these are the products of the unit vectors along x, y, z with them.
_ABOUT = tuple(cross_matrix(axis).T for axis in np.eye(3))
# Numbers that are held at once.
_HELD = 4_000_000


class Model(NamedTuple):
    """Positions (channel, 3), directions (channel, 3) and factors (group, channel) of the readings."""

    arms_m: Array
    directions: Array
    factor: ComplexArray | None = None

    def times(self, channels: Sequence[int], factor: NDArray[Any], groups: int) -> Model:
        """Multiply the readings of channels by a factor (group,)."""
        product = np.ones((groups, len(self.arms_m)), dtype=complex)
        product = product if self.factor is None else self.factor.copy()
        product[:, channels] *= np.broadcast_to(factor, (groups,))[:, None]
        return self._replace(factor=product)


def model_of(data: Packed) -> Model:
    """Return the model that data assume."""
    return Model(data.assumed.arms_m, data.assumed.directions)


def weighted_rows(data: Packed, model: Model, channels: Any = slice(None)) -> NDArray[Any]:
    """Return the rows (group, channel, m) of channels over their noise, before any whitening."""
    rows: NDArray[Any] = data.rows(model.arms_m[channels], model.directions[channels])
    rows = data.weight[:, channels, None] * rows
    return rows if model.factor is None else model.factor[:, channels, None] * rows


def perpendicular_axes(directions: Array) -> Array:
    """Return two unit vectors (..., 2, 3) square to beams (..., 3) and to each other."""
    least = np.eye(3)[np.argmin(np.abs(directions), axis=-1)]
    first = cross(directions, least)
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, cross(directions, first)], axis=-2)


class Sums(NamedTuple):
    """Scores (B, p) and information (B, p, p) of tangents of B sets of channels.

    ``taken`` (B, p, group, m, column) are the projections of the tangents on the motion.
    """

    score: Array
    information: Array
    taken: ComplexArray


@dataclass(frozen=True)
class State:
    """A fit of all columns.

    Attributes
    ----------
    data : Packed
    model : Model
    own : ndarray, (group, channel, m)
        Rows over their noise, before the whitening of channels of one point.
    span : ndarray, (group, channel, m)
        Orthonormal columns of the whitened rows.
    upper : ndarray, (group, m, m)
        From coefficients of ``span`` to the motion.
    z : ndarray, (group, m, column), complex
        Motion in the basis of the beams.
    e : ndarray, (group, channel, column), complex
        Whitened residual.
    """

    data: Packed
    model: Model
    own: NDArray[Any]
    span: NDArray[Any]
    upper: NDArray[Any]
    z: ComplexArray
    e: ComplexArray

    @classmethod
    def of(cls, data: Packed, model: Model | None = None) -> State:
        """Fit the motion under a model."""
        model = model or model_of(data)
        own = weighted_rows(data, model)
        rows = whitened(own, data.whiten)
        upper = np.linalg.inv(_root(rows.conj().swapaxes(1, 2) @ rows)).conj().swapaxes(1, 2)
        span = rows @ upper
        seen = span.conj().swapaxes(1, 2) @ data.y
        return cls(data, model, own, span, upper, upper @ seen, data.y - span @ seen)

    @cached_property
    def both(self) -> ComplexArray:
        """Whitened residual of all columns, (group, channel, n)."""
        return np.concatenate([self.e, self.rest], axis=2)

    @property
    def energy(self) -> float:
        """Sum of |e|^2 over the columns with motion."""
        return float(np.sum(self.e.real**2 + self.e.imag**2))

    @property
    def determined(self) -> bool:
        """Whether the channels determine the motion by no less than a thousandth of what they see most."""
        weakest = np.max(np.linalg.norm(self.upper, 2, axis=(1, 2)))
        return bool(weakest * np.max(np.linalg.norm(self.own, axis=(1, 2))) < 1e3)

    @cached_property
    def rest(self) -> ComplexArray:
        """Whitened residual of the columns without motion, (group, channel, sample)."""
        held = self.data.rest
        return np.asarray(held - self.span @ (self.span.conj().swapaxes(1, 2) @ held))

    @cached_property
    def leverage(self) -> Array:
        """Share (group, channel) of each reading's noise that the fit takes."""
        return np.asarray(np.sum(np.abs(self.plain(self.span)) ** 2, axis=2))

    @cached_property
    def back(self) -> Array:
        """Matrix (channel, channel) from whitened values to those of the channels over their noise."""
        whiten = self.data.whiten
        return np.eye(len(self.data.points)) if whiten is None else np.asarray(np.linalg.inv(whiten))

    def plain(self, white: NDArray[Any]) -> NDArray[Any]:
        """Return whitened values (group, channel, n) as those of the channels over their noise."""
        return white if self.data.whiten is None else np.asarray(self.back @ white)

    @cached_property
    def own_e(self) -> ComplexArray:
        """Residual whose products with changes of the channels' own rows are those of ``e``."""
        whiten = self.data.whiten
        return self.e if whiten is None else np.asarray(whiten.T @ self.e)

    @cached_property
    def own_span(self) -> NDArray[Any]:
        """Columns whose products with changes of the channels' own rows are those of ``span``."""
        whiten = self.data.whiten
        return self.span if whiten is None else np.asarray(whiten.T @ self.span)

    @cached_property
    def norm(self) -> Array | None:
        """Products (channel, channel) of changes of two channels' rows; None for the unit matrix."""
        whiten = self.data.whiten
        return None if whiten is None else np.asarray(whiten.T @ whiten)

    def free(self) -> Array:
        """Return the residual degrees of freedom (group,) of a complex column: whole numbers.

        The sum of leverages is rounded: its last digits depend on the processor, which a comparison with a
        limit must not.
        """
        used = np.sum(self.data.weight > 0.0, axis=1)
        return np.maximum(np.round(used - np.sum(np.abs(self.span) ** 2, axis=(1, 2))), 0.0)

    def tangents(
        self, channels: NDArray[np.intp], which: Sequence[int], beam: Array | None = None
    ) -> ComplexArray:
        """Return derivatives (p, group, n, column) of the readings of channels over their noise.

        Parameters
        ----------
        channels : ndarray, (n,), int
        which : sequence of int, (p,)
            Out of REAL to AXES.
        beam : ndarray, (3,), optional
            The beam that TURNS are square to; each its own by default.
        """
        data, model = self.data, self.model
        read = self.own[:, channels] @ self.z
        tau, ratio = data.tau[:, None, None], data.ratio[:, None, None]
        simple: dict[int, Any] = {REAL: 1.0, IMAGINARY: 1j, DELAY: -1j * ratio}
        simple |= {DRIFT: tau, DRIFT_IMAGINARY: 1j * tau}
        changed = [k for k in which if k >= TURNS[0]]
        tangents = np.empty((len(which), *read.shape), dtype=complex)
        if changed:
            arms, beams = model.arms_m[channels], model.directions[channels]
            weight = data.weight[:, channels]
            factor = None if model.factor is None else model.factor[:, channels]
            size = weight if factor is None else weight * factor
            rows = _turn(data, changed, arms, beams, beam)
            moved = (rows[:, None] @ self.z[None]) * size[None, :, :, None]
        for place, k in enumerate(which):
            tangents[place] = moved[changed.index(k)] if k in changed else read * simple[k]
        return tangents

    def sums(self, groups: NDArray[np.intp], tangents: ComplexArray) -> Sums:
        """Return scores, information and projections of tangents.

        Parameters
        ----------
        groups : ndarray, (B, n), int
        tangents : ndarray, (p, group, B, n, column), complex

        Notes
        -----
        For a change t of the readings the score is Re t^H e, and the information of two of them
        Re t^H P t' with P the projector on the residuals (Rao 1948, doi:10.1017/S0305004100023987).
        """
        count, sets = tangents.shape[0], tangents.shape[2]
        flat = tangents.transpose(2, 0, 1, 3, 4).reshape(sets, count, -1)
        e = self.own_e[:, groups].transpose(1, 0, 2, 3).reshape(sets, -1, 1)
        score = np.real(flat.conj() @ e)[:, :, 0]
        other = flat
        if self.norm is not None:
            inner = self.norm[groups[:, :, None], groups[:, None, :]]
            other = (inner[None, None] @ tangents).transpose(2, 0, 1, 3, 4).reshape(sets, count, -1)
        whole = np.real(flat.conj() @ other.swapaxes(1, 2))
        span = self.own_span[:, groups].conj().transpose(0, 1, 3, 2)
        taken = np.ascontiguousarray((span[None] @ tangents).transpose(2, 0, 1, 3, 4))
        real = real_parts(taken.reshape(sets, count, -1))
        return Sums(score, whole - real @ real.swapaxes(1, 2), taken)

    def chunks(self, groups: NDArray[np.intp], count: int, shared: int = 0) -> list[NDArray[np.intp]]:
        """Split sets of channels (B, n) so that the sums of ``count`` tangents fit into memory.

        ``shared``: number of parameters whose products with the tangents are made, too.
        """
        parts, size, columns = self.z.shape
        each = count * max(parts * columns * max(2 * size, 2 * groups.shape[1]), shared)
        step = max(1, _HELD // max(each, 1))
        return [groups[start : start + step] for start in range(0, len(groups), step)]

    def left_out(self, groups: NDArray[np.intp]) -> Array:
        """Return by how much the energy falls (B,) when sets of channels (B, n) are left out.

        Notes
        -----
        That is e^H (N - S S^H)^-1 e, with e, span S and norm N of the channels; for many channels by matrices
        of the size of the motion (Woodbury's identity).
        """
        falls = [np.zeros(0)]
        for part in self.chunks(groups, groups.shape[1]):
            span, e, whole = self.own_span[:, part], self.own_e[:, part], 0.0
            turned = span.conj().swapaxes(2, 3)
            if self.norm is not None:
                kept = self.norm[part[:, :, None], part[:, None, :]] - span @ turned
            elif part.shape[1] > span.shape[3]:
                kept = np.eye(span.shape[3]) - turned @ span
                e, whole = turned @ e, np.sum(np.abs(e) ** 2, axis=(0, 2, 3))
            else:
                kept = np.eye(part.shape[1]) - span @ turned
            values, vectors = np.linalg.eigh(kept)
            along = np.sum(np.abs(vectors.conj().swapaxes(2, 3) @ e) ** 2, axis=3)
            seen = values > 1e-6
            falls.append(
                whole + np.sum(np.where(seen, along / np.where(seen, values, 1.0), 0.0), axis=(0, 2))
            )
        return np.concatenate(falls)


def energies(data: Packed, base: Model, arms_m: Array, directions: Array) -> Array:
    """Return the residual energy (B,) of a model with other positions and directions (B, channel, 3)."""
    each = data.y.size * (1 + data.size)
    step = max(1, _HELD // max(each, 1))
    found = [np.zeros(0)]
    for start in range(0, len(arms_m), step):
        part = slice(start, start + step)
        rows: NDArray[Any] = data.weight[:, :, None] * data.rows(arms_m[part], directions[part])[:, None]
        rows = rows if base.factor is None else base.factor[:, :, None] * rows
        rows = whitened(rows, data.whiten)
        turned = rows.conj().swapaxes(2, 3)
        root = _root((turned @ rows).reshape(-1, *rows.shape[-1:], rows.shape[-1]))
        upper = np.linalg.inv(root).conj().swapaxes(1, 2).reshape(*rows.shape[:2], *root.shape[1:])
        span = rows @ upper
        e = data.y - span @ (span.conj().swapaxes(2, 3) @ data.y)
        found.append(np.sum(e.real**2 + e.imag**2, axis=(1, 2, 3)))
    return np.concatenate(found)


def _root(gram: NDArray[Any]) -> NDArray[Any]:
    """Return the triangular root (group, m, m) of normal matrices; with a ridge where one is singular."""
    size = np.maximum(np.trace(gram, axis1=1, axis2=2).real, 1e-300)
    for share in (0.1 * np.finfo(float).eps, RIDGE, 1e3 * RIDGE):
        try:
            return np.asarray(
                np.linalg.cholesky(gram + (share * size)[:, None, None] * np.eye(gram.shape[-1]))
            )
        except np.linalg.LinAlgError:
            continue
    raise np.linalg.LinAlgError("normal matrices of no definite sign")


def _turn(data: Packed, which: Sequence[int], arms: Array, beams: Array, beam: Array | None) -> Array:
    """Return derivatives (p, n, m) of rows by turns of beams and shifts of points."""
    turns = dict(zip((*SHIFTS, *AXES), 2 * [beams @ turn for turn in _ABOUT], strict=True))
    if set(TURNS) & set(which):
        square = perpendicular_axes(beams if beam is None else np.broadcast_to(beam, beams.shape))
        turns |= zip(TURNS, square.swapaxes(0, 1), strict=True)
    rows = data.rows(arms, np.stack([turns[k] for k in which]))
    for place, k in enumerate(which):
        if k in SHIFTS:  # the product of arm and beam changes, the beam does not
            rows[place] = turns[k] @ data.source.beams.to_six[3:]
    return rows
