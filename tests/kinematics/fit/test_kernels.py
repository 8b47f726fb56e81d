"""The compiled passes over the data against their twins in numpy, and whole fits with and without them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from legacy.kinematics import native as kernels
from legacy.kinematics.fit import line_kernels
from legacy.kinematics.fit.line_noise import LineNoise
from legacy.kinematics.fit.line_solver import solve
from legacy.kinematics.fit.line_sums import Solution

NAMES = ("z", "inverse", "misfit", "explained", "energy", "scaled", "freedom", "weight")


def normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


def readings(channels: int, lines: int, size: int = 6, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """An orthonormal basis, and readings of large motion in it with small noise."""
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.normal(size=(channels, size)))[0]
    return basis, basis @ (1e-6 * normal(rng, size, lines)) + 1e-9 * normal(rng, channels, lines)


def without(monkeypatch: pytest.MonkeyPatch, work: Callable[[], Any]) -> Any:
    with monkeypatch.context() as patch:
        patch.setattr(line_kernels, "compiled", lambda: None)
        return work()


def alike(one: Solution, other: Solution, tolerance: float = 1e-11) -> None:
    for name in NAMES:
        ours, theirs = getattr(one, name), getattr(other, name)
        assert np.max(np.abs(ours - theirs)) <= tolerance * np.max(np.abs(theirs)), name
    for name in ("good", "count", "used"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name


def test_the_kernels_were_built():
    assert kernels.compiled() is not None, "the kernels were not built: python hatch_build.py"


@pytest.mark.parametrize("lines", [1, 7, 8, 15, 16, 17, 33, 100])
@pytest.mark.parametrize(("channels", "size"), [(2, 1), (7, 3), (13, 5), (24, 6)])
def test_every_pass_is_its_twin(monkeypatch, lines, channels, size):
    basis, value = readings(channels, lines, size, lines)
    rng = np.random.default_rng(1)
    own = 1e-9 * rng.uniform(0.5, 2.0, value.shape)
    share, line = rng.uniform(0.5, 2.0, (channels, 1)), 1e-9 * rng.uniform(0.5, 2.0, lines)
    noises = [
        LineNoise(own),
        LineNoise(own, rng.uniform(0.5, 2.0, lines), np.full(lines, 1.1e-9)),
        LineNoise(own.T.copy().T),
        LineNoise(np.broadcast_to(line, value.shape)),
        LineNoise(share * line),
    ]
    for noise in noises:
        alike(solve(basis, value, noise), without(monkeypatch, lambda n=noise: solve(basis, value, n)))


@pytest.mark.parametrize("stated", ["alike", "own"])
@pytest.mark.parametrize("missing", ["single", "run", "channel", "line", "many"])
def test_missing_values_are_left_out_as_by_the_twin(monkeypatch, missing, stated):
    basis, value = readings(15, 700)
    rng = np.random.default_rng(2)
    if missing == "single":
        value[3, 411] = np.nan
        value[0, 699] = complex(1e-6, np.inf)
    elif missing == "run":
        value[4:6, 130:390] = np.nan
    elif missing == "channel":
        value[7] = np.nan
    elif missing == "line":
        value[:, 200:203] = np.nan
        value[5:, 300] = np.nan
    else:
        value[rng.random(value.shape) < 0.05] = np.nan
    sd = np.full((1, 700), 1e-9) if stated == "alike" else 1e-9 * rng.uniform(0.5, 2.0, value.shape)
    sd = np.broadcast_to(sd, value.shape)
    if stated == "own":
        sd = sd.copy()
        sd[2, 100], sd[2, 101], sd[2, 102] = np.inf, np.nan, 1e-3
    noise = LineNoise(sd)
    alike(solve(basis, value, noise), without(monkeypatch, lambda: solve(basis, value, noise)))


def test_lines_that_are_hard_to_solve_are_left_to_singular_values(monkeypatch):
    basis, value = readings(12, 120)
    sd = np.full(value.shape, 1e-9)
    sd[:7, 17] = 1e-3
    sd[:8, 18] = 1e-3
    sd[:6, 60:64] = 1e-6
    sd[0, 100] = 1e-20
    noise = LineNoise(sd)
    ours, theirs = solve(basis, value, noise), without(monkeypatch, lambda: solve(basis, value, noise))
    alike(ours, theirs, 1e-6)
    assert np.max(np.abs(ours.z - theirs.z)) <= 1e-9 * np.max(np.abs(theirs.z))


def test_arrays_of_any_layout_are_taken(monkeypatch):
    basis, value = readings(9, 90)
    noise = LineNoise(np.broadcast_to(1e-9, (9, 90)))
    wanted = solve(basis, value, noise)
    wide = np.zeros((18, 180), dtype=complex)
    wide[::2, :90] = value
    turned = np.ascontiguousarray(value.T).T
    spread = np.zeros((9, 180), dtype=complex)
    spread[:, ::2] = value
    for given in (wide[::2, :90], wide[::2, :90][::-1][::-1], turned, spread[:, ::2]):
        alike(solve(basis, given, noise), wanted)
        own = LineNoise(np.where(np.arange(90) % 2, 1e-9, 1.5e-9) * np.linspace(1.0, 1.2, 9)[:, None] ** 2)
        varied = LineNoise(own.stated * (1.0 + 0.1 * np.cos(np.arange(810.0)).reshape(9, 90)))
        alike(
            solve(basis, given, varied),
            without(monkeypatch, lambda v=varied: solve(basis, value, v)),
        )
