"""Frequencies of bodies and channels: joined where they mean the same line, refused where they do not."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.kinematics.tidy.frequency_grids import join_lines
from legacy.kinematics.tidy.ldv_csv import read_ldv
from legacy.stapeskit.faults import StapeskitError

HEAD = "body,point,x_mm,y_mm,z_mm,dir,freq_hz,re_m_s,im_m_s"
GRID = np.linspace(400.0, 5000.0, 47)


def read(folder, grids):
    """Read a table in which each (body, point) has its own grid."""
    rows = [
        f"{body},{point},{point},0,0,y,{freq!r},{k}.5,1"
        for (body, point), grid in grids.items()
        for k, freq in enumerate(np.asarray(grid).tolist())
    ]
    path = folder / "ldv.csv"
    path.write_text("\n".join([HEAD, *rows]) + "\n")
    return read_ldv(path)


@pytest.mark.parametrize("shift", [1e-9, 1e-4, 9e-3])
def test_a_grid_stepped_again_is_the_same_grid(tmp_path, shift):
    made = read(tmp_path, {("stapes", 1): GRID, ("stapes", 2): GRID + 0.5 * shift, ("base", 1): GRID + shift})
    assert np.allclose(made.freq_hz, GRID, rtol=0.0, atol=shift)
    assert all(np.all(np.isfinite(body.displacement.real)) for body in made.bodies)
    codes = [notice.code for notice in made.notices]
    assert codes == (["frequencies_matched"] if shift > 4e-4 else [])


def test_values_stay_with_their_lines(tmp_path):
    rng = np.random.default_rng(4)
    made = read(tmp_path, {("stapes", 1): GRID, ("base", 1): GRID * (1.0 + 2e-5 * rng.uniform(-1, 1, 47))})
    w = 2.0 * np.pi * made.freq_hz
    for body in made.bodies:
        assert np.allclose((body.displacement[0, 0] * 1j * w).real, np.arange(47) + 0.5)


@pytest.mark.parametrize("shift", [0.5, 5.0, 50.0])
def test_shifted_grids_of_bodies_are_refused(tmp_path, shift):
    with pytest.raises(StapeskitError) as caught:
        read(tmp_path, {("stapes", 1): GRID, ("base", 1): GRID + shift})
    told = str(caught.value)
    assert told.startswith("the frequencies of bodies stapes and base must be the same within 1 %")
    assert "400, 500, ... 5000 Hz (47 lines)" in told
    assert "of them in common (ldv.csv). Measure both bodies on one grid" in told


def test_bands_without_a_common_line_are_refused(tmp_path):
    with pytest.raises(StapeskitError, match="0 of them in common"):
        read(tmp_path, {("stapes", 1): GRID, ("base", 1): [6000.0, 6100.0]})


def test_a_coarser_grid_and_a_narrower_band_are_read(tmp_path):
    made = read(tmp_path, {("stapes", 1): GRID, ("base", 1): GRID[10:30:2]})
    assert made.freq_hz.tolist() == GRID.tolist()
    assert np.sum(np.isfinite(made.bodies[1].displacement.real)) == 10


def test_close_lines_of_one_channel_stay_apart(tmp_path):
    dense = 1000.0 + 0.005 * np.arange(50)
    made = read(tmp_path, {("stapes", 1): dense, ("base", 1): dense})
    assert made.freq_hz.tolist() == dense.tolist()


def test_many_slightly_different_sweeps_do_not_run_into_each_other():
    sweeps = np.concatenate([GRID + 0.4 * k for k in range(12)])
    channel = np.repeat(np.arange(12), 47)
    grid, _ = join_lines(sweeps, channel, np.zeros(len(sweeps), dtype=np.intp), ["stapes"])
    for number in range(12):
        lines = grid.line[channel == number]
        assert len(set(lines.tolist())) == 47
        off = np.abs(grid.freq_hz[lines] - sweeps[channel == number])
        assert np.all(off <= 1e-4 * grid.freq_hz[lines])
