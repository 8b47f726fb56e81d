"""Rigid-body motion: generalized coordinates per run, body and frequency, with their uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.spatial import DOF_NAMES
from stapeskit.warnings import Notice


@dataclass(frozen=True)
class SharedErrors:
    """Errors common to all lines, as named parameters.

    Attributes
    ----------
    names : tuple of str, (p,)
        ``<source>.<parameter>``, e.g. ``registration.alpha``. The source ``footplate_frame`` (displacement of
        that frame in its own axes, m and rad) is the same error as in mass.json: fitting can join both.
    covariance, derivatives : ndarray, (p, p), and (p, run, body, freq, dof), complex
        SI; d q / d parameter.
    maps, powers : ndarray, (p, body, 6, 6), complex, and (p,), int, or None
        The derivatives by their cause: d q / d parameter = (i w)^power * map @ q of the same body, for motion
        in all six degrees of freedom; the power is 0 for a factor or a displaced frame, 1 for a delay. NaN
        for a parameter that has no such map, None when no parameter has one.
    """

    names: tuple[str, ...]
    covariance: Array
    derivatives: ComplexArray
    maps: ComplexArray | None = None
    powers: NDArray[np.integer] | None = None

    def __post_init__(self) -> None:
        count, derivatives = len(self.names), self.derivatives.shape
        wanted = {"covariance": (count, count), "derivatives": (count, *derivatives[1:])}
        if self.maps is not None or self.powers is not None:
            wanted |= {"maps": (count, *derivatives[2:3], 6, 6), "powers": (count,)}
        shapes = {name: np.shape(getattr(self, name)) for name in wanted}
        if shapes != wanted:
            got = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
            raise StapeskitError.of("shared errors", f"{count} parameters throughout", got)


def lines_measured(bodies: Sequence[str], measured: NDArray[np.bool_]) -> str:
    """Return in words at how many lines bodies were measured, and at how many all of them.

    Parameters
    ----------
    measured : ndarray, (bodies, freq)
    """
    each = zip(bodies, np.sum(measured, axis=1), strict=True)
    listed = ", ".join(f"{body} at {count}" for body, count in each)
    common = int(np.sum(np.all(measured, axis=0)))
    return f"of {measured.shape[1]} frequencies, {listed} were measured, {common} of them on all bodies"


@dataclass(frozen=True)
class RigidMotion:
    """Displacement amplitudes q of rigid bodies under harmonic motion e^{+i w t}; it checks its shapes.

    Attributes
    ----------
    freq_hz, q : ndarray, (freq,), ascending, and (run, body, freq, dof), complex
        q in m and rad, peak; NaN where a body was not measured at a line; dof in the order of DOF_NAMES.
    covariance : ndarray, complex
        E[dq dq^H] of the channel noise: (run, body, freq, dof, dof), or joint over bodies,
        (run, freq, body*dof, body*dof), when ``reference`` is set. The variance of the real part
        (= of the imaginary part) is half its diagonal.
    chi2, n_dof : ndarray, (run, body, freq)
        Sum of squared normalised residuals over real and imaginary parts, and its degrees of freedom.
    reference : str
        ``BODY:DOF`` when q is per unit of that motion, else empty.
    """

    runs: tuple[str, ...]
    bodies: tuple[str, ...]
    dof: tuple[str, ...]
    freq_hz: Array
    q: ComplexArray
    covariance: ComplexArray
    chi2: Array
    n_dof: NDArray[Any]
    reference: str = ""
    about: str = "footplate_centre"
    axes: str = "footplate"
    shared: SharedErrors | None = None
    notices: tuple[Notice, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        runs, bodies, lines, dof = len(self.runs), len(self.bodies), len(self.freq_hz), len(self.dof)
        grid, joint = (runs, bodies, lines), (runs, lines, bodies * dof, bodies * dof)
        noise = joint if self.reference else (*grid, dof, dof)
        wanted: dict[str, tuple[int, ...]] = {
            "q": (*grid, dof),
            "covariance": noise,
            "chi2": grid,
            "n_dof": grid,
        }
        found = {name: getattr(self, name).shape for name in wanted}
        if self.shared is not None:
            wanted["derivatives"], found["derivatives"] = (*grid, dof), self.shared.derivatives.shape[1:]
        things = [(name, str(shape), found[name]) for name, shape in wanted.items() if found[name] != shape]
        faults = [Fault(f"the shape of {name}", shape, got) for name, shape, got in things]
        if tuple(name for name in DOF_NAMES if name in self.dof) != self.dof or not self.dof:
            faults.append(Fault("dof", f"in the order {', '.join(DOF_NAMES)}", self.dof))
        if np.any(np.diff(self.freq_hz) <= 0.0) or np.any(self.freq_hz <= 0.0):
            faults.append(Fault("freq_hz", "positive and ascending", "another order"))
        raise_all(faults)

    @property
    def body_covariance(self) -> ComplexArray:
        """Covariance of each body alone, (run, body, freq, dof, dof), also of a joint one."""
        if not self.reference:
            return self.covariance
        runs, bodies, lines, dof = self.q.shape
        blocks = self.covariance.reshape(runs, lines, bodies, dof, bodies, dof)
        return np.stack([blocks[:, :, body, :, body, :] for body in range(bodies)], axis=1)

    @property
    def standard_deviation(self) -> Array:
        """Channel noise of the real (= imaginary) part of q, (run, body, freq, dof), m and rad."""
        variance = np.real(np.diagonal(self.body_covariance, axis1=-2, axis2=-1))
        return np.asarray(np.sqrt(np.maximum(variance, 0.0) / 2.0))

    def body(self, name: str, option: str = "--structure") -> int:
        """Return the position of a body, or raise StapeskitError where there is none of that name."""
        if name not in self.bodies:
            step = f"Name one with {option}"
            raise StapeskitError.of("the body", f"one of {', '.join(self.bodies)}", name, next_step=step)
        return self.bodies.index(name)

    def pair(self, run: int, first: int, second: int) -> tuple[ComplexArray, ComplexArray]:
        """Return the stacked motion (freq, 2 dof) of two bodies and its covariance (freq, 2 dof, 2 dof)."""
        n = len(self.dof)
        q = np.concatenate([self.q[run, first], self.q[run, second]], axis=-1)
        if self.reference:
            places = np.r_[first * n : (first + 1) * n, second * n : (second + 1) * n]
            return q, self.covariance[run][:, places[:, None], places[None, :]]
        joint = np.zeros((len(self.freq_hz), 2 * n, 2 * n), dtype=complex)
        joint[:, :n, :n] = self.covariance[run, first]
        joint[:, n:, n:] = self.covariance[run, second]
        return q, joint
