"""A fault put into any one channel of the sample study is found, and the report names it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kinematics.frames import RigidTransform
from kinematics.pages.report_faults import groups_of, verdict_section
from kinematics.points2dof import points2dof
from kinematics.tables.ldv_csv import read_ldv

SAMPLE = Path(__file__).resolve().parents[2] / "sample_volumes"


def words(text):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", text))


@pytest.fixture(scope="module")
def sample():
    """The sample study's readings about the middle of their points, every fourth line."""
    read = read_ldv(SAMPLE / "ldv.csv", SAMPLE / "points.csv", "vibrometer")
    middle = np.mean(np.concatenate([b.positions_mm for b in read.bodies]), axis=0)
    placed = read.mapped(RigidTransform.from_parts(np.eye(3), -middle, "footplate", "vibrometer"))
    bodies = tuple(
        replace(b, displacement=b.displacement[:, :, ::4], sd=b.sd[:, :, ::4]) for b in placed.bodies
    )
    return replace(placed, bodies=bodies, freq_hz=read.freq_hz[::4])


def spoiled(channels, channel, kind):
    value = channels.displacement.copy()
    if kind == "noise":
        rng = np.random.default_rng(channel)
        value[0, channel] += (
            5.0 * channels.sd[0, channel] * (rng.normal(size=(value.shape[2], 2)) @ [1.0, 1j])
        )
    else:
        lines = np.linspace(0.0, 1.0, value.shape[2])
        value[0, channel] *= {"gain": 1.1, "sign": -1.0, "zeros": 0.0, "drift": 1.0 + 0.15 * lines}[kind]
    return replace(channels, displacement=value)


@pytest.mark.parametrize("number", [0, 1])
def test_a_fault_in_any_one_channel_of_the_sample_is_found_and_named(sample, number):
    channels = sample.bodies[number]
    kinds = ("gain", "sign", "zeros", "noise", "drift")
    for channel in range(len(channels.points)):
        kind = kinds[(channel + number) % len(kinds)]
        made = points2dof(replace(sample, bodies=(spoiled(channels, channel, kind),)))
        point = channels.points[channel]
        beam = [c for c, name in enumerate(channels.points) if name == point].index(channel) + 1
        (group,) = groups_of(made)
        assert (group.verdict.verdict, group.names[0].split(" (")[0]) == (kind, f"{point}, beam {beam}")
        assert group.names[0] in words("".join(verdict_section(made).blocks))
