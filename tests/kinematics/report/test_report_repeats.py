"""The page tells how repeats compare, before they were pooled."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from legacy.kinematics.measurement import Measurement, Take
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.report.repeat_sections import repeats_section
from tests.kinematics.simulated import body, scene


def test_the_repeat_that_differs_is_named_and_drawn():
    rng = np.random.default_rng(4)
    one = scene(3, lines=60)
    gains = np.array([1.0, 1.004, 0.998, 1.2, 1.001, 0.997, 1.003])
    noise = one.sd * (rng.normal(size=(len(gains), *one.value.shape, 2)) @ np.array([1.0, 1j]))
    channels = replace(
        body("stapes", one),
        displacement=gains[:, None, None] * one.value + noise,
        sd=np.repeat(1.5 * one.sd[None], len(gains), axis=0),
    )
    takes = tuple(Take("1", f"r{k + 1}") for k in range(len(gains)))
    made = points2dof(
        Measurement("footplate", tuple(t.name for t in takes), one.freq_hz, (channels,), 0, takes=takes)
    )
    text = "".join(repeats_section(made).blocks)
    bare = re.sub(r"<[^>]*>", " ", text)
    assert len(made.motion.runs) == 1
    assert "r4 differs by" in bare
    assert "amplitude of one repeat against the others" in bare
    assert "found" in bare
    for take in takes:
        assert take.name in bare
    assert 'alt="Relative amplitude and phase of 7 repeats"' in text
