"""Rigid-body motion: generalized coordinates per run, body and frequency, with their covariance.

`ROW_COLUMNS` is the table of the further columns of dof.csv, one number per row. A new column is one entry;
writer, reader, checks and docs/schemas.md follow. Where its values are not computed from other fields, it
also needs a field in `RigidMotion`, None by default, and an attribute of that name in `LineFit`
(kinematics/fit/rigid_fit.py); one that only some motions have is ``optional``. One in units of the motion
is divided by the reference of ``--reference`` in kinematics/fit/frf_ratio.py. Columns of each degree of
freedom are in motion_columns.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.faults import Fault, StapeskitError, raise_all
from legacy.stapeskit.spatial import DOF_NAMES
from legacy.stapeskit.warnings import Notice

# Above it a double is no exact count.
LARGEST_COUNT = 1e15


@dataclass(frozen=True)
class SharedErrors:
    """Errors common to all lines, as named parameters.

    Attributes
    ----------
    names : tuple of str, (p,)
        ``<source>.<parameter>``, e.g. ``registration.alpha``. The source ``footplate_frame`` (x, y, z,
        alpha, beta, gamma: displacement of the footplate frame in its own axes, m and rad) is the same
        error as in mass.json, so that fitting can join both.
    covariance : ndarray, (p, p)
        SI.
    derivatives : ndarray, (p, run, body, freq, dof), complex
        d q / d parameter.
    """

    names: tuple[str, ...]
    covariance: Array
    derivatives: ComplexArray

    def __post_init__(self) -> None:
        count = len(self.names)
        if self.covariance.shape != (count, count) or self.derivatives.shape[:1] != (count,):
            raise StapeskitError.of(
                "shared errors",
                f"{count} parameters throughout",
                f"covariance {self.covariance.shape}, derivatives {self.derivatives.shape}",
            )


@dataclass(frozen=True)
class RigidMotion:
    """Displacement amplitudes q of rigid bodies under harmonic motion e^{+i w t}.

    Attributes
    ----------
    runs, bodies, dof : tuple of str
        Names along the first, second and last axis of q; dof in the order of DOF_NAMES.
    freq_hz : ndarray, (freq,)
        Ascending, positive.
    q : ndarray, (run, body, freq, dof), complex
        m and rad, peak; NaN where a body was not measured at a line.
    covariance : ndarray, complex
        E[dq dq^H] of the channel noise: (run, body, freq, dof, dof), or joint over bodies,
        (run, freq, body*dof, body*dof), when ``reference`` is set. The variance of the real part
        (= of the imaginary part) is half its diagonal.
    chi2, n_dof : ndarray, (run, body, freq)
        Sum of squared normalised residuals over real and imaginary parts, and its degrees of freedom.
    common_sd : ndarray, (run, freq), or None
        Standard deviation of the real (= imaginary) part of a relative error that all motions of a line
        share: noise of the signal that the readings refer to. ``covariance`` contains it as 2 s^2 q q^H.
    reference : str
        ``BODY:DOF`` when q is per unit of that motion, else empty.
    about, axes : str
        Reference point and axes of q.
    shared : SharedErrors or None
        Errors common to all lines.
    notices : tuple of Notice
        Warnings that travel with the data.
    """

    runs: tuple[str, ...]
    bodies: tuple[str, ...]
    dof: tuple[str, ...]
    freq_hz: Array
    q: ComplexArray
    covariance: ComplexArray
    chi2: Array
    n_dof: Array
    reference: str = ""
    about: str = "footplate_centre"
    axes: str = "footplate"
    shared: SharedErrors | None = None
    notices: tuple[Notice, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)
    common_sd: Array | None = None

    def __post_init__(self) -> None:
        runs, bodies, lines, dof = len(self.runs), len(self.bodies), len(self.freq_hz), len(self.dof)
        joint = (runs, lines, bodies * dof, bodies * dof)
        separate = (runs, bodies, lines, dof, dof)
        wanted: dict[str, tuple[object, object]] = {
            "q": (self.q.shape, (runs, bodies, lines, dof)),
            "the covariance": (self.covariance.shape, joint if self.reference else separate),
        }
        for column in STORED:
            values = getattr(self, column.name)
            if values is not None or not column.optional:
                wanted[column.name] = (np.shape(values), (runs, bodies, lines))
        if self.common_sd is not None:
            wanted["common_sd"] = (self.common_sd.shape, (runs, lines))
        faults = [
            Fault(f"the shape of {name}", str(want), got)
            for name, (got, want) in wanted.items()
            if got != want
        ]
        if tuple(name for name in DOF_NAMES if name in self.dof) != self.dof or not self.dof:
            faults.append(Fault("dof", f"in the order {', '.join(DOF_NAMES)}", self.dof))
        if np.any(np.diff(self.freq_hz) <= 0.0) or np.any(self.freq_hz <= 0.0):
            faults.append(Fault("freq_hz", "positive and ascending", "another order"))
        raise_all(StapeskitError, faults)

    def body(self, name: str, option: str = "{structure}") -> int:
        """Return the position of a body.

        Raises
        ------
        StapeskitError
            There is no body of that name.
        """
        if name not in self.bodies:
            raise StapeskitError.of(
                "the body", f"one of {', '.join(self.bodies)}", name, next_step=f"Name one with {option}"
            )
        return self.bodies.index(name)

    def with_common_noise(self, sd: Array) -> RigidMotion:
        """Return absolute motion with another relative error common to all motions of a line.

        Parameters
        ----------
        sd : ndarray, broadcastable to (run, freq)
            Standard deviation of its real (= imaginary) part; 0 removes such an error.

        Notes
        -----
        q (1 + e) with E|e|^2 = 2 s^2 adds 2 s^2 q q^H to the covariance of all bodies together, and nothing
        to residuals, chi2 or ratios of motions.
        """
        new = np.broadcast_to(np.asarray(sd, dtype=float), (len(self.runs), len(self.freq_hz)))
        old = np.zeros(new.shape) if self.common_sd is None else self.common_sd
        change = 2.0 * (new**2 - old**2)[:, None, :, None, None]
        covariance = self.covariance + change * self.q[..., :, None] * self.q[..., None, :].conj()
        return replace(self, covariance=covariance, common_sd=new.copy() if np.any(new > 0.0) else None)

    def pair(self, run: int, first: int, second: int) -> tuple[ComplexArray, ComplexArray]:
        """Return the stacked motion of two bodies and its joint covariance.

        Returns
        -------
        q : ndarray, (freq, 2 dof), complex
        covariance : ndarray, (freq, 2 dof, 2 dof), complex
        """
        n = len(self.dof)
        q = np.concatenate([self.q[run, first], self.q[run, second]], axis=-1)
        if self.reference:
            places = np.r_[first * n : (first + 1) * n, second * n : (second + 1) * n]
            return q, self.covariance[run][:, places[:, None], places[None, :]]
        joint = np.zeros((len(self.freq_hz), 2 * n, 2 * n), dtype=complex)
        joint[:, :n, :n] = self.covariance[run, first]
        joint[:, n:, n:] = self.covariance[run, second]
        if self.common_sd is not None:
            across = 2.0 * self.common_sd[run][:, None, None] ** 2 * q[:, :n, None] * q[:, None, n:].conj()
            joint[:, :n, n:], joint[:, n:, :n] = across, across.conj().transpose(0, 2, 1)
        return q, joint


@dataclass(frozen=True)
class RowColumn:
    """A column of dof.csv with one number per row.

    Attributes
    ----------
    meaning : str
        For docs/schemas.md.
    values : callable, optional
        Take a RigidMotion and return the numbers, (run, body, freq); a reader skips such a column. None: they
        are the field of that name, which dof.h5 stores and readers give back.
    whole : bool
        Whether the numbers are counts.
    missing : float
        Value of an empty cell.
    optional : bool
        Whether the field may be None, as in files that were written before the column was added, and in
        bodies whose fit has no such number.
    least, most : float
        Range of what a cell may hold, 0 to 1e15 unless stated: beyond it, a reader refuses the table.

    Notes
    -----
    Noise whose size comes from the residuals is found after the fit: numbers that depend on it also stand in
    ``LineFit.rescaled`` (kinematics/fit/rigid_fit.py).
    """

    name: str
    meaning: str
    values: Callable[[RigidMotion], NDArray[Any]] | None = None
    whole: bool = False
    missing: float = float("nan")
    optional: bool = False
    least: float = 0.0
    most: float = LARGEST_COUNT

    @property
    def stored(self) -> bool:
        """Whether the numbers are a field of RigidMotion."""
        return self.values is None

    def of(self, motion: RigidMotion) -> NDArray[Any]:
        """Return the numbers of a motion, (run, body, freq)."""
        values = getattr(motion, self.name) if self.values is None else self.values(motion)
        return np.full(motion.q.shape[:3], self.missing) if values is None else np.asarray(values)

    @property
    def form(self) -> str:
        """How a number is written: all digits of a count, 9 digits otherwise."""
        return "%d" if self.whole else "%.9g"

    @property
    def expected(self) -> str:
        """What a cell must hold, for messages."""
        return "a count" if self.whole else f"from {self.least:g} to {self.most:g}"

    def is_wrong(self, values: Array) -> NDArray[np.bool_]:
        """Return which cells (rows,) hold an impossible number; empty ones do not."""
        wrong = (values < self.least) | (values > self.most)
        return wrong | (np.isfinite(values) & (values != np.round(values))) if self.whole else wrong

    def fill_missing(self, values: Array) -> NDArray[Any]:
        """Return cells (rows,) with the value of missing ones."""
        full = np.where(np.isnan(values), self.missing, values)
        return full.astype(int) if self.whole else full


ROW_COLUMNS = (
    RowColumn("chi2", "sum of squared normalised residuals over real and imaginary parts"),
    RowColumn("n_dof", "its degrees of freedom", whole=True, missing=0.0),
)
STORED = tuple(column for column in ROW_COLUMNS if column.stored)
