"""The catalogue of faults with a size: each kind is one entry, from its tangents to its sentence.

To add a kind, add an entry to KINDS; what has no size is an entry of ``alternatives.ALTERNATIVES``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from legacy.kinematics.faults import sentences
from legacy.kinematics.faults.packed_readings import Assumed, Packed
from legacy.kinematics.faults.score_information import (
    AXES,
    DELAY,
    DRIFT,
    DRIFT_IMAGINARY,
    IMAGINARY,
    REAL,
    SHIFTS,
    TURNS,
    Model,
    perpendicular_axes,
)
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.frames import rotation_from_vector

Moved = tuple[Array, Array]


@dataclass(frozen=True)
class Kind:
    """One kind of fault.

    Attributes
    ----------
    owners : tuple of str
        What can have it: ``channel``, ``point``, ``laser`` (all beams of one direction), ``body``.
    tangents : tuple of int
        How the readings change with each parameter: out of REAL to AXES of ``score_information``.
    prior : tuple of float
        How large each parameter commonly is; lengths in levers of the body.
    sentence : callable
        A fit of the fault and the body to verdict and estimate in words.
    factor : callable, optional
        Parameters, place (-1 to 1) and relative frequency of lines to the factor of the readings.
    moved : callable, optional
        Positions, directions, channels and parameters to those that are true.
    varies : bool
        The change differs from line to line.
    flips : bool
        The sign may be wrong as well.
    largest : float
        Parameters beyond this, in units that ``prior`` has, are believed only when they leave noise alone.
    lengths : bool
        ``prior`` and ``largest`` are in levers of the body.
    like : str
        Another kind that says the same of a channel: the two are not reported as different; empty for none.
    code, step : str
        Code of the warning, and what to do, where the name of this kind is a verdict; empty where its
        sentences give other verdicts, whose warnings are in ``ADVICE``.
    """

    owners: tuple[str, ...]
    tangents: tuple[int, ...]
    prior: tuple[float, ...]
    sentence: sentences.Sentence
    factor: Callable[[Array, Array, Array], ComplexArray] | None = None
    moved: Callable[[Array, Array, list[int], Array], Moved] | None = None
    varies: bool = False
    flips: bool = False
    largest: float = np.inf
    lengths: bool = False
    like: str = ""
    code: str = ""
    step: str = ""

    def unit(self, lever_m: float) -> float:
        """Return the unit of ``prior`` and ``largest``."""
        return lever_m if self.lengths else 1.0

    def scale(self, lever_m: float) -> Array:
        """Return how large each parameter commonly is."""
        return np.array(self.prior) * self.unit(lever_m)


def _direction(arms: Array, directions: Array, channels: list[int], p: Array) -> Moved:
    first, second = perpendicular_axes(directions[channels[0]])
    turned = directions[channels] + p[0] * first + p[1] * second
    turned_beams = directions.copy()
    turned_beams[channels] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    return arms, turned_beams


def _position(arms: Array, directions: Array, channels: list[int], p: Array) -> Moved:
    moved = arms.copy()
    moved[channels] += p
    return moved, directions


def _axes(arms: Array, directions: Array, channels: list[int], p: Array) -> Moved:
    turned_beams = directions.copy()
    turned_beams[channels] = directions[channels] @ rotation_from_vector(p).T
    return arms, turned_beams


_SETS = ("channel", "point", "laser")
# Owners of faults of many points: to leave their channels out would leave too little.
OF_MANY = ("laser", "lasers", "body")
KINDS: dict[str, Kind] = {
    "gain": Kind(
        _SETS,
        (REAL,),
        (0.1,),
        sentences.factor,
        factor=lambda p, _t, _r: 1.0 + p[0] + 0j,
        flips=True,
        code="channel_gain",
        step="Check range and scale of this channel; divide its values by the factor, or leave it out.",
    ),
    "phase": Kind(
        _SETS,
        (REAL, IMAGINARY),
        (0.1, 0.1),
        sentences.factor,
        factor=lambda p, _t, _r: 1.0 + p[0] + 1j * p[1],
        flips=True,
        like="gain",
    ),
    "delay": Kind(
        _SETS,
        (DELAY,),
        (0.1,),
        sentences.angle("delayed, phase lag", "at mid-band"),
        factor=lambda p, _t, r: np.exp(-1j * p[0] * r),
        varies=True,
        like="gain",
    ),
    "phase_offset": Kind(
        ("laser",),
        (IMAGINARY,),
        (0.1,),
        sentences.phase_offset,
        factor=lambda p, _t, _r: np.exp(1j * p[0]),
        like="gain",
    ),
    "drift": Kind(
        _SETS,
        (REAL, IMAGINARY, DRIFT, DRIFT_IMAGINARY),
        (0.05,) * 4,
        sentences.drift,
        factor=lambda p, t, _r: 1.0 + p[0] + 1j * p[1] + (p[2] + 1j * p[3]) * t,
        varies=True,
        flips=True,
        code="channel_drift",
        step="Sensitivity or alignment changed during the sweep: measure it again, or leave it out.",
    ),
    "direction": Kind(
        ("channel", "laser"),
        TURNS,
        (np.radians(4.0),) * 2,
        sentences.direction,
        moved=_direction,
        largest=0.6,
        code="channel_direction",
        step="Measure the direction of the beam anew and correct dir_x, dir_y, dir_z.",
    ),
    "position": Kind(
        ("point",),
        SHIFTS,
        (0.2,) * 3,
        sentences.position,
        moved=_position,
        largest=3.0,
        lengths=True,
        code="channel_position",
        step="Check the coordinates of the point.",
    ),
    "axes": Kind(("body",), AXES, (np.radians(2.0),) * 3, sentences.axes, moved=_axes, largest=0.6),
}

# Code of the warning, empty for none, and what to do about every verdict.
ADVICE: dict[str, tuple[str, str]] = {
    **{name: (kind.code, kind.step) for name, kind in KINDS.items() if kind.step},
    "sign": ("channel_sign", "Turn its direction or its values round (times -1)."),
    "noise": (
        "channel_noise",
        "Check focus and reflection there; state its true sd, leave it out, or fit with {robust} t4.",
    ),
    "label_swap": ("channel_label_swap", "Exchange these names."),
    "flexible": (
        "flexible",
        "The body bends, or its points belong to several bodies: use lower frequencies or fewer points, and "
        "do not read its degrees of freedom as rigid motion.",
    ),
    "zeros": ("", "Nothing was recorded: measure it again. It is not used in the fit."),
    "unused": ("", "Nothing usable was read: give values and their sd. It is not used in the fit."),
}

# What is exchanged has no size, and no score tests.
_EXCHANGED = {
    kind: Kind((), (), (), sentences.exchange(verdict))
    for kind, verdict in {"label_swap": "label_swap", "coordinates": "position"}.items()
}


@dataclass(frozen=True)
class Fault:
    """A fault at one place.

    Attributes
    ----------
    kind : str
        In KINDS, or ``label_swap`` or ``coordinates`` of an exchange.
    owner : str
        ``channel``, ``point``, ``laser``, ``body``; of exchanges also ``points``, ``beams``, ``lasers``.
    channels : list of int
    shift_m, turn : ndarray, (n, 3), or 0
        Of an exchange: by what positions and directions of the channels change.
    places : int
        At how many places this kind of fault could be.
    text : str
        Of an exchange: what was exchanged.
    """

    kind: str
    owner: str
    channels: list[int]
    shift_m: Array | float = 0.0
    turn: Array | float = 0.0
    places: int = 1
    text: str = ""

    @property
    def entry(self) -> Kind:
        """Its kind in the catalogue."""
        return KINDS[self.kind] if self.kind in KINDS else _EXCHANGED[self.kind]

    @property
    def size(self) -> int:
        """Number of real parameters."""
        return len(self.entry.tangents)

    def is_within(self, other: Fault) -> bool:
        """Return whether another fault of the same channels makes of readings whatever this one can."""
        both = self.entry.factor is not None and other.entry.factor is not None
        return both and self.channels == other.channels and {*self.entry.tangents} <= {*other.entry.tangents}

    def scale(self, lever_m: float) -> Array:
        """Return how large each parameter commonly is."""
        return self.entry.scale(lever_m)

    def geometry(self, arms_m: Array, directions: Array, p: Array) -> Moved:
        """Return positions and directions with the fault."""
        if self.entry.moved is not None:
            return self.entry.moved(arms_m, directions, self.channels, p)
        if self.kind in KINDS:
            return arms_m, directions
        arms_m, directions = arms_m.copy(), directions.copy()
        arms_m[self.channels] += self.shift_m
        directions[self.channels] += self.turn
        return arms_m, directions

    def applied(self, model: Model, p: Array, data: Packed) -> Model:
        """Return a model with the fault."""
        arms, directions = self.geometry(model.arms_m, model.directions, p)
        model = model._replace(arms_m=arms, directions=directions)
        factor = self.entry.factor
        if factor is None:
            return model
        return model.times(self.channels, factor(p, data.tau, data.ratio), len(data.tau))

    def undone(self, assumed: Assumed, p: Array) -> Assumed:
        """Return assumptions that hold this fault."""
        arms, directions = self.geometry(assumed.arms_m, assumed.directions, p)
        factor = self.entry.factor
        held = () if factor is None else ((self.channels, partial(factor, p)),)
        return replace(assumed, arms_m=arms, directions=directions, factors=(*assumed.factors, *held))
