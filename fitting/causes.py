"""The table of the fit's further unknowns, `UNKNOWNS`: possible errors with prior size and probability."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from fitting.data import Data
from fitting.unknowns import Parts, Unknown, on_ligament, on_mass, on_structure
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import StapeskitError

HEAD_M = np.array([0.0, 3.4e-3, 0.0])
"""Where a mass at the head sits: height of a human stapes, 3.2 to 3.8 mm (Sim et al. 2013, JARO 14:159)."""

_HEAD_STEP_M = 0.25e-3  # of the place of that mass, one standard deviation
_HOLDER_QUALITY = 10.0
_HOLDERS = 60  # places of a resonance in a band: steps of less than half a width at half power
_MOST_STEPS = 120  # places of a step
_ODD_IN_Z = [3, 8, 9]  # inertial parameters that a mirror image along z changes: m z, Jyz, Jxz


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


def _head(value: float, _own: Array) -> Array:
    return point(HEAD_M, 1e-6 * value)


def _head_moved(axis: int) -> Callable[[float, Parts, Data], None]:
    """Return a change that moves the mass at the head along an axis, to first order in the step."""

    def change(value: float, parts: Parts, data: Data) -> None:
        mass = (parts.mass - data.mass)[0, 0] * data.root_mass[0] ** 2
        step = _HEAD_STEP_M * value * np.eye(3)[axis]
        on_mass(lambda _v, _own: 0.5 * mass * (point(HEAD_M + step) - point(HEAD_M - step)))(0.0, parts, data)

    return change


def _centre_moved(axis: int, value: float, own: Array) -> Array:
    """Move the centre of mass by mm; moments of inertia follow by the theorem of parallel axes."""
    centre = own[1:4] / own[0]
    return np.asarray(own[0] * (point(centre + 1e-3 * value * np.eye(3)[axis]) - point(centre)))


def _share(places: slice, value: float, own: Array) -> Array:
    change = np.zeros(10)
    change[places] = 0.01 * value * own[places]
    return change


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


def _level(data: Data) -> Array:
    """Return the squared piston deflection over its mean, less one."""
    piston, m = data.rows[0], len(data.measured)
    square = np.abs(data.y[:, piston] - data.y[:, m + piston]) ** 2
    return np.asarray(square / square.mean() - 1.0)


def _holder(frequency_hz: float, value: float, parts: Parts, data: Data) -> None:
    """Add a resonance of the holder (%) to the motion of the base."""
    ratio = data.freq_hz / frequency_hz
    shape = (1.0 / _HOLDER_QUALITY) / (1.0 - ratio**2 + 1j * ratio / _HOLDER_QUALITY)
    parts.base = parts.base * (1.0 + 0.01 * value * shape)


def _delay(value: float, omega: Array) -> ComplexArray:
    return np.asarray(np.exp(1e-6j * value * omega))


def _phase(value: float, omega: Array) -> ComplexArray:
    return np.full(len(omega), np.exp(1j * np.radians(value)))


def _gain(value: float, omega: Array) -> ComplexArray:
    return np.full(len(omega), 1.0 + 0.01 * value, dtype=complex)


def _head_unknown() -> Unknown:
    places = tuple(
        Unknown(f"head_mass_{axis}", "", "", 1.0, _head_moved(place)) for place, axis in enumerate("xyz")
    )
    change, title = on_mass(_head), "a mass at the head of the stapes"
    return Unknown("head_mass", title, "mg", 5.0, change, positive=True, starts=(4.0,), companions=places)


UNKNOWNS: dict[str, Unknown] = {
    unknown.name: unknown
    for unknown in (
        Unknown("delay", "a delay of the stapes against the base", "us", 2.0, on_structure(_delay)),
        Unknown("phase", "a phase between stapes and base", "degrees", 1.0, on_structure(_phase)),
        Unknown("gain", "a gain between stapes and base", "%", 3.0, on_structure(_gain)),
        Unknown(
            "fluid", "a mass of fluid that moves with the piston", "mg", 1.5, _fluid,
            positive=True, adopt=True, starts=(3.0,),
        ),
        _head_unknown(),
        *(
            Unknown(
                f"centre_{axis}", f"a centre of mass elsewhere along {axis}", "mm", 0.2,
                on_mass(partial(_centre_moved, place)),
            )
            for place, axis in enumerate("xyz")
        ),
        Unknown(
            "inertia", "moments of inertia of another size", "%", 25.0, on_mass(partial(_share, slice(4, 10)))
        ),
        Unknown("mirrored", "the mass matrix of the other side", "", 1.0, on_mass(_mirrored), 0.01, only=1.0),
        Unknown(
            "drift", "a ligament that stiffens over the measurement", "%", 10.0, on_ligament(_time),
            weights=_time,
        ),
        Unknown(
            "level", "a stiffness that depends on the amplitude", "%", 10.0, on_ligament(_level),
            weights=_level,
        ),
    )
}  # fmt: skip
"""By name. ``--unknowns`` takes them; places of steps and resonances are added from the data."""


def candidates(data: Data) -> list[Unknown]:
    """Return every unknown that is searched for in some data, with the places of those that have one."""
    table = list(UNKNOWNS.values())
    if len(data.mass_known) != 6 or len(data.measured) != 6:
        table = [unknown for unknown in table if unknown.name not in _OF_MASS]
    lines = np.unique(np.linspace(0, data.count, min(_MOST_STEPS, data.count) + 1).astype(int))[4:-4]
    starts = np.flatnonzero(np.diff(data.run)) + 1
    for line in np.union1d(lines, starts).tolist():
        shape = partial(_step, line)
        where = f"after {100.0 * line / data.count:.0f} % of the lines"
        title = f"a step of the stiffness {'between two runs' if line in starts else where}"
        step = Unknown(f"step_{line}", title, "%", 10.0, on_ligament(shape), family="step", weights=shape)
        table.append(step)
    ends = 1.1 * data.freq_hz.min(), data.freq_hz.max()
    for hz in np.geomspace(*ends, _HOLDERS):
        title = f"a resonance of the holder near {hz:.0f} Hz"
        change = partial(_holder, float(hz))
        table.append(Unknown(f"holder_{hz:.0f}_hz", title, "%", 5.0, change, family="holder"))
    return table


_OF_MASS = ("head_mass", "centre_x", "centre_y", "centre_z", "inertia", "mirrored")


def chosen(names: tuple[str, ...]) -> tuple[Unknown, ...]:
    """Return the unknowns of ``--unknowns``.

    Raises
    ------
    StapeskitError
        There is no unknown of a name.
    """
    wrong = [name for name in names if name not in UNKNOWNS]
    if wrong:
        raise StapeskitError.of("--unknowns", f"names out of {', '.join(UNKNOWNS)}", ", ".join(wrong))
    return tuple(UNKNOWNS[name] for name in dict.fromkeys(names))
