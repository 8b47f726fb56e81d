"""Compress the lines of a body into few columns that hold all of its motion, and a sample of pure noise.

Every value that follows the motion lies in the span of the motion's own courses over the lines: a turn of the
lines puts these into at most six columns, and leaves noise in all others.

Shapes: c channels, N lines (of all runs), G groups of lines, n columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from kinematics.joint.tangents import Geometry, Parameters
from stapeskit.arrays import Array, ComplexArray

SEGMENTS = 12
"""Groups of lines of all runs together: within one, drifts and delays count as constant."""

_COLUMNS = 6  # a rigid motion has no more courses
_LEAST_LINES = 12  # of a group that is turned: six columns of motion, six of noise
_NOISE_COLUMNS = 40  # of a group: 12 groups of 15 channels know the level to 1 %
_MOST_VALUES = 1_200_000  # values that are looked at; 2000 lines of 600 channels
_MOST_SINGLE = 20_000  # values of lines that keep weights of their own: each has a factorisation
_VISIBLE = 1e-4  # relative strength of motions that are part of the model


@dataclass(frozen=True)
class Readings:
    """The values of one body in all runs, as they are assumed to be.

    Attributes
    ----------
    value : ndarray, (c, N), complex
        NaN where missing.
    sd : ndarray, (c, N)
        Standard deviation of its real part.
    freq_hz, tau : ndarray, (N,)
        Frequency, and place from -1 to 1 in the run.
    run : ndarray, (N,), int
    geometry : Geometry
        Positions about the centroid; ``factor`` is (1, c), or (N, c) with a delay or drift.
    noise_factor : ndarray, (c,)
        What ``sd`` is multiplied with; infinite for channels that are left out.
    known : ndarray, (c,), or None
        Standard deviation of the logarithm of the stated ``sd``, as few digits leave it; None where ``sd`` is
        not stated in absolute size.
    """

    value: ComplexArray
    sd: Array
    freq_hz: Array
    tau: Array
    run: NDArray[np.intp]
    geometry: Geometry
    noise_factor: Array
    known: Array | None = None

    @classmethod
    def of(
        cls, value: ComplexArray, sd: Array, freq_hz: Array, positions_m: Array, directions: Array
    ) -> Readings:
        """Gather runs (r, c, L) of values and their sd into one; many lines are thinned out evenly."""
        runs, channels, lines = value.shape
        most = max(32, _MOST_VALUES // (channels * runs))
        pick = np.unique(np.linspace(0, lines - 1, min(most, lines)).astype(int))
        chosen = value[:, :, pick].transpose(1, 0, 2).reshape(channels, -1)
        spread = np.broadcast_to(sd, value.shape)[:, :, pick].transpose(1, 0, 2).reshape(channels, -1)
        used = np.isfinite(chosen) & np.isfinite(spread) & (spread > 0.0)
        geometry = Geometry(
            positions_m - positions_m.mean(axis=0), directions, np.ones((1, channels), dtype=complex)
        )
        return cls(
            np.where(used, chosen, np.nan),
            np.where(used, spread, np.nan),
            np.tile(freq_hz[pick], runs),
            np.tile(np.linspace(-1.0, 1.0, len(pick)), runs),
            np.repeat(np.arange(runs), len(pick)),
            geometry,
            np.ones(channels),
        )

    @property
    def omega(self) -> Array:
        """Angular frequency (N,), rad/s."""
        return 2.0 * np.pi * self.freq_hz

    def louder(self, channels: Sequence[int], by: float = np.inf) -> Readings:
        """Return the readings with larger noise of channels; without them, where it is infinite."""
        factor = self.noise_factor.copy()
        factor[list(channels)] *= by
        return replace(self, noise_factor=factor)

    def corrected(self, parameters: Parameters, values: Array) -> Readings:
        """Return the readings under a geometry with parameters (p,) of the given values."""
        moved = self.geometry.moved(parameters, values, self.tau, self.omega)
        return replace(self, geometry=replace(moved, slope=None))


@dataclass(frozen=True)
class Packed:
    """Values over noise in groups of columns.

    Attributes
    ----------
    y : ndarray, (G, c, n), complex
        Columns that hold the motion; zero where missing.
    w : ndarray, (G, c)
        Root weights 1 / (sqrt 2 sd), up to a factor per line that is in ``y``.
    columns : ndarray, (G,), int
        Columns in use of each group.
    tau, omega : ndarray, (G,)
        As in `Readings`.
    rest : ndarray, (G, c, k), complex
        Columns without motion: noise alone.
    rest_columns : ndarray, (G,), int
    geometry : Geometry
        Its factor is (1, c) or (G, c).
    visible : ndarray, (6, r)
        Motions (about the centroid, dimensionless by ``scale``) that the beams see.
    scale : ndarray, (6,)
    live : ndarray, int
        Channels in use.
    """

    y: ComplexArray
    w: Array
    columns: NDArray[np.intp]
    tau: Array
    omega: Array
    rest: ComplexArray
    rest_columns: NDArray[np.intp]
    geometry: Geometry
    visible: Array
    scale: Array
    live: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, dtype=np.intp))

    @property
    def turned(self) -> bool:
        """Whether the groups hold more than single lines, and noise apart from motion."""
        return bool(self.rest.size)

    @property
    def values(self) -> int:
        """Real numbers that are looked at, without the sample of noise."""
        return int(2 * np.sum(np.count_nonzero(self.w, axis=1) * self.columns))

    def scaled(self, levels: Array) -> Packed:
        """Return the values over noise that is ``levels`` (G,) or (G, c) times as large."""
        by = np.broadcast_to(levels.reshape(len(self.y), -1), self.w.shape)[:, :, None]
        return replace(self, y=self.y / by, w=self.w / by[:, :, 0], rest=self.rest / by)


def pack(readings: Readings) -> Packed:
    """Compress readings under their present geometry and noise.

    Notes
    -----
    Lines with the same channels and the same ratios of noise form groups, cut into segments. In each, the
    motion of all lines is estimated, and a QR factorisation of its courses gives the turn of the lines. Lines
    whose weights are like those of no other stay as they are; of many such, a sample is taken.
    """
    geometry = readings.geometry
    lever = float(np.sqrt(np.mean(np.sum(geometry.positions_m**2, axis=1)))) or 1.0
    scale = np.array([1.0, 1.0, 1.0, lever, lever, lever])
    live = np.isfinite(readings.noise_factor)
    used = np.isfinite(readings.value) & live[:, None]
    spread = np.where(
        used, np.sqrt(2.0) * readings.sd * np.where(live, readings.noise_factor, 1.0)[:, None], 1.0
    )
    root = used / spread
    value = np.asarray(np.where(used, readings.value, 0.0) * root, dtype=complex)
    rows = geometry.rows() / scale
    _, strength, motions = np.linalg.svd(rows[live], full_matrices=False)
    visible = motions[strength > _VISIBLE * strength[0]].T
    factor = geometry.factor.T
    groups, single = _groups(used, root, readings.run)
    room = max(48, _MOST_SINGLE // len(root))
    single = single[np.unique(np.linspace(0, len(single) - 1, min(room, len(single))).astype(int))]
    groups += [single[k : k + 1] for k in range(len(single))]
    parts = [_turned(value, root, factor, rows @ visible, lines) for lines in groups]
    y, rest, power = zip(*parts, strict=True)

    def mean(course: Array) -> Array:
        pairs = zip(power, groups, strict=True)
        return np.array([own @ course[lines] / own.sum() for own, lines in pairs])

    if len(geometry.factor) > 1:
        geometry = replace(
            geometry, factor=np.array([geometry.factor[lines].mean(axis=0) for lines in groups])
        )
    return Packed(
        y=_stack(y),
        w=root[:, [lines[0] for lines in groups]].T,
        columns=np.array([part.shape[1] for part in y]),
        tau=mean(readings.tau),
        omega=mean(readings.omega),
        rest=_stack(rest),
        rest_columns=np.array([part.shape[1] for part in rest]),
        geometry=geometry,
        visible=visible,
        scale=scale,
        live=np.flatnonzero(root.any(axis=1)),
    )


def _groups(
    used: NDArray[np.bool_], root: Array, run: NDArray[np.intp]
) -> tuple[list[NDArray[np.intp]], NDArray[np.intp]]:
    """Return groups of lines that share channels and ratios of noise, and the lines that are in none."""
    number = np.zeros(used.shape[1], dtype=np.intp)
    if not np.all(used == used[:, :1]):
        number = np.unique(np.packbits(used, axis=0), axis=1, return_inverse=True)[1].reshape(-1)
    groups: list[NDArray[np.intp]] = []
    left: list[NDArray[np.intp]] = []
    for pattern in range(int(number.max()) + 1):
        for own_run in np.unique(run[number == pattern]):
            lines = np.flatnonzero((number == pattern) & (run == own_run))
            some = root[:, lines]
            first = int(np.argmax(some[:, 0]))
            product = some[:, :1] / max(some[first, 0], 1e-300) * some[first]
            alike = bool(np.all(np.abs(some - product) <= 1e-6 * product))
            share = max(1, round(SEGMENTS * len(lines) / len(run)))
            pieces = np.array_split(lines, max(1, min(share, len(lines) // _LEAST_LINES)))
            if alike and len(lines) >= _LEAST_LINES and some.any():
                groups += pieces
            else:
                left.append(lines)
    return groups, np.sort(np.concatenate(left)) if left else np.empty(0, dtype=np.intp)


def _turned(
    value: ComplexArray, root: Array, factor: ComplexArray, rows: Array, lines: NDArray[np.intp]
) -> tuple[ComplexArray, ComplexArray, Array]:
    """Turn the lines of a group so that few columns hold the motion.

    Return these columns, columns of noise, and the power of the motion at each line. A factor that changes
    within the group is replaced by its mean there, in values and model alike.
    """
    y = value[:, lines]
    if len(lines) == 1:
        return y, y[:, :0], np.ones(1)
    own = factor
    if factor.shape[1] > 1:
        own = factor[:, lines].mean(axis=1, keepdims=True)
        y = y * (own / factor[:, lines])
    z = (np.linalg.pinv(root[:, lines[:1]] * rows, rcond=1e-9) / own.T) @ y
    number = min(len(z), _COLUMNS, len(lines))
    noise = min(len(lines) - number, _NOISE_COLUMNS)
    draw = np.random.default_rng(len(lines)).normal(size=(len(lines), noise))
    turned = y @ np.linalg.qr(np.hstack([z.conj().T, draw]))[0]
    power = np.sum(np.abs(z) ** 2, axis=0)
    return turned[:, :number], turned[:, number:], power if power.any() else np.ones(len(lines))


def _stack(parts: Sequence[ComplexArray]) -> ComplexArray:
    """Stack matrices (c, n) of different widths, filled up with zeros."""
    width = max(part.shape[1] for part in parts)
    out = np.zeros((len(parts), len(parts[0]), width), dtype=complex)
    for k, part in enumerate(parts):
        out[k, :, : part.shape[1]] = part
    return out
