"""The further unknowns of a fit: values that change the equations of motion, each a row of `UNKNOWNS`.

The likelihood, its derivatives, the search for causes, ``--unknowns``, kd.json and the page follow from the
row.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from stapeskit.arrays import Array, ComplexArray
from stapeskit.spatial import matrix_from_parameters, parameters_from_matrix

if TYPE_CHECKING:
    from fitting.data import Data

HEAD_M = np.array([0.0, 3.4e-3, 0.0])
"""Where a mass at the head sits: height of a human stapes, 3.2 to 3.8 mm (Sim et al. 2013, JARO 14:159)."""

_HEAD_STEP_M = 0.25e-3  # of the place of that mass, one standard deviation
_HOLDER_QUALITY = 10.0  # of a resonance of a holder: a loss factor of a tenth, chosen by judgement
_HOLDERS = 60  # places of a resonance in a band: steps of less than half a width at half power
_MOST_STEPS = 120  # places of a step
_ODD_IN_Z = [3, 8, 9]  # inertial parameters that a mirror image along z changes: m z, Jyz, Jxz


@dataclass
class Parts:
    """Parts of the equations, scaled, that unknowns change in place."""

    loss: ComplexArray  # (lines,) complex: s(w) of the damping law
    mass: Array  # (m, m)
    added: Array  # (n, n): mass on the deflection
    factor: Array  # (lines,): on K + s D
    structure: ComplexArray  # (lines,) complex: on the motion of the bodies as measured
    base: ComplexArray  # (lines,) complex: on the motion of the bodies as measured


Change = Callable[[float, Parts, "Data"], None]


@dataclass(frozen=True)
class Unknown:
    """One unknown."""

    name: str  # in ``--unknowns`` and kd.json
    title: str  # as written within a sentence
    unit: str  # of its value
    sd: float  # how large it is where it is there, in its unit; its prior is normal about zero
    change: Change  # takes value, parts and data
    chance: float = 0.02  # prior probability that it is there
    positive: bool = False  # whether it cannot be negative
    family: str = ""  # unknowns of one family are one error at different places
    # whether K and D are taken with it where it is the best explanation: an inherent part of some ears
    adopt: bool = False
    # further sizes from which a fit starts, where it may be far from first order
    starts: tuple[float, ...] = ()
    companions: tuple[Unknown, ...] = ()  # unknowns that come with it, e.g. its place
    # data -> what it multiplies K and D by a unit, (lines,), where it makes K and D change over the lines
    weights: Callable[[Data], Array] | None = None
    only: float | None = None  # the one value that it has where it is there
    held: float | None = None  # the value that it is fixed at

    def fixed(self, value: float) -> Unknown:
        """Return the unknown fixed at a value, with a narrow prior for its remainder."""

        def change(off: float, parts: Parts, data: Data) -> None:
            self.change(value + off, parts, data)

        free = replace(self, companions=(), positive=False, only=None)
        return replace(free, change=change, held=value, sd=1e-6 * self.sd)

    def beyond(self, value: float) -> Unknown:
        """Return what the unknown may be beyond a value that it is fixed at."""
        title = f"{self.title} beyond the {value:g} {self.unit}".rstrip() + " that it is fixed at"
        free = replace(self, companions=(), positive=False, only=None)
        return replace(free, title=title, starts=(), adopt=False)


def _on_structure(factor: Callable[[float, Array], ComplexArray]) -> Change:
    """Multiply the motion of the structure by factor(value, w in rad/s)."""

    def change(value: float, parts: Parts, data: Data) -> None:
        parts.structure = parts.structure * factor(value, data.omega * data.reference)

    return change


def _on_mass(added: Callable[[float, Array], Array]) -> Change:
    """Add inertial parameters, SI: added(value, own ten parameters)."""

    def change(value: float, parts: Parts, data: Data) -> None:
        root = np.outer(data.root_mass, data.root_mass)
        own = parameters_from_matrix(data.mass * root)
        parts.mass = parts.mass + matrix_from_parameters(added(value, own)) / root

    return change


def _of_ligament(name: str, title: str, shape: Callable[[Data], Array], family: str = "") -> Unknown:
    """Return an unknown that multiplies K and D by 1 + value % times shape(data)."""

    def change(value: float, parts: Parts, data: Data) -> None:
        parts.factor = parts.factor * (1.0 + 0.01 * value * shape(data))

    return Unknown(name, title, "%", 10.0, change, family=family, weights=shape)


def _fluid(value: float, parts: Parts, data: Data) -> None:
    """Add a mass (mg) on the piston deflection."""
    added = np.zeros_like(parts.added)
    place = data.dof.index("y") if "y" in data.dof else 0
    added[place, place] = 1e-6 * value / data.root_mass[data.rows[place]] ** 2
    parts.added = parts.added + added


def point(place: Array, mass: float = 1.0) -> Array:
    """Return the ten inertial parameters of a mass (kg) at a place (m)."""
    tensor = place @ place * np.eye(3) - np.outer(place, place)
    return mass * np.array([1.0, *place, *tensor[[0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]]])


def _head_moved(axis: int, value: float, parts: Parts, data: Data) -> None:
    """Move the mass at the head along an axis, to first order in the step."""
    mass = (parts.mass - data.mass)[0, 0] * data.root_mass[0] ** 2
    step = _HEAD_STEP_M * value * np.eye(3)[axis]
    _on_mass(lambda _v, _own: 0.5 * mass * (point(HEAD_M + step) - point(HEAD_M - step)))(0.0, parts, data)


def _centre_moved(axis: int, value: float, own: Array) -> Array:
    """Move the centre of mass by mm; moments of inertia follow by the theorem of parallel axes."""
    centre = own[1:4] / own[0]
    return np.asarray(own[0] * (point(centre + 1e-3 * value * np.eye(3)[axis]) - point(centre)))


def _larger_moments(value: float, own: Array) -> Array:
    return np.concatenate([np.zeros(4), 0.01 * value * own[4:]])


def _mirrored(value: float, own: Array) -> Array:
    change = np.zeros(10)
    change[_ODD_IN_Z] = -2.0 * value * own[_ODD_IN_Z]
    return change


def _time(data: Data) -> Array:
    """Return time over the measurement, -0.5 to 0.5: lines are measured in their order."""
    return np.linspace(-0.5, 0.5, data.count)


def _step(line: int, data: Data) -> Array:
    """Return a step of one, of mean zero, after a line."""
    after = (np.arange(data.count) >= line).astype(float)
    return np.asarray(after - after.mean())


def _squared_deflection(data: Data) -> Array:
    """Return the squared piston deflection over its mean, less one."""
    piston, m = data.rows[0], len(data.measured)
    square = np.abs(data.y[:, piston] - data.y[:, m + piston]) ** 2
    return np.asarray(square / square.mean() - 1.0)


def _holder(frequency_hz: float, value: float, parts: Parts, data: Data) -> None:
    """Add a resonance of the holder, ``value`` in %, to the motion of the base."""
    ratio = data.freq_hz / frequency_hz
    shape = (1.0 / _HOLDER_QUALITY) / (1.0 - ratio**2 + 1j * ratio / _HOLDER_QUALITY)
    parts.base = parts.base * (1.0 + 0.01 * value * shape)


_DELAY = _on_structure(lambda value, omega: np.exp(1e-6j * value * omega))
_PHASE = _on_structure(lambda value, omega: np.full(len(omega), np.exp(1j * np.radians(value))))
_GAIN = _on_structure(lambda value, omega: np.full(len(omega), 1.0 + 0.01 * value, dtype=complex))
_OF_MASS = (
    Unknown(
        "head_mass", "a mass at the head of the stapes", "mg", 5.0,
        _on_mass(lambda value, _own: point(HEAD_M, 1e-6 * value)), positive=True, starts=(4.0,),
        companions=tuple(
            Unknown(f"head_mass_{axis}", "", "", 1.0, partial(_head_moved, place))
            for place, axis in enumerate("xyz")
        ),
    ),
    *(
        Unknown(
            f"centre_{axis}", f"a centre of mass elsewhere along {axis}", "mm", 0.2,
            _on_mass(partial(_centre_moved, place)),
        )
        for place, axis in enumerate("xyz")
    ),
    Unknown("inertia", "moments of inertia of another size", "%", 25.0, _on_mass(_larger_moments)),
    Unknown("mirrored", "the mass matrix of the other side", "", 1.0, _on_mass(_mirrored), 0.01, only=1.0),
)  # fmt: skip
UNKNOWNS: dict[str, Unknown] = {
    unknown.name: unknown
    for unknown in (
        Unknown("delay", "a delay of the stapes against the base", "us", 2.0, _DELAY),
        Unknown("phase", "a phase between stapes and base", "degrees", 1.0, _PHASE),
        Unknown("gain", "a gain between stapes and base", "%", 3.0, _GAIN),
        Unknown(
            "fluid", "a mass of fluid that moves with the piston", "mg", 1.5, _fluid,
            positive=True, adopt=True, starts=(3.0,),
        ),
        *_OF_MASS,
        _of_ligament("drift", "a ligament that stiffens over the measurement", _time),
        _of_ligament("nonlinear", "a stiffness that depends on the amplitude", _squared_deflection),
    )
}  # fmt: skip
"""By name. ``--unknowns`` takes them; places of steps and resonances are added from the data."""


def candidates(data: Data) -> list[Unknown]:
    """Return every unknown that is searched for in some data, with the places of those that have one."""
    whole = len(data.mass_known) == len(data.measured) == 6
    table = [unknown for unknown in UNKNOWNS.values() if whole or unknown not in _OF_MASS]
    lines = np.unique(np.linspace(0, data.count, min(_MOST_STEPS, data.count) + 1).astype(int))[4:-4]
    starts = np.flatnonzero(np.diff(data.run)) + 1
    for line in np.union1d(lines, starts).tolist():
        where = f"after {100.0 * line / data.count:.0f} % of the lines"
        title = f"a step of the stiffness {'between two runs' if line in starts else where}"
        table.append(_of_ligament(f"step_{line}", title, partial(_step, line), "step"))
    for hz in np.geomspace(1.1 * data.freq_hz.min(), data.freq_hz.max(), _HOLDERS):
        title = f"a resonance of the holder near {hz:.0f} Hz"
        change = partial(_holder, float(hz))
        table.append(Unknown(f"holder_{hz:.0f}_hz", title, "%", 5.0, change, family="holder"))
    return table
