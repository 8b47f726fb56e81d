"""The catalogue of causes: each changes motion, mass matrix or ligament by one unknown of a joint fit.

A cause is one entry of CAUSES. Scores, refits, naming, the effect on K and D, page and kd.json follow.
``--correct`` takes those of `fitting.options.CORRECT`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from legacy.fitting.calibrated import calibrated
from legacy.fitting.causes.mass_errors import (
    HEAD_PLACE,
    changed_inertia,
    displaced,
    head_mass,
    head_moves,
    mirrored,
    share,
)
from legacy.fitting.causes.setting import Applied, Apply, Setting
from legacy.fitting.ligament.equations import Equations, Term
from legacy.fitting.ligament.joint_lines import DOFS, JointLines
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.page.quantities import MASS, MILLIGRAM, ShownUnit

_HOLDER_QUALITY = 10.0
# Steps of one width of a resonance at half power.
_HOLDERS_HZ = np.geomspace(450.0, 5000.0, 26)
# Parts of the measurement between which K and D may change: the best of these steps explains at least 0.88 of
# what one at any place does, a drift 0.75.
_PARTS = 16


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
        False: it is scored only; the damping law that it stands for is fitted itself.
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


def shown_unit(unit: str) -> ShownUnit:
    """Return the unit in which people see sizes of causes that have a unit of kd.json; `of` converts."""
    if unit == MILLIGRAM.symbol:
        return ShownUnit(MASS.symbol, MASS.of(MILLIGRAM.si(1.0)))
    return ShownUnit(unit, 1.0)


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
            unit[place, place] = MILLIGRAM.si(1.0) * arm / setting.lines.root_mass[rows[place]] ** 2

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


def _delay(value: float, omega: Array) -> ComplexArray:
    return np.asarray(np.exp(1e-6j * value * omega))


def _turn(value: float, omega: Array) -> ComplexArray:
    return np.full(len(omega), np.exp(1j * np.radians(value)))


def _gain(value: float, omega: Array) -> ComplexArray:
    return np.full(len(omega), 1.0 + 0.01 * value, dtype=complex)


def _step_at(part: float) -> tuple[str, Callable[[Setting], Apply]]:
    """Return the name, that of the family's next place, and the term of a step after a part of the lines."""
    nearest = min(max(round(part), 1), _PARTS - 1)
    return f"step_at_{round(100.0 * nearest / _PARTS)}_percent", _ligament(_step(part / _PARTS))


def _step_cause(part: int) -> Cause:
    title = (
        f"a step of the stiffness after {round(100.0 * part / _PARTS)} % of the lines, or between runs there"
    )

    def moved(off: float) -> tuple[str, Callable[[Setting], Apply]]:
        return _step_at(part + off)

    return Cause(title, "%", 0.01, _step_at(part)[1], family="step", moved=moved)


def _centre_cause(axis: str) -> Cause:
    title, apply = f"a centre of mass elsewhere along {axis}", changed_inertia(displaced("xyz".index(axis)))
    usual = calibrated("causes.usual_centre_mm")
    return Cause(title, "mm", 1e-3, apply, example=0.1, usual=usual)


CAUSES: dict[str, Cause] = {
    "delay": Cause("a delay of the stapes against the base", "us", 1e-6, _between_bodies(_delay)),
    "phase": Cause(
        "a phase between stapes and base",
        "degrees",
        np.pi / 180.0,
        _between_bodies(_turn),
        example=0.5,
    ),
    "gain": Cause("a gain between stapes and base", "%", 0.01, _between_bodies(_gain)),
    "fluid": Cause(
        "a mass of fluid that moves with the piston deflection",
        MILLIGRAM.symbol,
        MILLIGRAM.si(1.0),
        _fluid((0,)),
        starts=(0.0, MILLIGRAM.of(3e-6)),
        positive=True,
    ),
    "head_mass": Cause(
        "a mass at the head of the stapes",
        MILLIGRAM.symbol,
        MILLIGRAM.si(1.0),
        head_mass,
        example=MILLIGRAM.of(1e-7),
        starts=(0.0, MILLIGRAM.of(4e-6)),
        nuisances=(HEAD_PLACE,) * 3,
        moves=head_moves,
        positive=True,
        usual=MILLIGRAM.of(calibrated("causes.usual_head_mass_kg")),
    ),
    "centre_x": _centre_cause("x"),
    "centre_y": _centre_cause("y"),
    "centre_z": _centre_cause("z"),
    "inertia": Cause(
        "moments of inertia of another size",
        "%",
        0.01,
        changed_inertia(share(slice(4, 10))),
        example=5.0,
        usual=calibrated("causes.usual_inertia"),
    ),
    "drift": Cause("a ligament that stiffens over the measurement", "%", 0.01, _ligament(_time)),
    **{_step_at(part)[0]: _step_cause(part) for part in range(1, _PARTS)},
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
        _law(lambda omega: (omega**2).astype(np.complex128)),
        refitted=False,
    ),
    **{
        f"holder_{round(hz)}_hz": Cause(
            f"a resonance of the holder near {round(hz)} Hz", "%", 0.01, _holder(hz), family="holder"
        )
        for hz in _HOLDERS_HZ
    },
    "mass": Cause(
        "another mass and density",
        "%",
        0.01,
        changed_inertia(share(slice(0, 10))),
        scored=False,
        example=10.0,
        usual=calibrated("causes.usual_mass"),
    ),
    "mirrored": Cause(
        "the mass matrix of the mirror image (another side, or slices in reverse order)",
        "",
        1.0,
        changed_inertia(mirrored),
        only=1.0,
    ),
}
"""By name; `fitting.causes.diagnosis` ranks them by evidence."""


def places_of(name: str) -> int:
    """Return among how many places the likeliest of a cause's family is chosen."""
    family = CAUSES[name].family
    return 1 if not family else sum(cause.family == family for cause in CAUSES.values())
