"""Rows under the label of another body, point, run or frequency, and rows in the other phase convention."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.kinematics.faults.judges.row_labels import label_findings
from legacy.kinematics.faults.proposals.clean_motion import chosen_lines, fit_clean_motion
from legacy.kinematics.points2dof import points2dof
from tests.kinematics.ligament import altered, channels_of, exchanged, relisted, study, with_lines


def accused(data):
    """Return {(run, body): (channels, verdicts, texts)} of what is not ok."""
    made = {}
    number = dict.fromkeys(((r, b.body) for r in data.runs for b in data.bodies), 0)
    for verdict in points2dof(data).channels:
        key = (verdict.run, verdict.body)
        if verdict.verdict != "ok":
            entry = made.setdefault(key, ([], set(), set()))
            entry[0].append(number[key])
            entry[1].add(verdict.verdict)
            entry[2].add(verdict.estimate)
        number[key] += 1
    return made


@pytest.mark.parametrize("noise", ["stated", "left", "unknown"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_rows_exchanged_between_bodies_are_named_on_both(seed, noise):
    data = exchanged(study(seed, sd=noise != "unknown"), "3", "5", noise == "stated")
    found = accused(data)
    assert found == {
        ("1", "stapes"): (
            [6, 7, 8],
            {"label_swap"},
            {"point 3 of body stapes and point 5 of body base exchanged"},
        ),
        ("1", "base"): (
            [12, 13, 14],
            {"label_swap"},
            {"point 5 of body base and point 3 of body stapes exchanged"},
        ),
    }


def test_a_single_beam_exchanged_between_bodies_is_named():
    found = accused(exchanged(study(4), 10, 4))
    assert {key: (entry[0], entry[1]) for key, entry in found.items()} == {
        ("1", "stapes"): ([10], {"label_swap"}),
        ("1", "base"): ([4], {"label_swap"}),
    }


@pytest.mark.parametrize(("number", "of", "under"), [(0, "stapes", "base"), (1, "base", "stapes")])
def test_a_point_listed_under_the_other_body_is_named_with_both(number, of, under):
    found = accused(relisted(study(5), number, "4"))
    assert list(found) == [("1", under)]
    channels, verdicts, texts = found["1", under]
    assert (channels, verdicts) == ([27, 28, 29], {"label_swap"})
    assert texts == {
        f"point extra of body {under} moves with body {of}, at its own position: it belongs to {of}"
    }


def test_rows_of_a_point_under_another_run_are_named_in_both():
    def swapped(value):
        return value[::-1]

    data = study(6, ("y", "x"))
    found = accused(altered(data, 0, channels_of(data.bodies[0], "2"), swapped))
    assert set(found) == {("1", "stapes"), ("2", "stapes")}
    assert all(entry[0] == [3, 4, 5] and entry[1] == {"label_swap"} for entry in found.values())
    assert found["2", "stapes"][2] == {"rows of point 2 of body stapes under run 2 are those of run 1"}


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("channels", [[7], [6, 7, 8]])
@pytest.mark.parametrize("number", [0, 1])
def test_conjugated_rows_of_a_channel_or_point_are_named(number, channels, sign):
    found = accused(altered(study(7), number, channels, lambda value: sign * value.conj()))
    ((key, entry),) = found.items()
    assert key == ("1", ("stapes", "base")[number])
    assert entry[:2] == (channels, {"sign"})
    assert "e^{-iwt}" in next(iter(entry[2]))


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("shift", [1, -2])
def test_rows_at_shifted_frequencies_are_named(shift, order):
    data = replace(study(8), order=order)
    lines = np.arange(len(data.freq_hz)) - shift
    lines = np.where(lines < len(data.freq_hz), lines, -1)
    found = accused(with_lines(data, 0, [3, 4, 5], np.maximum(lines, -1)))
    assert {key: entry[:2] for key, entry in found.items()} == {("1", "stapes"): ([3, 4, 5], {"label_swap"})}
    (text,) = found["1", "stapes"][2]
    step = 4600.0 / 119.0 * shift
    assert f"frequencies are off by {step:.4g} Hz" in text


@pytest.mark.parametrize("runs", [("y",), ("y", "x")])
def test_clean_recordings_of_both_bodies_are_not_accused(runs):
    for seed in range(20, 24):
        assert points2dof(study(seed, runs)).notices == ()


def test_faults_of_a_single_point_are_not_taken_for_wrong_labels():
    kinds = {
        "gain": lambda v: 1.05 * v,
        "sign": np.negative,
        "drift": lambda v: v * np.linspace(1.0, 1.1, 120),
    }
    for seed, (kind, change) in enumerate(kinds.items()):
        found = accused(altered(study(30 + seed, ("y", "x")), 0, [4], change))
        assert {key: entry[:2] for key, entry in found.items()} == {
            (run, "stapes"): ([4], {kind}) for run in ("1", "2")
        }


def test_channels_that_leave_no_residual_at_all_are_not_judged():
    result = points2dof(exchanged(study(9, lines=40), "3", "5"))
    motions = {}
    for key, fit in result.fits.items():
        lines = chosen_lines(fit.solution.good)
        motions[key] = fit_clean_motion(key, fit, result.measurement, fit.beams, fit.noise.at(lines), lines)
    assert set(label_findings(motions, ("1",))) == {(0, 0), (0, 1)}
    still = {key: replace(found, level=0.0) for key, found in motions.items()}
    assert label_findings(still, ("1",)) == {}
