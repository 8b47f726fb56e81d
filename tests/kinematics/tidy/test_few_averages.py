"""Standard deviations from few averages are smoothed where their scatter is theirs, and only there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.special import chdtrc

from legacy.kinematics.fit.beams import beam_set
from legacy.kinematics.fit.rigid_fit import LineFit, fit_lines
from legacy.kinematics.tidy.few_averages import steady_noise
from legacy.kinematics.tidy.ldv_csv import read_ldv
from legacy.stapeskit.spatial import DOF_NAMES
from tests.kinematics.simulated import readings, smooth_motion, stapes_points, three_beams

LINES = 1500


def scene(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, directions, motion and noise (27, freq) that runs smoothly over frequency."""
    rng = np.random.default_rng(seed)
    places = np.repeat(stapes_points(rng), 3, axis=0)
    beams = np.tile(three_beams(20.0), (9, 1))
    q = smooth_motion(rng, np.linspace(400.0, 5000.0, LINES))
    own = 1e-9 * 10.0 ** rng.uniform(-0.5, 0.5, (27, 1))
    return places, beams, q, own * np.exp(0.6 * np.sin(np.linspace(0.0, 7.0, LINES)))


def complex_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Return noise of unit variance of both parts."""
    return rng.normal(size=(*shape, 2)).view(complex)[..., 0]


def covered(fit: LineFit, q: np.ndarray) -> tuple[float, float]:
    """Return coverage of 95 % intervals and the share of lines with p below 5 %."""
    sd = np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2) / 2.0)
    error = fit.q - q
    inside = np.mean([np.abs(error.real) < 1.96 * sd, np.abs(error.imag) < 1.96 * sd])
    return float(inside), float(np.mean(chdtrc(fit.n_dof, fit.chi2) < 0.05))


@pytest.mark.parametrize("count", [5, 10])
def test_intervals_and_alarms_hold_with_few_averages(count: int) -> None:
    places, beams, q, sd = scene(1)
    rng = np.random.default_rng([1, count])
    value = readings(places, beams, q) + sd * complex_noise(rng, sd.shape)
    freedom = 2 * (count - 1)
    stated = sd * np.sqrt(rng.chisquare(freedom, sd.shape) / freedom)
    made, notices = steady_noise(stated, count, "stapes", from_coherence=False)
    model = beam_set("stapes", places, beams, DOF_NAMES)
    inside, alarms = covered(fit_lines(model, value, made), q)
    assert 0.94 < inside < 0.96
    assert 0.03 < alarms < 0.07
    assert covered(fit_lines(model, value, stated), q)[1] > 0.1
    assert [notice.code for notice in notices] == ["noise_steadied"]


def test_coherence_of_averaged_spectra_gives_the_true_noise() -> None:
    places, beams, q, sd = scene(2)
    rng = np.random.default_rng(2)
    count = 10
    drive = np.repeat(complex_noise(rng, (count, 9, LINES)), 3, axis=1)
    clean = readings(places, beams, q)
    read = clean * drive + sd * np.sqrt(2.0 * count) * complex_noise(rng, (count, *sd.shape))
    sxx = np.mean(np.abs(drive) ** 2, axis=0)
    syy = np.mean(np.abs(read) ** 2, axis=0)
    sxy = np.mean(drive.conj() * read, axis=0)
    value, coherence = sxy / sxx, np.abs(sxy) ** 2 / sxx / syy
    stated = np.abs(value) * np.sqrt((1.0 - coherence) / (2.0 * count * coherence))
    made, _ = steady_noise(stated, count, "stapes")
    truth = sd * np.sqrt(2.0 / sxx)
    assert np.mean((stated / truth) ** 2) == pytest.approx(0.9, rel=0.02)
    assert np.mean((truth / stated) ** 2) == pytest.approx(1.25, rel=0.03)
    assert np.mean((truth / made) ** 2) == pytest.approx(1.0, rel=0.05)
    inside, alarms = covered(fit_lines(beam_set("stapes", places, beams, DOF_NAMES), value, made), q)
    assert 0.94 < inside < 0.96
    assert 0.03 < alarms < 0.07


@pytest.mark.parametrize(("channels", "count"), [(27, 3), (27, 5), (12, 5), (9, 10)])
def test_channels_recorded_together_share_the_roughness_of_a_random_excitation(
    channels: int, count: int
) -> None:
    made_of = []
    for seed in range(2):
        places, beams, q, sd = (part[:channels] for part in scene(20 + seed))
        q = scene(20 + seed)[2]
        rng = np.random.default_rng([20 + seed, count])
        drive = complex_noise(rng, (count, 1, LINES))
        clean = readings(places, beams, q)
        read = clean * drive + sd * np.sqrt(2.0 * count) * complex_noise(rng, (count, *sd.shape))
        sxx = np.mean(np.abs(drive) ** 2, axis=0)
        sxy = np.mean(drive.conj() * read, axis=0)
        coherence = np.abs(sxy) ** 2 / sxx / np.mean(np.abs(read) ** 2, axis=0)
        stated = np.abs(sxy / sxx) * np.sqrt((1.0 - coherence) / (2.0 * count * coherence))
        made, _ = steady_noise(stated, count, "stapes")
        made_of.append(covered(fit_lines(beam_set("stapes", places, beams, DOF_NAMES), sxy / sxx, made), q))
    inside, alarms = np.mean(made_of, axis=0)
    assert 0.94 < inside < 0.965
    assert 0.04 < alarms < 0.06


def test_roughness_that_all_channels_share_stays() -> None:
    rng = np.random.default_rng(6)
    course = np.exp(rng.normal(size=LINES))
    sd = scene(6)[3] * course
    made, _ = steady_noise(
        sd * np.sqrt(rng.chisquare(18, sd.shape) / 18), 10.0, "stapes", from_coherence=False
    )
    assert np.std(np.log(made / sd)) < 0.1


@pytest.mark.parametrize("kind", ["smooth", "rough", "few lines", "steep"])
def test_noise_that_is_no_estimate_of_few_averages_stays_as_it_is(kind: str) -> None:
    rng = np.random.default_rng(3)
    sd = scene(3)[3]
    if kind == "rough":
        sd = sd * 10.0 ** rng.uniform(-0.5, 0.5, sd.shape)
    if kind == "few lines":
        sd = (sd * np.sqrt(rng.chisquare(18, sd.shape) / 18))[:, :20]
    if kind == "steep":
        coherence = np.linspace(0.5, 0.9999, 40)
        sd = np.tile(np.sqrt((1.0 - coherence) / coherence), (27, 1))
    made, notices = steady_noise(sd, 10.0, "stapes")
    assert made is sd
    assert notices == []


def test_a_line_whose_noise_stands_out_keeps_its_own_and_leaves_its_neighbours_alone() -> None:
    rng = np.random.default_rng(4)
    sd = scene(4)[3]
    sd[:, 700] *= 20.0
    stated = sd * np.sqrt(rng.chisquare(18, sd.shape) / 18)
    stated[:, 100:120] = np.nan
    made, _ = steady_noise(stated, np.full((27, 1), 10.0), "stapes", from_coherence=False)
    ratio = made / sd
    assert np.all(np.isnan(made[:, 100:120]))
    assert np.median(ratio[:, 700]) == pytest.approx(1.0, abs=0.15)
    assert np.nanmax(np.abs(ratio[:, 690:700] - 1.0)) < 0.25


def test_table_with_coherence_and_averages_is_steadied(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    freq = np.linspace(400.0, 5000.0, 200)
    rows = ["body,point,x_mm,y_mm,z_mm,dir,freq_hz,re_m_s,im_m_s,coherence,n_avg"]
    for point, place in enumerate([(0, 0, 0), (3, 0, 0), (0, 0, 2), (1, 2, 0)]):
        for axis in "xyz":
            noise = 2e-3 * rng.chisquare(18, len(freq)) / 18
            for f, share in zip(freq, noise, strict=True):
                cells = [*place, axis, f, 1e-3, 2e-4, 1.0 / (1.0 + share), 10]
                rows.append(f"stapes,{point}," + ",".join(str(c) for c in cells))
    path = tmp_path / "ldv.csv"
    path.write_text("\n".join(rows) + "\n")
    measurement = read_ldv(path)
    assert "noise_steadied" in {notice.code for notice in measurement.notices}
    sd = measurement.bodies[0].sd
    assert sd is not None
    speed = sd[0] * 2.0 * np.pi * freq
    expected = np.hypot(1e-3, 2e-4) * np.sqrt(2e-3 / 20.0 * 10.0 / 9.0)
    assert np.median(speed) == pytest.approx(expected, rel=0.02)
    assert np.std(np.log(speed)) < 0.1
