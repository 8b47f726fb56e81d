"""Rigid-body motion: generalized coordinates per run, body and frequency, with their uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
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
        ``<source>.<parameter>``, e.g. ``registration.alpha``. The source ``footplate_frame`` (x, y, z,
        alpha, beta, gamma: displacement of the footplate frame in its own axes, m and rad) is the same
        error as in mass.json, so that fitting can join both.
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
        count = len(self.names)
        shapes = {"covariance": self.covariance.shape, "derivatives": self.derivatives.shape}
        good = shapes["covariance"] == (count, count) and shapes["derivatives"][:1] == (count,)
        if self.maps is not None or self.powers is not None:
            shapes |= {name: getattr(getattr(self, name), "shape", ()) for name in ("maps", "powers")}
            bodies = self.derivatives.shape[2:3]
            good = good and shapes["maps"] == (count, *bodies, 6, 6) and shapes["powers"] == (count,)
        if not good:
            got = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
            raise StapeskitError.of("shared errors", f"{count} parameters throughout", got)


@dataclass(frozen=True)
class RigidMotion:
    """Displacement amplitudes q of rigid bodies under harmonic motion e^{+i w t}; it checks its shapes.

    Attributes
    ----------
    runs, bodies, dof : tuple of str
        Names along the first, second and last axis of q; dof in the order of DOF_NAMES.
    freq_hz, q : ndarray, (freq,), ascending, and (run, body, freq, dof), complex
        q in m and rad, peak; NaN where a body was not measured at a line.
    covariance : ndarray, complex
        E[dq dq^H] of the channel noise: (run, body, freq, dof, dof), or joint over bodies,
        (run, freq, body*dof, body*dof), when ``reference`` is set. The variance of the real part
        (= of the imaginary part) is half its diagonal.
    chi2, n_dof : ndarray, (run, body, freq)
        Sum of squared normalised residuals over real and imaginary parts, and its degrees of freedom.
    reference : str
        ``BODY:DOF`` when q is per unit of that motion, else empty.
    about, axes : str
        Reference point and axes of q.
    shared, notices, provenance
        Errors common to all lines; warnings that travel with the data; where they come from.
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
        joint = (runs, lines, bodies * dof, bodies * dof)
        separate = (runs, bodies, lines, dof, dof)
        wanted: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {
            "q": (self.q.shape, (runs, bodies, lines, dof)),
            "the covariance": (self.covariance.shape, joint if self.reference else separate),
            "chi2": (self.chi2.shape, (runs, bodies, lines)),
            "n_dof": (self.n_dof.shape, (runs, bodies, lines)),
        }
        if self.shared is not None:
            derivatives = self.shared.derivatives.shape
            wanted["the derivatives"] = (derivatives[1:], (runs, bodies, lines, dof))
        faults = [
            Fault(f"the shape of {name}", str(want), got)
            for name, (got, want) in wanted.items()
            if got != want
        ]
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
        return q, joint
