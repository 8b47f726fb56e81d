"""The catalogue of causes: each changes motion, mass matrix or ligament by one unknown of a joint fit.

A cause is one entry of CAUSES. Scores, refits, naming, the effect on K and D, page and kd.json follow.
``--correct`` takes those of `fitting.options.CORRECT`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.calibrated import calibrated
from fitting.ligament.equations import Equations, Term
from fitting.ligament.joint_lines import DOFS, JointLines
from stapeskit.arrays import Array
from stapeskit.page.quantities import MASS
from stapeskit.spatial import matrix_from_parameters, parameters_from_matrix

ComplexArray = NDArray[np.complexfloating[Any, Any]]
Applied = tuple[JointLines, Equations]
# Where a mass at the head sits: height of a human stapes, 3.2 to 3.8 mm (Sim et al. 2013, JARO 14:159), m.
HEAD_M = (0.0, 3.4e-3, 0.0)
# Shared errors of the place of that mass.
HEAD_PLACE = "mass.head_place"
_HOLDER_QUALITY = 10.0
# Inertial parameters that are odd in z: m z, Jyz, Jxz.
_ODD_IN_Z = [3, 8, 9]
# Steps of one width of a resonance at half power.
_HOLDERS_HZ = np.geomspace(450.0, 5000.0, 26)
# Parts of the measurement between which K and D may change: the best of these steps explains at least 0.88 of
# what one at any place does, a drift 0.75.
_PARTS = 16


@dataclass(frozen=True)
class Setting:
    """The fit to which a cause is added.

    Attributes
    ----------
    lines : JointLines
        Without any cause.
    omega : ndarray, (lines,)
        rad/s.
    mass : ndarray, (6, 6)
        SI.
    """

    lines: JointLines
    omega: Array
    mass: Array


Apply = Callable[[float, JointLines, Equations], Applied]


@dataclass(frozen=True)
class Cause:
    """One cause.

    Attributes
    ----------
    title : str
        As written within a sentence.
    unit : str
        In which its size is given.
    per_unit : float
        SI over that unit.
    term : callable
        Setting -> apply(value in the unit, lines, equations).
    scored : bool
        Whether data can show it; others are sensitivities only.
    example : float
        The size whose effect on K and D the report gives, in the unit.
    starts : tuple of float
        Where a refit starts as well, for sizes that are far from first order.
    refitted : bool
        Whether its term is more than a score: damping laws are fitted as such.
    positive : bool
        Whether a negative size is impossible.
    family : str
        Causes of one family are the same error at different places; the likeliest of them is refitted, and
        its place counts as chosen among them.
    nuisances : tuple of str
        Shared errors that the cause brings with it; its term sets their effect.
    moves : callable, optional
        Setting -> what one standard deviation of each of them does beside one unit of the cause.
    usual : float
        Standard deviation of its size where it is there, in the unit; infinite where any size occurs.
    only : float or None
        The one size that it can have where it is there.
    moved : callable, optional
        How far it is moved, in distances of its family -> the name of the nearest of them, its term there.
    """

    title: str
    unit: str
    per_unit: float
    term: Callable[[Setting], Apply]
    scored: bool = True
    example: float = 1.0
    starts: tuple[float, ...] = (0.0,)
    refitted: bool = True
    positive: bool = False
    family: str = ""
    nuisances: tuple[str, ...] = ()
    moves: Callable[[Setting], tuple[Apply, ...]] | None = None
    usual: float = np.inf
    only: float | None = None
    moved: Callable[[float], tuple[str, Callable[[Setting], Apply]]] | None = None


def title_of(name: str) -> str:
    """Return what a cause is called in a sentence; ``law_NAME`` is a damping law."""
    if name in CAUSES:
        return CAUSES[name].title
    return f"{name.removeprefix('law_')} damping"


def unit_of(name: str) -> str:
    """Return the unit of the size of a cause."""
    return CAUSES[name].unit if name in CAUSES else ""


def term_of(name: str, setting: Setting) -> Term:
    """Return the unknown term of a cause; its parameter counts units of the cause."""
    cause = CAUSES[name]
    starts = tuple(value for value in cause.starts if value != 0.0)
    return Term(name, cause.term(setting), cause.per_unit, starts=starts, nuisances=cause.nuisances)


def _between_bodies(factor: Callable[[float, Array], ComplexArray]) -> Callable[[Setting], Apply]:
    """Multiply the motion of the structure alone."""

    def made(setting: Setting) -> Apply:
        def apply(value: float, lines: JointLines, equations: Equations) -> Applied:
            factors = np.ones((lines.count, 2 * DOFS), dtype=complex)
            factors[:, :DOFS] = factor(value, setting.omega)[:, None]
            return lines.multiplied(factors), equations

        return apply

    return made


def _mass(change: Callable[[float, Setting], Array]) -> Callable[[Setting], Apply]:
    """Change the ten inertial parameters (SI)."""

    def made(setting: Setting) -> Apply:
        root = setting.lines.root_mass

        def apply(value: float, lines: JointLines, equations: Equations) -> Applied:
            added = matrix_from_parameters(change(value, setting)) / np.outer(root, root)
            return replace(lines, mass=lines.mass + added), equations

        return apply

    return made


def _added(matrix: Array, setting: Setting) -> Apply:
    """Add a matrix (6, 6), SI, to the mass matrix."""
    scaled = matrix / np.outer(setting.lines.root_mass, setting.lines.root_mass)

    def apply(value: float, lines: JointLines, equations: Equations) -> Applied:
        return replace(lines, mass=lines.mass + value * scaled), equations

    return apply


def _ligament(factor: Callable[[Setting], Array]) -> Callable[[Setting], Apply]:
    """Multiply K and D by 1 + value * factor(lines)."""

    def made(setting: Setting) -> Apply:
        shape = factor(setting)

        def apply(value: float, lines: JointLines, equations: Equations) -> Applied:
            before = 1.0 if equations.factor is None else equations.factor
            return lines, replace(equations, factor=before * (1.0 + 0.01 * value * shape))

        return apply

    return made


def _law(factor: Callable[[Array], ComplexArray]) -> Callable[[Setting], Apply]:
    """Add value * factor(scaled frequency) to the factor s of the damping law."""

    def made(setting: Setting) -> Apply:
        shape = factor(setting.lines.omega)

        def apply(value: float, lines: JointLines, equations: Equations) -> Applied:
            before = 0.0 if equations.lossy is None else equations.lossy
            return lines, replace(equations, lossy=np.asarray(before + value * shape, dtype=complex))

        return apply

    return made


def _fluid(places: tuple[int, ...]) -> Callable[[Setting], Apply]:
    """Add a mass on the deflection of some rows: as it is for the piston, as inertia at 1 mm for rocking."""

    def made(setting: Setting) -> Apply:
        rows = np.array([1, 3, 5])
        unit = np.zeros((3, 3))
        for place in places:
            arm = 1.0 if place == 0 else 1e-6
            unit[place, place] = MASS.si(1.0) * arm / setting.lines.root_mass[rows[place]] ** 2

        def apply(value: float, lines: JointLines, equations: Equations) -> Applied:
            before = 0.0 if equations.fluid is None else equations.fluid
            return lines, replace(equations, fluid=before + value * unit)

        return apply

    return made


def _holder(frequency_hz: float) -> Callable[[Setting], Apply]:
    """Add a resonance of the holder to the motion of the base."""

    def made(setting: Setting) -> Apply:
        ratio = setting.omega / (2.0 * np.pi * frequency_hz)
        shape = (1.0 / _HOLDER_QUALITY) / (1.0 - ratio**2 + 1j * ratio / _HOLDER_QUALITY)

        def apply(value: float, lines: JointLines, equations: Equations) -> Applied:
            factors = np.ones((lines.count, 2 * DOFS), dtype=complex)
            factors[:, DOFS:] = (1.0 + 0.01 * value * shape)[:, None]
            return lines.multiplied(factors), equations

        return apply

    return made


def _head_mass(setting: Setting) -> Apply:
    """Add a mass at the head, whose place is known to a standard deviation along each axis.

    Notes
    -----
    The place counts: 5 mg that sit 0.1 mm off move M12 by as much as the stapes itself has.
    """
    root = np.outer(setting.lines.root_mass, setting.lines.root_mass)
    here, steps = matrix_from_parameters(_point(np.array(HEAD_M))), _head_steps()

    def apply(value: float, lines: JointLines, equations: Equations) -> Applied:
        mass = MASS.si(value)
        changes, slopes = lines.mass_changes.copy(), lines.mass_slopes.copy()
        own = [number for number, name in enumerate(lines.sources) if name == HEAD_PLACE]
        for number, step in zip(own, steps, strict=False):
            slopes[number] = mass * step
            changes[number] = slopes[number] / root
        heavier = lines.mass + mass * here / root
        return replace(lines, mass=heavier, mass_changes=changes, mass_slopes=slopes), equations

    return apply


def _head_steps() -> list[Array]:
    """Return the changes (6, 6) of the mass matrix of 1 kg at the head by one sd of its place, x, y and z."""
    place, sd = np.array(HEAD_M), 1e-3 * calibrated("causes.head_place_sd_mm")
    return [
        0.5 * matrix_from_parameters(_point(place + step) - _point(place - step)) for step in sd * np.eye(3)
    ]


def _head_moves(setting: Setting) -> tuple[Apply, ...]:
    """Move a mass of one unit at the head by one standard deviation along x, y and z."""
    return tuple(_added(MASS.si(1.0) * step, setting) for step in _head_steps())


def _point(place: Array) -> Array:
    """Return the inertial parameters of a mass of 1 kg at a place (m)."""
    return np.array([1.0, *place, *_entries(place @ place * np.eye(3) - np.outer(place, place))])


def _entries(tensor: Array) -> Array:
    """Return xx, yy, zz, xy, yz, xz of a tensor."""
    return np.asarray(tensor[[0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]])


def _centre(axis: int) -> Callable[[float, Setting], Array]:
    """Return the change of the inertial parameters when the body lies elsewhere (mm) in its frame.

    Notes
    -----
    Moments of inertia about the footplate centre follow by the theorem of parallel axes.
    """

    def change(value: float, setting: Setting) -> Array:
        parameters = parameters_from_matrix(setting.mass)
        mass, centre = parameters[0], parameters[1:4] / parameters[0]
        shift = 1e-3 * value * np.eye(3)[axis]
        return np.asarray(mass * (_point(centre + shift) - _point(centre)))

    return change


def _part(places: slice) -> Callable[[float, Setting], Array]:
    """Return a share (%) of some of the inertial parameters."""

    def change(value: float, setting: Setting) -> Array:
        change_si = np.zeros(10)
        change_si[places] = 0.01 * value * parameters_from_matrix(setting.mass)[places]
        return change_si

    return change


def _mirrored(value: float, setting: Setting) -> Array:
    """Return the way (0 to 1) to the mirror image along z, by which one side becomes the other."""
    parameters = parameters_from_matrix(setting.mass)
    change = np.zeros(10)
    change[_ODD_IN_Z] = -2.0 * value * parameters[_ODD_IN_Z]
    return change


def _time(setting: Setting) -> Array:
    """Return time over the measurement, -0.5 to 0.5: lines are measured in their order."""
    return np.linspace(-0.5, 0.5, setting.lines.count)


def _step(share: float) -> Callable[[Setting], Array]:
    """Return a step of one, of mean zero, after a share of the lines, or where a run begins close by."""

    def shape(setting: Setting) -> Array:
        count = setting.lines.count
        at = share * count
        starts = [start for start in setting.lines.run_starts if abs(start - at) <= 0.5 * count / _PARTS]
        after = (np.arange(count) >= (starts[0] if starts else round(at))).astype(float)
        return np.asarray(after - np.mean(after))

    return shape


def _level(setting: Setting) -> Array:
    """Return the squared piston deflection over its mean, less one."""
    square = np.abs(setting.lines.y[:, 1] - setting.lines.y[:, 1 + DOFS]) ** 2
    return np.asarray(square / np.mean(square) - 1.0)


def _delayed(value: float, omega: Array) -> ComplexArray:
    return np.asarray(np.exp(1e-6j * value * omega))


def _turned(value: float, omega: Array) -> ComplexArray:
    return np.full(len(omega), np.exp(1j * np.radians(value)))


def _gained(value: float, omega: Array) -> ComplexArray:
    return np.full(len(omega), 1.0 + 0.01 * value, dtype=complex)


def _step_at(part: float) -> tuple[str, Callable[[Setting], Apply]]:
    """Return the name, that of the family's next place, and the term of a step after a part of the lines."""
    nearest = min(max(round(part), 1), _PARTS - 1)
    return f"step_at_{round(100.0 * nearest / _PARTS)}_percent", _ligament(_step(part / _PARTS))


def _stepped(part: int) -> Cause:
    title = (
        f"a step of the stiffness after {round(100.0 * part / _PARTS)} % of the lines, or between runs there"
    )

    def moved(off: float) -> tuple[str, Callable[[Setting], Apply]]:
        return _step_at(part + off)

    return Cause(title, "%", 0.01, _step_at(part)[1], family="step", moved=moved)


def _elsewhere(axis: str) -> Cause:
    title, apply = f"a centre of mass elsewhere along {axis}", _mass(_centre("xyz".index(axis)))
    usual = calibrated("causes.usual_centre_mm")
    return Cause(title, "mm", 1e-3, apply, example=0.1, usual=usual)


CAUSES: dict[str, Cause] = {
    "delay": Cause("a delay of the stapes against the base", "us", 1e-6, _between_bodies(_delayed)),
    "phase": Cause(
        "a phase between stapes and base",
        "degrees",
        np.pi / 180.0,
        _between_bodies(_turned),
        example=0.5,
    ),
    "gain": Cause("a gain between stapes and base", "%", 0.01, _between_bodies(_gained)),
    "fluid": Cause(
        "a mass of fluid that moves with the piston deflection",
        MASS.symbol,
        MASS.si(1.0),
        _fluid((0,)),
        starts=(0.0, MASS.of(3e-6)),
        positive=True,
    ),
    "head_mass": Cause(
        "a mass at the head of the stapes",
        MASS.symbol,
        MASS.si(1.0),
        _head_mass,
        example=MASS.of(1e-7),
        starts=(0.0, MASS.of(4e-6)),
        nuisances=(HEAD_PLACE,) * 3,
        moves=_head_moves,
        positive=True,
        usual=MASS.of(calibrated("causes.usual_head_mass_kg")),
    ),
    "centre_x": _elsewhere("x"),
    "centre_y": _elsewhere("y"),
    "centre_z": _elsewhere("z"),
    "inertia": Cause(
        "moments of inertia of another size",
        "%",
        0.01,
        _mass(_part(slice(4, 10))),
        example=5.0,
        usual=calibrated("causes.usual_inertia"),
    ),
    "drift": Cause("a ligament that stiffens over the measurement", "%", 0.01, _ligament(_time)),
    **{_step_at(part)[0]: _stepped(part) for part in range(1, _PARTS)},
    "level": Cause("a stiffness that depends on the amplitude", "%", 0.01, _ligament(_level)),
    "law_power": Cause(
        "damping that rises with another power of the frequency",
        "",
        1.0,
        _law(lambda omega: 1j * omega * np.log(1j * omega)),
        refitted=False,
    ),
    "law_relaxation": Cause(
        "a ligament that relaxes (standard linear solid)",
        "",
        1.0,
        _law(lambda omega: omega**2 + 0j),
        refitted=False,
    ),
    **{
        f"holder_{round(hz)}_hz": Cause(
            f"a resonance of the holder near {round(hz)} Hz", "%", 0.01, _holder(hz), family="holder"
        )
        for hz in _HOLDERS_HZ
    },
    "mass": Cause(
        "another mass and density", "%", 0.01, _mass(_part(slice(0, 10))), scored=False, example=10.0
    ),
    "mirrored": Cause(
        "the mass matrix of the mirror image (another side, or slices in reverse order)",
        "",
        1.0,
        _mass(_mirrored),
        only=1.0,
    ),
}
"""By name; `fitting.causes.diagnosis` ranks them by evidence."""


def places_of(name: str) -> int:
    """Return among how many places the likeliest of a cause's family is chosen."""
    family = CAUSES[name].family
    return 1 if not family else sum(cause.family == family for cause in CAUSES.values())
