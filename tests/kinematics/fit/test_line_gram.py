"""Weighted least squares at lines with different weights, against one small problem per line."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from legacy.kinematics.fit import symmetric_batches
from legacy.kinematics.fit.line_gram import determining, each_line, pieces, spans
from legacy.kinematics.fit.line_noise import LineNoise
from legacy.kinematics.fit.line_sums import Solution

CHANNELS, LINES, SIZE = 9, 37, 4


def problem(seed=0, *, missing=0.0, ratio=1.0):
    """Orthonormal basis, readings and sd whose ratios change from line to line."""
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.normal(size=(CHANNELS, SIZE)))[0]
    value = rng.normal(size=(CHANNELS, LINES, 2)) @ np.array([1.0, 1j])
    sd = np.exp(rng.normal(size=(CHANNELS, LINES)) * ratio)
    value[rng.uniform(size=value.shape) < missing] = np.nan
    return basis, value, sd


def solved(basis, value, sd):
    out = Solution(CHANNELS, LINES, SIZE)
    each_line(basis, value, LineNoise(sd), slice(0, LINES), out)
    return out


def one_line(basis, value, sd):
    """Coefficients, their covariance and the sum of squares of one line, by a dense solution."""
    used = np.isfinite(value) & np.isfinite(sd)
    rows = basis[used] / sd[used, None]
    z, *_ = np.linalg.lstsq(rows.astype(complex), value[used] / sd[used], rcond=None)
    misfit = float(np.sum(np.abs(value[used] / sd[used] - rows @ z) ** 2))
    return z, 2.0 * np.linalg.inv(rows.T @ rows), misfit, int(used.sum())


@pytest.mark.parametrize("missing", [0.0, 0.2])
@pytest.mark.parametrize("ratio", [0.1, 1.0, 3.0])
def test_every_line_is_its_own_least_squares(missing, ratio):
    basis, value, sd = problem(3, missing=missing, ratio=ratio)
    out = solved(basis, value, sd)
    for line in range(LINES):
        z, covariance, misfit, count = one_line(basis, value[:, line], sd[:, line])
        assert out.good[line]
        assert out.count[line] == count
        assert np.allclose(out.z[:, line], z, rtol=1e-7, atol=1e-9)
        assert out.misfit[line] == pytest.approx(misfit, rel=1e-6, abs=1e-9)
        inverse = symmetric_batches.unpack(out.inverse[:, [line]], SIZE)[0]
        assert np.allclose(inverse, covariance, rtol=1e-5, atol=1e-7 * np.abs(covariance).max())


def test_degrees_of_freedom_of_all_channels_add_up():
    basis, value, sd = problem(5, missing=0.1)
    out = solved(basis, value, sd)
    assert np.sum(out.freedom) == pytest.approx(2.0 * (np.sum(np.isfinite(value)) - SIZE * LINES))
    assert np.sum(out.scaled) == pytest.approx(np.sum(out.misfit))


def test_lines_without_enough_channels_are_not_determined():
    basis, value, sd = problem(1)
    value[3:, 7] = np.nan
    out = solved(basis, value, sd)
    assert not out.good[7]
    assert np.all(out.z[:, 7] == 0.0)
    assert np.sum(out.good) == LINES - 1


def test_an_exact_channel_binds_and_does_not_break_the_solution():
    basis, value, sd = problem(2, ratio=0.1)
    sd[0, 4] = 1e-9
    out = solved(basis, value, sd)
    assert out.good[4]
    assert basis[0] @ out.z[:, 4] == pytest.approx(value[0, 4], abs=1e-6)


def test_weights_of_a_range_that_can_be_solved_leave_the_order_of_channels():
    basis, *_ = problem(4)
    root = np.logspace(0.0, 12.0, CHANNELS)
    held = determining(basis, root)
    assert held is not None
    assert np.all(np.diff(held) >= 0.0)
    assert held.max() / np.sort(root)[-SIZE] <= 1e6
    assert determining(basis, np.where(np.arange(CHANNELS) < 2, 1.0, 0.0)) is None


def test_pieces_hold_every_line_once_with_weights_up_to_one():
    _, value, sd = problem(6, missing=0.1)
    cut, best = pieces(value, LineNoise(sd), slice(0, LINES))
    assert [line for piece in cut for line in range(LINES)[piece.lines]] == list(range(LINES))
    for piece in cut:
        assert np.max(piece.weight) == pytest.approx(1.0)
        assert np.all(piece.y[:, ~np.isfinite(value[:, piece.lines])] == 0.0)
    known = np.where(np.isfinite(value), sd, np.inf)
    assert np.allclose(best, 1.0 / np.min(known, axis=0))


@pytest.mark.parametrize(("channels", "lines"), [(9, 100), (600, 5000), (20_000, 40)])
def test_runs_of_lines_cover_all_of_them(channels, lines):
    runs = list(spans(channels, lines))
    assert runs[0].start == 0
    assert runs[-1].stop == lines
    assert all(a.stop == b.start for a, b in pairwise(runs))
