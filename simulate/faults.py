"""A table of what goes wrong at a vibrometer: each fault changes the true state and nothing that is reported.

A fault is a line of `KINDS`: which channels it takes, and what it does to them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array, ComplexArray
from stapeskit.frames import rotation_from_vector


@dataclass(frozen=True, kw_only=True)
class MeasurementFault:
    """One fault; what is left open is drawn."""

    kind: str  # one of KINDS
    size: float | None = None  # in the unit that `KINDS` names; None: the usual size
    body: str = "stapes"  # where it is. An empty point or a laser of -1 is drawn
    point: str = ""
    laser: int = -1
    other: str = ""  # the second point of an exchange


@dataclass
class TrueState:
    """The true state of a measurement, which a fault changes."""

    rng: np.random.Generator
    freq_hz: Array  # (L,)
    body: tuple[str, ...]
    point: tuple[str, ...]
    laser: Array
    place_mm: Array  # (C, 3): Footplate axes
    beam: Array
    motion_m: dict[str, ComplexArray]  # (R, L, 6)
    runs: int
    factor: ComplexArray = field(init=False)  # (C, L): Multiplies the signal
    loud: Array = field(init=False)  # (C,): Multiplies the noise, not what is stated of it
    added: ComplexArray = field(init=False)  # (R, C, L): Velocity that no rigid motion makes, m/s
    order: NDArray[np.int64] = field(init=False)  # (C,): Channel whose signal stands in each channel
    conjugated: bool = False
    culprits: dict[int, str] = field(default_factory=dict)  # channels at fault, each with the right verdict

    def __post_init__(self) -> None:
        channels, lines = len(self.body), len(self.freq_hz)
        self.factor = np.ones((channels, lines), dtype=complex)
        self.loud = np.ones(channels)
        self.added = np.zeros((self.runs, channels, lines), dtype=complex)
        self.order = np.arange(channels)

    def readings(self) -> ComplexArray:
        """Return the velocity (R, C, L) along the true beams of the true places, m/s."""
        velocity = np.empty(self.added.shape, dtype=complex)
        for channel, body in enumerate(self.body):
            q = self.motion_m[body]
            moved = q[..., :3] + np.cross(q[..., 3:], self.place_mm[channel] * 1e-3)
            velocity[:, channel] = 2j * np.pi * self.freq_hz * (moved @ self.beam[channel])
        return velocity

    def faulty(self) -> ComplexArray:
        """Return what the channels hold with all faults, without noise, (R, C, L), m/s."""
        velocity = self.factor * (self.readings() + self.added)[:, self.order]
        return velocity.conj() if self.conjugated else velocity

    def of(self, body: str = "", point: str = "", laser: int = -1) -> list[int]:
        """Return the channels of a body, point and laser. An empty name, or -1, selects all.

        Raises
        ------
        ValueError
            There is no such channel.
        """
        found = [
            c
            for c in range(len(self.body))
            if body in ("", self.body[c]) and point in ("", self.point[c]) and laser in (-1, self.laser[c])
        ]
        if not found:
            raise ValueError(f"the recording has no channel of body {body}, point {point}, laser {laser}.")
        return found

    def points_of(self, body: str) -> list[str]:
        """Return the names of a body's points."""
        return list(dict.fromkeys(self.point[c] for c in self.of(body)))

    def unit_vector(self) -> Array:
        """Draw a direction (3,)."""
        vector = self.rng.standard_normal(3)
        return np.asarray(vector / np.linalg.norm(vector))


Where = Callable[[TrueState, MeasurementFault], list[int]]
Change = Callable[[TrueState, list[int], float], None]


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault."""

    verdict: str  # what its channels must be called
    where: Where  # which channels it takes
    change: Change  # what it does to them
    usual: float = 0.0  # its usual size
    unit: str = ""  # of the size


def apply_fault(state: TrueState, fault: MeasurementFault) -> None:
    """Put a fault into the true state and enter its culprits."""
    kind = KINDS[fault.kind]
    channels = kind.where(state, fault)
    kind.change(state, channels, kind.usual if fault.size is None else fault.size)
    state.culprits |= dict.fromkeys(channels, kind.verdict)


def _channel(state: TrueState, fault: MeasurementFault) -> list[int]:
    return [int(state.rng.choice(state.of(fault.body, fault.point, fault.laser)))]


def _point(state: TrueState, fault: MeasurementFault) -> list[int]:
    return state.of(fault.body, fault.point or str(state.rng.choice(state.points_of(fault.body))))


def _laser(state: TrueState, fault: MeasurementFault) -> list[int]:
    laser = fault.laser if fault.laser >= 0 else int(state.rng.integers(int(state.laser.max()) + 1))
    return state.of("", "", laser)


def _body(state: TrueState, fault: MeasurementFault) -> list[int]:
    return state.of(fault.body)


def _all(state: TrueState, _: MeasurementFault) -> list[int]:
    return state.of()


def _two_points(state: TrueState, fault: MeasurementFault) -> list[int]:
    """Return the channels of named points, and of drawn ones up to two."""
    names = [name for name in (fault.point, fault.other) if name]
    rest = [name for name in state.points_of(fault.body) if name not in names]
    drawn = state.rng.permutation(rest)[: 2 - len(names)]
    return [channel for name in (*names, *drawn) for channel in state.of(fault.body, str(name))]


def _two_beams(state: TrueState, fault: MeasurementFault) -> list[int]:
    one, two = state.rng.choice(_point(state, fault), 2, replace=False)
    return [int(one), int(two)]


def _multiply(factor: Callable[[Array, float], Any], state: TrueState, at: list[int], size: float) -> None:
    state.factor[at] *= factor(state.freq_hz, size)


def _louden(state: TrueState, at: list[int], size: float) -> None:
    state.loud[at] *= size


def _tilt(state: TrueState, at: list[int], size: float) -> None:
    across = np.cross(state.beam[at[0]], state.unit_vector())
    turn = rotation_from_vector(np.radians(size) * across / np.linalg.norm(across))
    state.beam[at] = state.beam[at] @ turn.T


def _turn_axes(state: TrueState, _: list[int], size: float) -> None:
    state.beam = state.beam @ rotation_from_vector(np.radians(size) * state.unit_vector()).T


def _shift(state: TrueState, at: list[int], size: float) -> None:
    state.place_mm[at] += size * state.unit_vector()


def _exchange(state: TrueState, at: list[int], _: float) -> None:
    """Exchange the signals of the first and the second half of the channels."""
    state.order[at] = state.order[np.roll(at, -len(at) // 2)]


def _conjugate(state: TrueState, _: list[int], __: float) -> None:
    """Write all channels in the e^{-i w t} convention."""
    state.conjugated = not state.conjugated


def _bend(state: TrueState, at: list[int], size: float) -> None:
    """Add the first bending of a free bar along the longest axis of a body, with its own resonance."""
    places = state.place_mm[at]
    along = places[:, int(np.argmax(np.ptp(places, axis=0)))]
    away = along - along.mean()
    bend = ((away / np.abs(away).max()) ** 2 - 0.3) * (state.beam[at] @ state.unit_vector())
    ratio = state.freq_hz / 5200.0
    added = np.outer(bend, 1.0 / (1.0 - ratio**2 + 0.1j * ratio))
    level = np.sqrt(np.mean(np.abs(state.readings()) ** 2))
    state.added[:, at] += size * level * added / np.sqrt(np.mean(np.abs(added) ** 2))


_SCOPES: dict[str, Where] = {"": _channel, "point_": _point, "laser_": _laser, "body_": _body}
_FACTORS: dict[str, tuple[str, Callable[[Array, float], Any], float, str]] = {
    "gain": ("gain", lambda _, size: 1.0 + size, 0.05, "relative"),
    "phase": ("gain", lambda _, size: np.exp(1j * np.radians(size)), 3.0, "degrees"),
    "delay": ("gain", lambda freq, size: np.exp(-2j * np.pi * freq * size), 1e-5, "s"),
    "sign": ("sign", lambda _, __: -1.0, 0.0, ""),
    "drift": ("drift", lambda f, size: 1.0 + size * np.linspace(0, 1, len(f)), 0.06, "at the last line"),
    "zeros": ("zeros", lambda _, __: 0.0, 0.0, ""),
}
KINDS: dict[str, FaultKind] = {
    f"{scope}{name}": FaultKind(verdict, where, partial(_multiply, factor), usual, unit)
    for name, (verdict, factor, usual, unit) in _FACTORS.items()
    for scope, where in _SCOPES.items()
} | {
    "noise": FaultKind("noise", _channel, _louden, 4.0, "times the stated standard deviation"),
    "direction": FaultKind("direction", _channel, _tilt, 4.0, "degrees"),
    "laser_direction": FaultKind("direction", _laser, _tilt, 3.0, "degrees"),
    "axes": FaultKind("direction", _all, _turn_axes, 2.0, "degrees that all beams are turned"),
    "position": FaultKind("position", _point, _shift, 0.2, "mm"),
    "label_swap": FaultKind("label_swap", _two_points, _exchange),
    "beams_swap": FaultKind("label_swap", _two_beams, _exchange),
    "conjugate": FaultKind("sign", _all, _conjugate),
    "flexible": FaultKind("flexible", _body, _bend, 0.06, "bending over the rms of all readings"),
}
"""Faults by kind."""
