"""The contract of every alternative: it proposes something where it is so, in words, with a known warning."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.fault_bodies import draw
from benchmarks.fault_scenes import measured, scene
from benchmarks.two_bodies import shaken
from legacy.kinematics.faults.alternatives import ALTERNATIVES, proposed
from legacy.kinematics.faults.catalogue import ADVICE
from legacy.kinematics.faults.proposals.clean_motion import fit_clean_motion
from legacy.kinematics.faults.proposals.exchanges import Layout
from legacy.kinematics.faults.proposals.misfitting_body import MisfittingBody
from legacy.kinematics.faults.proposals.outliers import with_far_values
from legacy.kinematics.faults.proposals.row_places import Rows
from legacy.kinematics.fit.beams import beam_set
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.kinematics.points2dof import points2dof
from legacy.stapeskit.spatial import DOF_NAMES
from legacy.stapeskit.warnings import table
from tests.kinematics.faults.test_catalogue import data_of
from tests.kinematics.faults.test_causes import SPOILED, STAPES, hum
from tests.kinematics.faults.test_unit_slips import SLIPS, changed, right
from tests.kinematics.ligament import study
from tests.kinematics.simulated import scene as small_scene

FREQ = np.linspace(200.0, 6000.0, 60)


def decibels():
    data = right()
    rate = 2j * np.pi * data.freq_hz
    velocity = data.bodies[0].displacement * rate
    level = 20.0 * np.log10(np.abs(velocity) / np.median(np.abs(velocity))) + 90.0
    return changed(data, displacement=level * velocity / np.abs(velocity) / rate)


def misfitting(code):
    """Return a body with a cause that many channels share, by its code."""
    (spoil, *_), made = SPOILED[code], scene(830_001, STAPES)
    if spoil is hum:
        made = replace(made, freq_hz=400.0 + 12.5 * np.arange(len(made.freq_hz)))
    value = measured(made, 1)
    spoil(made, value, np.random.default_rng(1))
    body = BodyChannels("stapes", made.points, made.reported, made.directions, value[None], made.sd[None])
    data = Measurement("footplate", ("1",), made.freq_hz, (body,), 0)
    beams = beam_set("stapes", body.positions_mm, body.directions, DOF_NAMES)
    return with_far_values(MisfittingBody(data, 0, body, beams, True))


def suspected(made):
    """Return a reading of ``fault_bodies`` as a body whose misfit is to be explained."""
    body = BodyChannels(
        "incus", tuple(made.points), made.positions_mm, made.directions, made.value[None], made.sd[None]
    )
    data = Measurement("footplate", ("1",), made.freq_hz, (body,), 1)
    beams = beam_set("incus", made.positions_mm, made.directions, DOF_NAMES)
    return with_far_values(MisfittingBody(data, 0, body, beams, True))


@cache
def rows(lines):
    """Return the rows of a point of one of two bodies in two runs, at some lines."""
    data = study(1, ("y", "x"), lines=40)
    motions = {
        key: fit_clean_motion(key, fit, data, fit.beams, fit.noise.at(np.array(lines)), np.array(lines))
        for key, fit in points2dof(data).fits.items()
    }
    return Rows(motions[0, 0], "3", data.bodies[0].positions_mm[6] * 1e-3, motions, data.runs)


def layout():
    made = small_scene(20)
    data = data_of(made)
    lasers = [list(range(k, 27, 3)) for k in range(3)]
    return Layout(data, data.by_point, lasers, made.positions_mm, np.eye(3), list(data.by_point))


def jumping():
    readings = np.exp(1j * FREQ / 900.0)[:, None]
    readings[[20, 40]] = readings[[40, 20]]
    return readings, np.full(readings.shape, 1e-3), FREQ


def pair():
    return shaken(1, 60, even=True, runs=3)


# By what is proposed otherwise, or by the name of the alternative where only its own example shows it.
EXAMPLES = {
    "points in another unit": lambda: SLIPS["like m under"](right()),
    "frequencies in another unit": lambda: SLIPS["like kHz"](right()),
    "bodies in different units": lambda: SLIPS["base moves 1e+03 times"](right()),
    "phases in radians": lambda: SLIPS["radians"](right()),
    "decibels": decibels,
    "speed": lambda: changed(right(), displacement=1e6 * right().bodies[0].displacement),
    "conjugated laser": lambda: misfitting("conjugated_laser"),
    "mains": lambda: misfitting("mains_lines"),
    "ranges": lambda: misfitting("unit_slip"),
    "outliers": lambda: misfitting("sparse_outliers"),
    "drift between points": lambda: misfitting("drift_between_points"),
    "drift of the motion": lambda: suspected(draw(1, "shell, 12 points, 3 heads", "drying 3 %")),
    "scattered gains": lambda: misfitting("gains_scattered"),
    "exchange": layout,
    "rows": lambda: rows(tuple(range(40))),
    "two rows": lambda: rows((10, 30)),
    "lines": lambda: FREQ,
    "course": jumping,
    "pair": pair,
    "size": pair,
    "lag": pair,
}
# What the judges know of two bodies and of the lines of a body.
KNOWN = {
    **dict.fromkeys(("structure", "base", "leading", "conjugated", "sure", "bodies", "because"), "x"),
    "lead": 1.0,
}


@pytest.mark.parametrize("name", list(ALTERNATIVES))
def test_an_alternative_is_proposed_in_words_with_a_known_warning(name):
    entry = ALTERNATIVES[name]
    given = EXAMPLES.get(name) or EXAMPLES[entry.of]
    proposals = [one for one in proposed(entry.of, given()) if one.name == name]
    assert proposals
    assert (entry.code or ADVICE[entry.verdict][0]) in table()
    for proposal in proposals:
        known = replace(proposal, words={**KNOWN, **proposal.words})
        assert known.notice().text == known.text
        assert not set("{}") & set(known.text.replace("e^{-iwt}", ""))
        assert not set("{}") & set(known.step)
        assert entry.estimate.format(**known.words) or entry.of not in ("lines", "course")


def test_what_is_tried_only_for_a_misfit_is_not_proposed_below_it():
    above = {name for name, entry in ALTERNATIVES.items() if entry.above > 0.0 and entry.of == "pair"}
    assert above
    assert not above & {one.name for one in proposed("pair", pair(), 0.0)}


@pytest.mark.parametrize(
    "name", [name for name, entry in ALTERNATIVES.items() if entry.of in ("pair", "size")]
)
def test_labels_of_two_bodies_keep_the_shape_of_their_motion(name):
    given = pair()
    for one in proposed(ALTERNATIVES[name].of, given):
        other = one.value
        assert other.structure.shape == other.base.shape
        assert other.sd.shape == (other.structure.shape[0], 2, *other.structure.shape[1:])
        assert len(other.freq_hz) == other.structure.shape[1]
