"""Believe, check or do not use: by warnings and by what K and D do."""

from __future__ import annotations

import pytest

from legacy.pipeline.verdict import _TOGETHER, BELIEVE, CHECK, DO_NOT_USE, verdict
from legacy.stapeskit.warnings import VERDICTS, Notice, table

KD = {
    "dof": ["y"],
    "stable": True,
    "passive": {"stiffness": True, "damping": True},
    "stiffness_si": [[1700.0]],
    "stiffness_sd_si": [[17.0]],
    "damping_si": [[0.02]],
    "damping_sd_si": [[0.001]],
}


@pytest.mark.parametrize(
    ("codes", "level", "reasons"),
    [
        ((), BELIEVE, 0),
        (("dc_line",), BELIEVE, 0),
        (("handedness_unconfirmed", "dc_line"), CHECK, 1),
        (("handedness_unconfirmed", "sample_moved"), DO_NOT_USE, 2),
        (("misfit",), CHECK, 1),  # noise stated too small does it too, and widens the standard deviations
        (("flexible",), CHECK, 1),
        (("frequency_dependent",), CHECK, 1),
        (("misfit", "frequency_dependent"), DO_NOT_USE, 2),
        (("handedness_unconfirmed", "flexible", "frequency_dependent"), DO_NOT_USE, 3),
    ],
)
def test_the_worst_warning_decides(codes, level, reasons):
    found = verdict(KD, [Notice(code, "text") for code in codes])
    assert (found.level, len(found.reasons)) == (level, reasons)
    assert not found.reasons or found.reasons[0].level == level


@pytest.mark.parametrize(
    ("change", "level"),
    [
        ({"stable": False}, DO_NOT_USE),
        ({"passive": {"stiffness": True, "damping": False}}, CHECK),
        ({"damping_sd_si": [[0.01]]}, CHECK),
        ({"stiffness_sd_si": [[None]]}, BELIEVE),
        ({"stiffness_sd_si": [[600.0]]}, CHECK),
        ({"stiffness_sd_si": [[1800.0]]}, DO_NOT_USE),
    ],
)
def test_numbers_decide_too(change, level):
    assert verdict(KD | change, []).level == level


def test_every_warning_leads_to_a_verdict():
    assert {entry.verdict for entry in table().values()} == set(VERDICTS)
    assert all(code in table() for pair in _TOGETHER for code in pair)
