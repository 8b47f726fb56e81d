"""The data of a fit: lines of both bodies without units, with the errors that all of them share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fitting.mass import Inertia
from fitting.shared_errors import Maps, with_shared_errors
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.records.rigid_motion import lines_measured
from stapeskit.spatial import DOF_NAMES

if TYPE_CHECKING:
    from stapeskit.records.motion_file import RigidMotion

# Digits that files keep: a motion is known to no better than this share of its root mean square.
NOISE_FLOOR = 1e-8
# Of one line to the median of all lines: a resonance reaches 1e3, a vibrometer's dynamic range is 1e6.
_LARGEST_LINE = 1e7
# Upper end of a band over the lowest line, below which the band looks like one in kHz.
_KILOHERTZ = 0.05
# A difference of two motions that is this small against them is rounding.
_AS_ONE = 1e-9


@dataclass(frozen=True)
class Data:
    """Lines of both bodies without units; runs follow one after the other."""

    dof: tuple[str, ...]  # degrees of freedom of the model
    measured: tuple[str, ...]  # those that were measured, in fixed order
    freq_hz: Array  # (lines,)
    run: NDArray[np.intp]  # (lines,): place of the run of each line in ``runs``
    runs: tuple[str, ...]
    reference: float  # angular frequency that is one, rad/s
    amplitude: float  # scaled motion is root_mass q / amplitude
    root_mass: Array  # (m,): square roots of the diagonal of M, SI
    y: ComplexArray  # (lines, 2 m) complex: structure, then base
    covariance: ComplexArray  # (lines, 2 m, 2 m) complex
    mass: Array  # (m, m): scaled: ones on its diagonal
    mass_changes: Array  # (k, m, m): by the shared errors
    maps: tuple[Maps, ...]
    sources: tuple[str, ...]  # source of each shared error, for the budget
    mass_known: tuple[str, ...]  # degrees of freedom of the mass matrix
    dropped: int = 0  # lines that were left out because a value is missing
    floored: bool = False  # whether the stated noise was raised to the digits that files keep
    widened: float = 1.0  # by how much the stated noise was raised since that of neighbouring lines is alike

    @property
    def omega(self) -> Array:
        """Scaled angular frequency, (lines,)."""
        return np.asarray(2.0 * np.pi * self.freq_hz / self.reference)

    @property
    def count(self) -> int:
        """Number of lines."""
        return len(self.freq_hz)

    @property
    def rows(self) -> list[int]:
        """Places of the model's degrees of freedom among the measured ones."""
        return [self.measured.index(name) for name in self.dof]

    @property
    def columns(self) -> list[int]:
        """Places of the other measured degrees of freedom."""
        return [place for place, name in enumerate(self.measured) if name not in self.dof]

    @property
    def loads_known(self) -> bool:
        """Whether there is other motion and the mass matrix says how it loads the structure."""
        return bool(self.columns) and self.mass_known == DOF_NAMES

    def turns(self, errors: Array) -> ComplexArray:
        """Return 1 + sum of z (i w)^p T, (1 or lines, 2, m, m)."""
        turn = np.eye(len(self.measured), dtype=complex)[None, None].repeat(2, axis=1)
        for part in self.maps:
            moved = part.values @ errors[part.errors]
            if part.power or part.run is not None:
                size = np.zeros(self.count, dtype=complex)
                lines = self.lines_of(part.run)
                size[lines] = self.powers(part.power)[lines]
                moved = size[:, None, None, None] * moved
            turn = turn + moved
        return turn

    def lines_of(self, run: int | None) -> NDArray[np.intp]:
        """Return the places of the lines of a run, or of all."""
        return np.arange(self.count) if run is None else np.flatnonzero(self.run == run)

    def powers(self, power: int) -> ComplexArray:
        """Return (i w)^p, (lines,)."""
        return np.asarray((1j * self.omega) ** power)

    def without_errors(self) -> Data:
        """Return the lines with the shared errors left out."""
        return replace(self, mass_changes=self.mass_changes[:0], maps=(), sources=())

    def corrected(self, errors: Array, factors: tuple[ComplexArray, ComplexArray], mass: Array) -> Data:
        """Return the lines with shared errors (k,) and factors of both bodies removed, none left unknown."""
        m, turn = len(self.measured), self.turns(errors)
        whole = np.zeros((self.count, 2 * m, 2 * m), dtype=complex)
        for body, factor in enumerate(factors):
            place = slice(body * m, (body + 1) * m)
            whole[:, place, place] = turn[:, body] * np.reshape(factor, (-1, 1, 1))
        y = (whole @ self.y[:, :, None])[:, :, 0]
        covariance = whole @ self.covariance @ whole.conj().swapaxes(1, 2)
        return replace(self, y=y, covariance=covariance, mass=mass).without_errors()


def data_of(
    motion: RigidMotion,
    inertia: Inertia,
    dof: tuple[str, ...],
    structure: str = "stapes",
    base: str = "base",
    band_hz: tuple[float, float] | None = None,
    exclude_hz: Sequence[tuple[float, float]] = (),
) -> Data:
    """Choose the lines of a fit, scale them and gather the errors that they share.

    Lines outside ``band_hz``, or inside any of ``exclude_hz``, are left out.

    Raises
    ------
    StapeskitError
        A body or a degree of freedom is missing, structure and base are one body or move as one, no lines are
        left, a line lies far beyond all others, variances are missing or negative, or the equations are fewer
        than the unknowns.
    """
    _check_motion(motion, dof, structure, base)
    bodies, m = (motion.body(structure), motion.body(base)), len(motion.dof)
    inside = np.ones(len(motion.freq_hz), dtype=bool)
    if band_hz is not None:
        inside &= (motion.freq_hz >= band_hz[0]) & (motion.freq_hz <= band_hz[1])
    for low, high in exclude_hz:
        inside &= (motion.freq_hz < low) | (motion.freq_hz > high)
    pairs = [motion.pair(place, *bodies) for place in range(len(motion.runs))]
    whole, noise = (np.stack(parts).astype(complex) for parts in zip(*pairs, strict=True))
    # a body with nothing but zeros at a line was not measured there
    moving = [np.any(part != 0.0, axis=2, keepdims=True) for part in np.split(whole, 2, axis=2)]
    finite = np.isfinite(whole) & np.repeat(np.concatenate(moving, axis=2), len(motion.dof), axis=2)
    keep = inside & np.all(finite, axis=2)
    run, line = np.nonzero(keep)
    q, noise, freq_hz, dropped = whole[keep], noise[keep], motion.freq_hz[line], int(np.sum(inside & ~keep))
    measured = np.any(np.stack([np.all(part, axis=2) for part in np.split(finite, 2, axis=2)]), axis=1)
    if not np.any(np.all(finite, axis=2)):
        got = lines_measured((structure, base), measured)
        step = "Measure all on one grid; lines of nothing but zeros were not measured"
        raise StapeskitError.of("the lines of structure and base", "the same", got, "", step)
    _check_lines(freq_hz, dof, band_hz, motion.freq_hz, dropped)
    rows = [motion.dof.index(name) for name in dof]
    _check_sizes(motion, q, noise, freq_hz, rows, (structure, base))
    mass, root = _scaled_mass(inertia, motion.dof)
    deflection = (q[:, rows] - q[:, [m + row for row in rows]]) * root[rows]
    amplitude = float(np.sqrt(np.mean(np.abs(deflection) ** 2))) or 1.0
    reference = float(np.exp(np.mean(np.log(2.0 * np.pi * freq_hz))))
    unit = np.tile(root, 2) / amplitude
    y, noise = q * unit, noise * np.outer(unit, unit)
    floor = NOISE_FLOOR**2 * np.mean(np.abs(y) ** 2, axis=0)
    floor = np.maximum(floor, 1e-6 * floor.max())
    floored = bool(np.any(np.einsum("lii->li", noise).real[:, rows] < floor[rows]))
    noise = noise + np.diag(floor) if floored else noise
    data = Data(
        dof, motion.dof, freq_hz, run, motion.runs, reference, amplitude, root, y,
        noise, mass, np.zeros((0, m, m)), (), (), inertia.dof, dropped, floored,
    )  # fmt: skip
    return with_shared_errors(data, motion, inertia, bodies, keep)


def _scaled_mass(inertia: Inertia, measured: tuple[str, ...]) -> tuple[Array, Array]:
    """Return the scaled mass matrix (m, m) of the measured degrees of freedom, and the roots of its diagonal.

    What a matrix of fewer degrees of freedom lacks is zero, and scaled as if it were of 1 mm.
    """
    known = [name for name in measured if name in inertia.dof]
    matrix = np.zeros((len(measured), len(measured)))
    places = [measured.index(name) for name in known]
    matrix[np.ix_(places, places)] = inertia.block(tuple(known))
    heaviest = max(
        (matrix[place, place] for place in places if measured[place] in DOF_NAMES[:3]),
        default=max(1e6 * matrix[place, place] for place in places),
    )
    usual = [heaviest if name in DOF_NAMES[:3] else 1e-6 * heaviest for name in measured]
    diagonal = np.diag(matrix)
    root = np.sqrt(np.where(diagonal > 0.0, diagonal, usual))
    return matrix / np.outer(root, root), root


def _check_motion(motion: RigidMotion, dof: tuple[str, ...], structure: str, base: str) -> None:
    faults, again = list[Fault](), "Run points2dof again"
    if structure == base:
        faults.append(Fault("--structure and --base", "two different bodies", structure, "", "Name both"))
    if missing := [name for name in dof if name not in motion.dof]:
        wanted = f"degrees of freedom that were measured ({', '.join(motion.dof)})"
        step = "Choose others with --dof or run points2dof with more"
        faults.append(Fault("--dof", wanted, ", ".join(missing), "", step))
    if motion.about != "footplate_centre":
        faults.append(Fault("the motion's about", "footplate_centre", motion.about, "", again))
    if motion.axes != "footplate":
        faults.append(Fault("the motion's axes", "footplate", motion.axes, "", again))
    raise_all(faults)


def _check_lines(
    freq_hz: Array,
    dof: tuple[str, ...],
    band_hz: tuple[float, float] | None,
    every_hz: Array,
    dropped: int,
) -> None:
    if not len(freq_hz):
        step = f"Lines were measured from {every_hz[0]:.6g} to {every_hz[-1]:.6g} Hz: "
        kilohertz = band_hz is not None and band_hz[1] < _KILOHERTZ * every_hz[0]
        step += "give --band in Hz, not in kHz" if kilohertz else "widen --band or exclude less"
        where = f"{dropped} lines have missing values" if dropped else ""
        raise StapeskitError.of("the band", "one with measured lines of both bodies", "none", where, step)
    equations, unknowns, distinct = 2 * len(dof) * len(freq_hz), len(dof) * (len(dof) + 1), len(set(freq_hz))
    if equations < unknowns or distinct < 2:
        wanted = f"at least {unknowns} equations at 2 or more frequencies for {unknowns} unknowns"
        got = f"{equations} equations at {distinct} frequencies"
        step = "Measure more lines or fit fewer degrees of freedom with --dof"
        raise StapeskitError.of("the data", wanted, got, next_step=step)


def _check_sizes(
    motion: RigidMotion,
    q: ComplexArray,
    covariance: ComplexArray,
    freq_hz: Array,
    rows: list[int],
    bodies: tuple[str, str],
) -> None:
    """Refuse lines beyond any resonance, bodies that move as one, and variances that are none."""
    m, faults = len(motion.dof), list[Fault]()
    size, turns = np.abs(q), np.array([name in DOF_NAMES[3:] for name in motion.dof] * 2)
    middle = np.median(size, axis=0)
    for kind in (turns, ~turns):
        middle[kind] = np.max(middle[kind], initial=0.0)
    for line, column in np.argwhere((size > _LARGEST_LINE * middle) & (middle > 0.0)):
        unit = "rad" if turns[column] else "m"
        thing = f"the motion {motion.dof[column % m]} of {bodies[column // m]}"
        wanted = f"of a size like at the other lines, {middle[column]:.3g} {unit} in the median"
        got, step = f"{size[line, column]:.3g} {unit}", "Correct this line, or leave it out by --exclude"
        faults.append(Fault(thing, wanted, got, f"{freq_hz[line]:.6g} Hz", step))
    others = [m + row for row in rows]
    if len(np.unique(q, axis=0)) < len(q):
        step = "Leave copies of runs and lines out: they would count as measured again"
        faults.append(Fault("the motion of a line", "that of no other line", "copies", "", step))
    moved, deflected = (np.linalg.norm(part, axis=0) for part in (q[:, rows], q[:, rows] - q[:, others]))
    still = [motion.dof[row] for row, a, b in zip(rows, moved, deflected, strict=True) if b <= _AS_ONE * a]
    if still:
        got = f"the same one in {', '.join(still)}, where the stiffness is therefore unidentifiable"
        step = "Excite the base so that the suspension is deflected there, or leave it out of --dof"
        wanted = "different in every degree of freedom of --dof"
        faults.append(Fault("the motion of structure and base", wanted, got, "", step))
    variance = np.einsum("lii->li", covariance).real
    wrong = np.sum(~(variance >= 0.0) | ~np.isfinite(variance), axis=0)
    for place in (place for place in (*rows, *others) if wrong[place]):
        thing = f"the noise variances of {bodies[place // m]} {motion.dof[place % m]}"
        step = "Give sd, coherence or several runs to points2dof"
        got = f"{wrong[place]} that are missing or negative"
        faults.append(Fault(thing, "zero or positive at every line", got, "", step))
    raise_all(faults)
