"""A table of what goes wrong at a vibrometer: each fault changes the true state and nothing that is reported.

A fault is put in by its kind; new kinds are one function with a decorator.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array, ComplexArray
from stapeskit.frames import rotation_from_vector


@dataclass(frozen=True, kw_only=True)
class MeasurementFault:
    """One fault; what is left open is drawn.

    Attributes
    ----------
    kind : str
        One of KINDS.
    size : float or None
        In the unit that `KINDS` names; None: the usual size.
    body, point, laser
        Where it is. An empty point or a laser of -1 is drawn.
    other : str
        The second point of an exchange.
    """

    kind: str
    size: float | None = None
    body: str = "stapes"
    point: str = ""
    laser: int = -1
    other: str = ""


@dataclass
class TrueState:
    """The true state of a measurement, which a fault changes.

    Attributes
    ----------
    freq_hz : ndarray, (L,)
    body, point, laser : (C,)
    place_mm, beam : ndarray, (C, 3)
        Footplate axes.
    motion_m : dict of str to ndarray, (R, L, 6), complex
    factor : ndarray, (C, L), complex
        Multiplies the signal.
    loud : ndarray, (C,)
        Multiplies the noise, not what is stated of it.
    unit : ndarray, (C,)
        Multiplies the noise and what is stated of it.
    added : ndarray, (R, C, L), complex
        Velocity that no rigid motion makes, m/s.
    order : ndarray, (C,)
        Channel whose signal stands in each channel.
    culprits : dict of int to str
        Channels at fault, each with the right verdict.
    """

    rng: np.random.Generator
    freq_hz: Array
    body: tuple[str, ...]
    point: tuple[str, ...]
    laser: Array
    place_mm: Array
    beam: Array
    motion_m: dict[str, ComplexArray]
    runs: int
    factor: ComplexArray = field(init=False)
    loud: Array = field(init=False)
    unit: Array = field(init=False)
    added: ComplexArray = field(init=False)
    order: NDArray[np.int64] = field(init=False)
    conjugated: bool = False
    culprits: dict[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        channels, lines = len(self.body), len(self.freq_hz)
        self.factor = np.ones((channels, lines), dtype=complex)
        self.loud = np.ones(channels)
        self.unit = np.ones(channels)
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

    def live(self) -> Array:
        """Return 0 for channels that hold zeros only, else 1, (C, 1)."""
        return np.asarray(np.any(self.factor != 0.0, axis=1, keepdims=True), dtype=float)

    def of(self, body: str = "", point: str = "", laser: int = -1) -> list[int]:
        """Return the channels of a body, point and laser; empty and -1 stand for all.

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

    def level(self) -> float:
        """Return the root mean square of all readings, m/s."""
        return float(np.sqrt(np.mean(np.abs(self.readings()) ** 2)))


Factor = Callable[[Array, float], Any]
Maker = Callable[[TrueState, MeasurementFault, float], tuple[Sequence[int], str]]
KINDS: dict[str, tuple[Maker, float, str]] = {}
"""Faults by kind: what puts one in and returns channels and verdict; the usual size; what a size is."""


def _kind(name: str, usual: float = 0.0, unit: str = "") -> Callable[[Maker], Maker]:
    def enter(maker: Maker) -> Maker:
        KINDS[name] = (maker, usual, unit)
        return maker

    return enter


def apply_fault(state: TrueState, fault: MeasurementFault) -> None:
    """Put a fault into the true state and enter its culprits.

    Raises
    ------
    ValueError
        The kind is unknown, or there is no such body, point or laser.
    """
    if fault.kind not in KINDS:
        raise ValueError(f"the fault must be one of {', '.join(KINDS)}; got {fault.kind}.")
    maker, usual, _ = KINDS[fault.kind]
    channels, verdict = maker(state, fault, usual if fault.size is None else fault.size)
    state.culprits |= dict.fromkeys((int(channel) for channel in channels), verdict)


def _channel(state: TrueState, fault: MeasurementFault) -> int:
    return int(state.rng.choice(state.of(fault.body, fault.point, fault.laser)))


def _point(state: TrueState, fault: MeasurementFault) -> list[int]:
    point = fault.point or str(state.rng.choice(state.points_of(fault.body)))
    return state.of(fault.body, point)


def _laser(state: TrueState, fault: MeasurementFault) -> list[int]:
    laser = fault.laser if fault.laser >= 0 else int(state.rng.integers(int(state.laser.max()) + 1))
    return state.of("", "", laser)


def _unit(rng: np.random.Generator) -> Array:
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


def _tilt(state: TrueState, channels: list[int], angle_deg: float) -> None:
    across = np.cross(state.beam[channels[0]], _unit(state.rng))
    turn = rotation_from_vector(np.radians(angle_deg) * across / np.linalg.norm(across))
    state.beam[channels] = state.beam[channels] @ turn.T


_FACTORS: dict[str, tuple[float, str, str, Factor]] = {
    "gain": (0.05, "relative", "gain", lambda _, size: 1.0 + size),
    "phase": (3.0, "degrees", "gain", lambda _, size: np.exp(1j * np.radians(size)) + 0.0),
    "delay": (1e-5, "s", "gain", lambda freq, size: np.exp(-2j * np.pi * freq * size)),
    "sign": (0.0, "", "sign", lambda _, __: -1.0),
    "drift": (
        0.06,
        "relative, first to last line",
        "drift",
        lambda f, s: 1.0 + s * np.linspace(0, 1, len(f)),
    ),
    "zeros": (0.0, "", "zeros", lambda _, __: 0.0),
}
_WHERE: dict[str, Callable[[TrueState, MeasurementFault], list[int]]] = {
    "": lambda state, fault: [_channel(state, fault)],
    "point_": _point,
    "laser_": _laser,
    "body_": lambda state, fault: state.of(fault.body),
}


def _enter_factors() -> None:
    """Enter each factor for a channel, a point, a laser and a body."""
    for name, (usual, unit, verdict, factor) in _FACTORS.items():
        for prefix, where in _WHERE.items():

            def make(
                state: TrueState,
                fault: MeasurementFault,
                size: float,
                where: Callable[[TrueState, MeasurementFault], list[int]] = where,
                factor: Factor = factor,
                verdict: str = verdict,
            ) -> tuple[Sequence[int], str]:
                channels = where(state, fault)
                state.factor[channels] *= factor(state.freq_hz, size)
                return channels, verdict

            KINDS[prefix + name] = (make, usual, unit)


_enter_factors()


@_kind("noise", 4.0, "times the stated standard deviation")
def _loud(state: TrueState, fault: MeasurementFault, size: float) -> tuple[Sequence[int], str]:
    channel = _channel(state, fault)
    state.loud[channel] *= size
    return [channel], "noise"


@_kind("direction", 4.0, "degrees")
def _direction(state: TrueState, fault: MeasurementFault, size: float) -> tuple[Sequence[int], str]:
    channel = _channel(state, fault)
    _tilt(state, [channel], size)
    return [channel], "direction"


@_kind("laser_direction", 3.0, "degrees")
def _laser_direction(state: TrueState, fault: MeasurementFault, size: float) -> tuple[Sequence[int], str]:
    channels = _laser(state, fault)
    _tilt(state, channels, size)
    return channels, "direction"


@_kind("axes", 2.0, "degrees that all beams are turned")
def _axes(state: TrueState, _: MeasurementFault, size: float) -> tuple[Sequence[int], str]:
    channels = state.of()
    state.beam = state.beam @ rotation_from_vector(np.radians(size) * _unit(state.rng)).T
    return channels, "direction"


@_kind("position", 0.2, "mm")
def _position(state: TrueState, fault: MeasurementFault, size: float) -> tuple[Sequence[int], str]:
    channels = _point(state, fault)
    state.place_mm[channels] += size * _unit(state.rng)
    return channels, "position"


@_kind("coordinates")
def _coordinates(state: TrueState, fault: MeasurementFault, _: float) -> tuple[Sequence[int], str]:
    """Exchange x and z of a point."""
    channels = _point(state, fault)
    state.place_mm[channels] = state.place_mm[channels][:, [2, 1, 0]]
    return channels, "position"


def _exchange(state: TrueState, groups: Sequence[list[int]]) -> tuple[list[int], str]:
    """Let the signal of each group of channels stand in the group before it."""
    into = np.concatenate(groups)
    state.order[into] = state.order[np.concatenate([*groups[1:], groups[0]])]
    return [int(channel) for channel in into], "label_swap"


def _some_points(state: TrueState, fault: MeasurementFault, count: int) -> list[list[int]]:
    """Return channels of named points, and of drawn ones up to a count."""
    names = [name for name in (fault.point, fault.other) if name][:count]
    rest = [name for name in state.points_of(fault.body) if name not in names]
    drawn = state.rng.permutation(rest)[: count - len(names)]
    return [state.of(fault.body, str(name)) for name in (*names, *drawn)]


@_kind("label_swap")
def _label_swap(state: TrueState, fault: MeasurementFault, _: float) -> tuple[Sequence[int], str]:
    return _exchange(state, _some_points(state, fault, 2))


@_kind("label_cycle")
def _label_cycle(state: TrueState, fault: MeasurementFault, _: float) -> tuple[Sequence[int], str]:
    return _exchange(state, _some_points(state, fault, 3))


@_kind("beams_swap")
def _beams_swap(state: TrueState, fault: MeasurementFault, _: float) -> tuple[Sequence[int], str]:
    """Exchange two beams of a point."""
    one, two = state.rng.choice(_point(state, fault), 2, replace=False)
    return _exchange(state, [[int(one)], [int(two)]])


@_kind("body_exchange")
def _body_exchange(state: TrueState, fault: MeasurementFault, _: float) -> tuple[Sequence[int], str]:
    """Exchange a point of the body with one (``other``) of another body."""
    other = next(body for body in dict.fromkeys(state.body) if body != fault.body)
    second = fault.other or str(state.rng.choice(state.points_of(other)))
    return _exchange(state, [_point(state, fault), state.of(other, second)])


@_kind("bodies_exchanged")
def _bodies_exchanged(state: TrueState, _: MeasurementFault, __: float) -> tuple[Sequence[int], str]:
    """Let each body move as the other does: their names are exchanged."""
    one, two = list(dict.fromkeys(state.body))[:2]
    state.motion_m[one], state.motion_m[two] = state.motion_m[two], state.motion_m[one]
    return state.of(), "label_swap"


@_kind("range", 2.0, "factor of the points")
def _range(state: TrueState, fault: MeasurementFault, size: float) -> tuple[Sequence[int], str]:
    """Read a few points of a body, noise and all, in another range."""
    names = state.points_of(fault.body)
    few = state.rng.permutation(names)[: int(state.rng.integers(2, max((len(names) - 1) // 2, 2) + 1))]
    channels = [channel for name in few for channel in state.of(fault.body, str(name))]
    state.factor[channels] *= size
    state.loud[channels] *= abs(size)
    return channels, "gain"


@_kind("body_unit", 1e3, "factor of a body: 1000 for mm/s, 0.7071 for rms, 5 for another range")
def _body_unit(state: TrueState, fault: MeasurementFault, size: float) -> tuple[Sequence[int], str]:
    channels = state.of(fault.body)
    state.factor[channels] *= size
    state.unit[channels] *= abs(size)
    return channels, "gain"


@_kind("line_shift", 1.0, "lines that the signals of a body are too late")
def _line_shift(state: TrueState, fault: MeasurementFault, size: float) -> tuple[Sequence[int], str]:
    late = np.clip(np.arange(len(state.freq_hz)) - round(size), 0, len(state.freq_hz) - 1)
    ratio = (state.freq_hz[late] / state.freq_hz)[:, None]
    state.motion_m[fault.body] = state.motion_m[fault.body][:, late] * ratio
    return state.of(fault.body), "drift"


@_kind("conjugate")
def _conjugate(state: TrueState, _: MeasurementFault, __: float) -> tuple[Sequence[int], str]:
    """Write all channels in the e^{-i w t} convention."""
    state.conjugated = not state.conjugated
    return state.of(), "sign"


@_kind("flexible", 0.06, "bending over the root mean square of all readings")
def _flexible(state: TrueState, fault: MeasurementFault, size: float) -> tuple[Sequence[int], str]:
    """Add the first bending of a free bar along the longest axis of a body, with its own resonance."""
    channels = state.of(fault.body)
    places = state.place_mm[channels]
    along = places[:, int(np.argmax(np.ptp(places, axis=0)))]
    away = along - along.mean()
    bend = ((away / np.abs(away).max()) ** 2 - 0.3) * (state.beam[channels] @ _unit(state.rng))
    ratio = state.freq_hz / 5200.0
    added = np.outer(bend, 1.0 / (1.0 - ratio**2 + 0.1j * ratio))
    state.added[:, channels] += size * state.level() * added / np.sqrt(np.mean(np.abs(added) ** 2))
    return channels, "flexible"


@_kind("drying", 0.03, "relative change of the motion of a body over its points")
def _drying(state: TrueState, fault: MeasurementFault, size: float) -> tuple[Sequence[int], str]:
    """Let resonances rise while the points are measured one after the other: q(f) becomes q(f / s)."""
    names, freq = state.points_of(fault.body), state.freq_hz
    clean = state.readings()
    for number, name in enumerate(names):
        stretch = 1.0 / np.sqrt(1.0 + size * number / max(len(names) - 1, 1))
        for channel in state.of(fault.body, name):
            for run in range(state.runs):
                moved = np.interp(freq * stretch, freq, clean[run, channel])
                state.added[run, channel] += moved - clean[run, channel]
    return state.of(fault.body), "drift"


@_kind(
    "holder", 0.02, "relative size at low frequencies of a resonance that the body reads but does not have"
)
def _holder(state: TrueState, fault: MeasurementFault, size: float) -> tuple[Sequence[int], str]:
    """Let the holder of a body resonate at 2600 Hz: all its channels read a little too much."""
    channels = state.of(fault.body)
    ratio = state.freq_hz / 2600.0
    state.factor[channels] *= 1.0 + size / (1.0 - ratio**2 + 0.1j * ratio)
    return channels, "gain"
