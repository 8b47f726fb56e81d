"""What a fit looks at: lines of all runs with their covariance, chosen out of a motion record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from legacy.fitting.errors import FittingError
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.option_names import named
from legacy.stapeskit.records.motion import RigidMotion

# A difference of two motions this small against them is rounding.
_AS_ONE = 1e-9
# Upper end of a band over the lowest line, below which the band looks like one in kHz: with it lines may span
# 50 times their lowest frequency.
_KILOHERTZ = 0.05


@dataclass(frozen=True)
class Observation:
    """Measured lines of one structure and its base.

    Attributes
    ----------
    dof, load_dof : tuple of str
        Chosen degrees of freedom (n), and measured ones of the structure outside them (c).
    freq_hz : ndarray, (lines,)
        Hz; the runs follow one after the other.
    run : ndarray, (lines,), int
        Place of each line's run in ``runs``.
    q : ndarray, (lines, m), complex
        m = n + c + n: structure in ``dof``, structure in ``load_dof``, base in ``dof``; m and rad.
    covariance : ndarray, (lines, m, m), complex
        E[dq dq^H].
    shared_names : tuple of str, (p,)
    shared_covariance : ndarray, (p, p)
    shared_derivatives : ndarray, (p, lines, m), complex
    dropped : int
        Lines left out because a value was missing.
    """

    dof: tuple[str, ...]
    load_dof: tuple[str, ...]
    freq_hz: Array
    run: NDArray[np.intp]
    runs: tuple[str, ...]
    q: ComplexArray
    covariance: ComplexArray
    shared_names: tuple[str, ...] = ()
    shared_covariance: Array | None = None
    shared_derivatives: ComplexArray | None = None
    dropped: int = 0

    @property
    def structure(self) -> ComplexArray:
        """Motion of the structure in the chosen degrees of freedom, (lines, n)."""
        return self.q[:, : len(self.dof)]

    @property
    def load(self) -> ComplexArray:
        """Motion of the structure outside them, (lines, c)."""
        return self.q[:, len(self.dof) : len(self.dof) + len(self.load_dof)]

    @property
    def base(self) -> ComplexArray:
        """Motion of the base in the chosen degrees of freedom, (lines, n)."""
        return self.q[:, len(self.dof) + len(self.load_dof) :]

    def without_load(self) -> Observation:
        """Return the same lines with the structure's other motion left out."""
        n, c = len(self.dof), len(self.load_dof)
        keep = np.r_[:n, n + c : 2 * n + c]
        derivatives = self.shared_derivatives
        return replace(
            self,
            load_dof=(),
            q=self.q[:, keep],
            covariance=self.covariance[:, keep[:, None], keep[None, :]],
            shared_derivatives=None if derivatives is None else derivatives[:, :, keep],
        )

    def shifted(self, change: ComplexArray) -> Observation:
        """Return the same lines with ``change`` (lines, m) added to q."""
        return replace(self, q=self.q + change)


def observe(
    motion: RigidMotion,
    dof: tuple[str, ...],
    structure: str = "stapes",
    base: str = "base",
    band_hz: tuple[float, float] | None = None,
    exclude_hz: Sequence[tuple[float, float]] = (),
    with_load: bool = True,
) -> Observation:
    """Choose the lines of a fit.

    Parameters
    ----------
    motion : RigidMotion
        About the footplate centre, in footplate axes.
    dof : tuple of str
        Chosen degrees of freedom.
    structure, base : str
        Names of the two bodies.
    band_hz : (float, float), optional
        Lines outside are left out.
    exclude_hz : sequence of (float, float)
        Lines inside any of these ranges are left out.
    with_load : bool
        Whether to take the structure's measured motion outside ``dof`` along.

    Raises
    ------
    FittingError
        A body or a degree of freedom is missing, structure and base are one body, the band is empty,
        variances are zero, negative or missing, the equations are fewer than the unknowns, or structure and
        base move as one in a chosen degree of freedom.
    KinematicsError
        There is no body of that name.
    """
    _check_motion(motion, dof, structure, base)
    load_dof = tuple(name for name in motion.dof if name not in dof) if with_load else ()
    observation = _gather(
        motion, dof, load_dof, structure, base, _is_in_band(motion.freq_hz, band_hz, exclude_hz)
    )
    _check_lines(observation, band_hz, exclude_hz, motion.freq_hz)
    return observation


def observe_both(
    motion: RigidMotion,
    structure: str,
    base: str,
    band_hz: tuple[float, float] | None = None,
    exclude_hz: Sequence[tuple[float, float]] = (),
) -> Observation:
    """Return the same lines with every measured degree of freedom of both bodies; parameters as `observe`."""
    return _gather(motion, motion.dof, (), structure, base, _is_in_band(motion.freq_hz, band_hz, exclude_hz))


def _gather(
    motion: RigidMotion,
    dof: tuple[str, ...],
    load_dof: tuple[str, ...],
    structure: str,
    base: str,
    inside: NDArray[np.bool_],
) -> Observation:
    """Gather the chosen columns of all runs, without lines at which one of them is missing."""
    first, second = motion.body(structure), motion.body(base, "{base}")
    places = [motion.dof.index(name) for name in (*dof, *load_dof)]
    count = len(motion.dof)
    columns = np.array([*places, *(count + motion.dof.index(name) for name in dof)])
    q, covariance, run, freq, derivatives, dropped = [], [], [], [], [], 0
    for place in range(len(motion.runs)):
        both, joint = motion.pair(place, first, second)
        chosen = both[:, columns]
        complete = np.all(np.isfinite(chosen), axis=1)
        keep = inside & complete
        dropped += int(np.sum(inside & ~complete))
        q.append(chosen[keep])
        covariance.append(joint[keep][:, columns[:, None], columns[None, :]])
        freq.append(motion.freq_hz[keep])
        run.append(np.full(int(np.sum(keep)), place))
        if motion.shared is not None and motion.shared.names:
            part = motion.shared.derivatives[:, place][:, [first, second]]
            part = np.concatenate([part[:, 0], part[:, 1]], axis=-1)
            derivatives.append(part[:, keep][:, :, columns])
    return Observation(
        dof,
        load_dof,
        np.concatenate(freq),
        np.concatenate(run),
        motion.runs,
        np.concatenate(q),
        np.concatenate(covariance),
        motion.shared.names if derivatives and motion.shared is not None else (),
        motion.shared.covariance if derivatives and motion.shared is not None else None,
        np.nan_to_num(np.concatenate(derivatives, axis=1)) if derivatives else None,
        dropped,
    )


def _is_in_band(
    freq_hz: Array, band_hz: tuple[float, float] | None, exclude_hz: Sequence[tuple[float, float]]
) -> NDArray[np.bool_]:
    inside = np.ones(len(freq_hz), dtype=bool)
    if band_hz is not None:
        inside &= (freq_hz >= band_hz[0]) & (freq_hz <= band_hz[1])
    for low, high in exclude_hz:
        inside &= (freq_hz < low) | (freq_hz > high)
    return inside


def _check_motion(motion: RigidMotion, dof: tuple[str, ...], structure: str, base: str) -> None:
    faults = []
    if structure == base:
        faults.append(
            Fault("{structure} and {base}", "two different bodies", structure, "", "Name both bodies")
        )
    missing = [name for name in dof if name not in motion.dof]
    if missing:
        faults.append(
            Fault(
                "{dof}",
                f"degrees of freedom that were measured ({', '.join(motion.dof)})",
                ", ".join(missing),
                next_step="Choose others with {dof} or run points2dof with more",
            )
        )
    for name, value, wanted in (
        ("about", motion.about, "footplate_centre"),
        ("axes", motion.axes, "footplate"),
    ):
        if value != wanted:
            faults.append(
                Fault(f"the motion's {name}", wanted, value, "", "Make the file with points2dof anew")
            )
    raise_all(FittingError, faults)


def _check_lines(
    observation: Observation,
    band_hz: tuple[float, float] | None,
    exclude_hz: Sequence[tuple[float, float]],
    measured_hz: Array,
) -> None:
    lines, n = len(observation.freq_hz), len(observation.dof)
    if lines == 0:
        where = f"{observation.dropped} lines have missing values" if observation.dropped else ""
        if band_hz is not None or exclude_hz:
            ends = f"{np.min(measured_hz):.6g} to {np.max(measured_hz):.6g} Hz"
            step = f"Lines were measured from {ends}: widen {named('band')} or exclude less"
            if band_hz is not None and band_hz[1] < _KILOHERTZ * float(np.min(measured_hz)):
                step = f"Lines were measured from {ends}: give {named('band')} in Hz, not in kHz"
        else:
            step = "Measure structure and base at common frequencies"
        raise FittingError.of("the band", "one with measured lines of both bodies", "none", where, step)
    if 2 * n * lines < n * (n + 1) or len(np.unique(observation.freq_hz)) < 2:
        raise FittingError.of(
            "the data",
            f"at least {n * (n + 1)} equations at 2 or more frequencies for {n * (n + 1)} unknowns",
            f"{2 * n * lines} equations at {len(np.unique(observation.freq_hz))} frequencies",
            next_step="Measure more lines or fit fewer degrees of freedom with {dof}",
        )
    _check_deflection(observation)
    variance = np.einsum("lii->li", observation.covariance).real
    names = [
        *(f"structure {name}" for name in (*observation.dof, *observation.load_dof)),
        *(f"base {name}" for name in observation.dof),
    ]
    faults = []
    for place, name in enumerate(names):
        column = variance[:, place]
        zero_allowed = place >= n
        if not np.all(np.isfinite(observation.covariance[:, place])):
            got = f"{np.sum(~np.isfinite(column))} missing ones"
        elif np.any(column < 0.0) or (not zero_allowed and np.any(column == 0.0)):
            got = f"{np.sum(column <= 0.0)} that are zero or negative"
        else:
            continue
        faults.append(
            Fault(
                f"the noise variances of {name}",
                "positive at every line",
                got,
                next_step="Give sd, coherence or several runs to points2dof",
            )
        )
    raise_all(FittingError, faults)


def _check_deflection(observation: Observation) -> None:
    """Refuse degrees of freedom in which structure and base move, but as one: nothing is deflected."""
    moved = np.sqrt(np.mean(np.abs(observation.structure) ** 2, axis=0))
    deflected = np.sqrt(np.mean(np.abs(observation.structure - observation.base) ** 2, axis=0))
    still = [
        name
        for name, size, part in zip(observation.dof, moved, deflected, strict=True)
        if size > 0.0 and part <= _AS_ONE * size
    ]
    if not still:
        return
    rest = ",".join(name for name in observation.dof if name not in still)
    step = f"Give {named('dof')} {rest}, or excite" if rest else "Excite"
    raise FittingError.of(
        "the motion of structure and base",
        "different in every degree of freedom of {dof}",
        f"the same one in {', '.join(still)}, where the stiffness is therefore unidentifiable",
        next_step=f"{step} the base so that the suspension is deflected there",
    )
