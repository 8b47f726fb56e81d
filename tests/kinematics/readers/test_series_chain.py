"""From sampled signals to dof.csv: what the rigid bodies did comes back within the stated noise."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.kinematics.cli import parser, work
from legacy.kinematics.fit_options import Options
from legacy.kinematics.options import LdvOptions
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.readers.from_options import input_options
from legacy.kinematics.readers.measurement_files import read_measurement
from legacy.kinematics.registration.laser_errors import LaserPriors
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.records.motion_files import read_motion, standard_deviation
from tests.kinematics import series

pytestmark = pytest.mark.usefixtures("undrawn")

SCALE = 1e3  # mm/s


def check(motion, codes=()):
    """Hold a motion against the truth: errors over stated sd have unit mean square, per volt of the drive."""
    truth = series.motions(motion.freq_hz)
    sd = standard_deviation(motion)
    scores = []
    for number, body in enumerate(motion.bodies):
        error = motion.q[0, number] - truth[body]
        scores.append(np.mean(np.abs(error) ** 2 / (2.0 * sd[0, number] ** 2)))
        assert np.all(np.abs(error) < 6.0 * np.sqrt(2.0) * sd[0, number])
    n = 2 * len(motion.freq_hz) * 6
    assert np.all(np.abs(np.array(scores) - 1.0) < 6.0 * np.sqrt(2.0 / n) + 0.06), scores
    chi2 = np.nansum(motion.chi2) / np.sum(motion.n_dof)
    assert abs(chi2 - 1.0) < 0.15, chi2
    found = {notice.code for notice in motion.notices}
    assert set(codes) <= found
    return motion


def run(folder, file, *options, channels=None):
    """Fit what the options of the command make of a file with its channel table."""
    table = channels or series.table(folder / "channels.csv")
    given = parser().parse([str(folder / file), "--channels", str(table), *options])
    said = input_options(given.make(LdvOptions))
    # the simulated lasers are exact, and the noise is what is judged
    exact = Options(lasers=LaserPriors(0.0, 0.0, 0.0))
    return points2dof(read_measurement(given.ldv, given.points, "footplate", said), options=exact).motion


def test_periodic_excitation_in_a_table(tmp_path):
    rng = np.random.default_rng(11)
    freq, drive, velocity = series.multisine(rng, 1024, 13, 0.05)
    time = np.arange(len(drive)) / series.RATE_HZ
    names = ["time_s", "drive", *(one[0] for one in series.channels())]
    data = np.vstack([time, drive, velocity * SCALE]).T
    np.savetxt(tmp_path / "scan.csv", data, "%.9g", ",", header=",".join(names), comments="")
    table, out = series.table(tmp_path / "channels.csv"), tmp_path / "out" / "dof.csv"
    period = repr(1024 / series.RATE_HZ)
    work([str(tmp_path / "scan.csv"), "--channels", str(table), "--period", period, "--out", str(out)])
    motion = check(read_motion(out))
    np.testing.assert_allclose(motion.freq_hz, freq, rtol=1e-9)


def test_random_excitation_in_npz(tmp_path):
    rng = np.random.default_rng(12)
    samples = 1 << 15
    _, drive, velocity = series.multisine(rng, samples, 1, 0.1, every=1, low=300.0)
    arrays = {one[0]: velocity[k] * SCALE for k, one in enumerate(series.channels())}
    np.savez(tmp_path / "scan.npz", drive=drive, sample_rate_hz=series.RATE_HZ, **arrays)
    check(run(tmp_path, "scan.npz", "--averages", "60", "--frf-band", "420-4900"))


@pytest.mark.parametrize("reference", ["V", ""])
def test_stepped_sine_in_hdf5(tmp_path, reference):
    import h5py

    rng = np.random.default_rng(13)
    freq = np.linspace(500.0, 4500.0, 15)
    set_hz, drive, velocity = series.stepped(rng, freq, 0.08, 0.05, clock=1.0 + 2e-4)
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file.attrs["sample_rate_hz"] = series.RATE_HZ
        file["freq_hz"], file["drive"] = set_hz, drive
        for k, one in enumerate(series.channels()):
            file[one[0]] = velocity[k] * SCALE
    table = series.table(tmp_path / "channels.csv", reference=reference)
    out = run(tmp_path, "scan.h5", channels=table)
    if reference:
        motion = check(out, ["clock_differs"])
        np.testing.assert_allclose(motion.freq_hz, freq * (1.0 + 2e-4), rtol=2e-5)
        return
    motion = out
    truth = series.motions(motion.freq_hz)
    want = truth["stapes"] / truth["base"][:, 1:2]
    order = [motion.bodies.index(name) for name in ("base", "stapes")]
    got = motion.q[0, order[1]] / motion.q[0, order[0], :, 1:2]
    assert np.median(np.abs(got - want)[:, 1] / np.abs(want[:, 1])) < 0.02


def test_stepped_sine_with_a_table_of_steps_in_matlab(tmp_path):
    from scipy.io import savemat

    rng = np.random.default_rng(14)
    freq = np.linspace(600.0, 4000.0, 12)
    _, drive, velocity = series.stepped(rng, freq, 0.08, 0.05)
    count = int(0.08 * series.RATE_HZ)
    rows = [
        f"{k * count / series.RATE_HZ},{(k + 1) * count / series.RATE_HZ},{f}" for k, f in enumerate(freq)
    ]
    (tmp_path / "steps.csv").write_text("\n".join(["start_s,stop_s,freq_hz", *rows]))
    arrays = {one[0]: velocity[k] * SCALE for k, one in enumerate(series.channels())}
    savemat(tmp_path / "scan.mat", {"drive": drive, "fs": series.RATE_HZ, **arrays})
    check(run(tmp_path, "scan.mat", "--steps", str(tmp_path / "steps.csv")))


@pytest.mark.parametrize("loud", [0.0, 0.1])
def test_scanning_one_point_after_the_other(tmp_path, loud):
    """Rows of a two-dimensional variable are points; each row has its own record of the reference.

    The noise of the reference is then each point's own: it goes into the sd of its beams, and that it moves
    the beams of one point together stands in the covariance of the motion.
    """
    from scipy.io import savemat

    rng = np.random.default_rng(15)
    lines = {"x": [], "y": [], "z": [], "ref": []}
    for point in range(10):
        _, drive, velocity = series.multisine(rng, 1024, 9, 0.05)
        lines["ref"].append(drive + loud * np.std(drive) * rng.standard_normal(len(drive)))
        for k, name in enumerate("xyz"):
            lines[name].append(velocity[3 * point + k] * SCALE)
    time = np.arange(9 * 1024) / series.RATE_HZ
    arrays = {f"amp_{name}" if name != "ref" else name: np.array(rows) for name, rows in lines.items()}
    savemat(tmp_path / "scan.mat", {"t": time, **arrays})
    rows = ["channel,role,dir_x,dir_y,dir_z,unit", "ref,reference,,,,V"]
    for name, beam in zip("xyz", series.BEAMS, strict=True):
        rows.append(f"amp_{name},response,{','.join(f'{v:.9g}' for v in beam)},mm/s")
    table = tmp_path / "channels.csv"
    table.write_text("\n".join(rows))
    points = ["body,point,x_mm,y_mm,z_mm"]
    for k in range(10):
        points.append(
            f"{'stapes' if k < 5 else 'base'},{k + 1}," + ",".join(map(str, series.POINTS_MM[k % 5]))
        )
    (tmp_path / "points.csv").write_text("\n".join(points))
    period = repr(1024 / series.RATE_HZ)
    options = ["--period", period, "--points", str(tmp_path / "points.csv")]
    motion = run(tmp_path, "scan.mat", *options, channels=table)
    assert motion.common_sd is None
    if not loud:
        check(motion)
        return
    chi2 = np.nansum(motion.chi2) / np.sum(motion.n_dof)
    assert abs(chi2 - 1.0) < 0.15, chi2
    truth = np.array([series.motions(motion.freq_hz)[body] for body in motion.bodies])
    scores = np.abs(motion.q[0] - truth) ** 2 / (2.0 * standard_deviation(motion)[0] ** 2)
    assert 0.85 < np.mean(scores) < 1.15
    assert 0.85 < np.mean(scores[:, :, 1]) < 1.2


def test_noise_of_the_reference_is_told_and_left_out(tmp_path):
    rng = np.random.default_rng(16)
    _, drive, velocity = series.multisine(rng, 1024, 13, 0.02)
    drive = drive + 0.1 * np.std(drive) * rng.standard_normal(len(drive))
    arrays = {one[0]: velocity[k] * SCALE for k, one in enumerate(series.channels())}
    np.savez(tmp_path / "scan.npz", drive=drive, sample_rate_hz=series.RATE_HZ, **arrays)
    motion = run(tmp_path, "scan.npz", "--period", repr(1024 / series.RATE_HZ))
    assert "reference_noise" in {notice.code for notice in motion.notices}
    chi2 = np.nansum(motion.chi2) / np.sum(motion.n_dof)
    assert abs(chi2 - 1.0) < 0.1, chi2
    truth = series.motions(motion.freq_hz)
    order = [motion.bodies.index(name) for name in ("base", "stapes")]
    base, stapes = (motion.q[0, k] for k in order)
    factor = base[:, 1] / truth["base"][:, 1]
    spread = np.sqrt(np.mean(np.abs(factor - 1.0) ** 2) / 2.0)
    assert np.median(motion.common_sd) == pytest.approx(spread, rel=0.25)
    ratio = (stapes[:, 1] / base[:, 1]) / (truth["stapes"][:, 1] / truth["base"][:, 1])
    error = motion.q[0] - np.array([truth[body] for body in motion.bodies])
    whole = standard_deviation(motion)[0]
    assert abs(np.mean(np.abs(error) ** 2 / (2.0 * whole**2)) - 1.0) < 0.3
    assert motion.common_sd is not None
    sd = standard_deviation(motion.with_common_noise(np.zeros(1)))
    own = np.hypot(sd[0, order[0], :, 1] / np.abs(base[:, 1]), sd[0, order[1], :, 1] / np.abs(stapes[:, 1]))
    assert abs(np.mean(np.abs(ratio - 1.0) ** 2 / (2.0 * own**2)) - 1.0) < 0.35


def test_options_of_time_series_need_a_channel_table(tmp_path):
    (tmp_path / "scan.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(StapeskitError, match="--frf must be given with --channels"):
        work([str(tmp_path / "scan.npz"), "--frf", "h2"])
    with pytest.raises(StapeskitError, match="read with --channels FILE"):
        work([str(tmp_path / "scan.npz")])
    table = series.table(tmp_path / "channels.csv")
    with pytest.raises(StapeskitError, match=r"--overlap must be between 0 and 0\.95"):
        work([str(tmp_path / "scan.npz"), "--channels", str(table), "--overlap", "1.5"])
    with pytest.raises(StapeskitError, match="readable NPZ archive"):
        work([str(tmp_path / "scan.npz"), "--channels", str(table)])
