"""One body in rms or in another range: a few lines show it by the ligament, or it is said that none could."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.two_bodies import resized, shaken
from legacy.kinematics.faults.judges.phase_convention import phase_notice, rms_would_show, size_notices
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.report.detectable_sections import detectable_blocks
from tests.kinematics.ligament import study


def said(pair):
    return [notice.text for notice in size_notices(pair)]


@pytest.mark.parametrize("lines", [6, 9, 12, 40])
def test_one_body_in_rms_is_named_from_six_lines_on(lines):
    found = 0
    for seed in range(10):
        pair = shaken(seed, lines, off=0.02 * (seed % 2))
        assert said(pair) == []
        for factor, rms in ((np.sqrt(2.0), "base"), (np.sqrt(0.5), "stapes")):
            texts = said(resized(pair, factor))
            assert all(f"{rms} looks given in rms" in text for text in texts)
            found += len(texts)
    assert found >= 17


@pytest.mark.parametrize("factor", [2.0, 0.2, 10.0])
def test_another_range_of_a_body_is_named_with_its_factor(factor):
    found = 0
    for seed in range(8):
        texts = said(resized(shaken(20 + seed, 8), factor))
        assert all(f"with base {factor:.4g} times as large: one of the two bodies" in text for text in texts)
        found += len(texts)
    assert found >= 7


def test_another_range_in_one_run_is_named_with_its_run():
    found = 0
    for seed in range(6):
        texts = said(resized(shaken(40 + seed, 8, runs=3), 5.0, 1))
        assert all("with base 5 times as large in run 2 alone" in text for text in texts)
        found += len(texts)
    assert found >= 5


def test_clean_motions_of_any_band_and_noise_raise_nothing():
    rng = np.random.default_rng(6)
    for seed in range(60):
        low = rng.uniform(100.0, 1500.0)
        pair = shaken(
            100 + seed, int(rng.integers(2, 30)), band=(low, low * rng.uniform(3.0, 30.0)),
            runs=int(rng.integers(1, 4)), noise=np.exp(rng.uniform(np.log(0.003), np.log(0.1))),
            off=rng.choice([0.0, 0.02, 0.05]),
        )  # fmt: skip
        assert said(pair) == []


def test_other_errors_and_motions_without_a_ligament_are_not_taken_for_a_size():
    for seed in range(12):
        pair, other = shaken(200 + seed, 10), shaken(300 + seed, 10)
        swapped = replace(pair, structure=pair.base, base=pair.structure, sd=pair.sd[:, ::-1])
        for wrong in (
            replace(pair, base=-pair.base),
            replace(pair, base=pair.base.conj()),
            replace(pair, structure=pair.structure.conj(), base=pair.base.conj()),
            replace(pair, base=np.roll(pair.base, 2, axis=1)),
            replace(pair, base=other.base),
            swapped,
        ):
            assert said(wrong) == []


def test_the_size_of_a_body_that_bends_is_not_judged():
    motion = points2dof(study(5, lines=12)).motion
    q = motion.q.copy()
    q[:, 1] /= np.sqrt(2.0)
    slip = replace(motion, q=q)
    assert [notice.code for notice in phase_notice(slip)] == ["unit_slip"]
    assert phase_notice(slip, rigid=False) == []


def test_what_a_line_far_above_the_resonance_does_not_show_is_not_claimed():
    assert all(rms_would_show(shaken(seed, 12)) for seed in range(5))
    high = [shaken(400 + seed, 6, band=(7000.0, 12000.0), noise=0.1) for seed in range(5)]
    assert not any(rms_would_show(pair) for pair in high)


@pytest.mark.parametrize(
    ("noise", "sentence"), [(0.005, "would have been found"), (0.9, "could not be told")]
)
def test_the_page_says_whether_a_body_in_rms_would_have_been_found(noise, sentence):
    result = points2dof(study(3, lines=10, noise=noise))
    text = " ".join("".join(detectable_blocks(result)).split())
    assert f"{sentence} by the ligament" in text or f"{sentence} from these lines" in text
    assert ("readings of that body alone in rms" in text) == (sentence == "could not be told")


def test_a_motion_whose_noise_is_not_a_number_is_not_judged():
    pair = shaken(7, 12)
    sd = pair.sd.copy()
    sd[0, 1, 3] = np.nan
    still = replace(pair, structure=0.0 * pair.structure, base=0.0 * pair.base, sd=0.0 * pair.sd)
    assert said(resized(replace(pair, sd=sd), 2.0)) == []
    assert said(still) == []
