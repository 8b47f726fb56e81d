"""A fault put into one channel or point of the sample study is found, and the report names it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.report.fault_sections import groups_of, verdict_section
from legacy.kinematics.tidy.ldv_csv import read_ldv
from legacy.stapeskit.frames import RigidTransform
from tests.kinematics.ligament import altered, channels_of, exchanged, relisted

SAMPLE = Path(__file__).resolve().parents[3] / "sample_volumes"


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


@pytest.fixture(autouse=True)
def without_detectable(monkeypatch):
    """Leave out how large an error would have to be to show, which takes a tenth of the time."""
    monkeypatch.setattr("legacy.kinematics.report.fault_sections.detectable_blocks", lambda *_: [])


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
def test_a_fault_in_one_channel_of_the_sample_is_found_and_named(sample, number):
    channels = sample.bodies[number]
    kinds = ("gain", "sign", "zeros", "noise", "drift")
    tried = set()
    for channel in range(number, len(channels.points), 4):
        kind = kinds[(channel + number) % len(kinds)]
        made = points2dof(replace(sample, bodies=(spoiled(channels, channel, kind),)))
        point = channels.points[channel]
        beam = [c for c, name in enumerate(channels.points) if name == point].index(channel) + 1
        tried |= {kind, beam}
        (group,) = groups_of(made)
        assert (group.verdict.verdict, group.names[0].split(" (")[0]) == (kind, f"{point}, beam {beam}")
        assert group.names[0] in words("".join(verdict_section(made).blocks))
    assert tried == {*kinds, 1, 2, 3}


def moved(data, number, own):
    """A point off its place by 0.4 mm, on the base, which hardly turns, by 1.2 mm."""
    body = data.bodies[number]
    positions = body.positions_mm.copy()
    shift = np.random.default_rng(own[0]).normal(size=3)
    positions[own] += (0.4, 1.2)[number] * shift / np.linalg.norm(shift)
    return replace(
        data, bodies=tuple(replace(body, positions_mm=positions) if b is body else b for b in data.bodies)
    )


def named_as(data, number, own, other):
    """A point and another one of its body under each other's name."""
    body = data.bodies[number]
    positions = body.positions_mm.copy()
    positions[own], positions[other] = body.positions_mm[other[0]], body.positions_mm[own[0]]
    return replace(
        data, bodies=tuple(replace(body, positions_mm=positions) if b is body else b for b in data.bodies)
    )


def accused(made):
    return {
        (group.verdict.body, group.verdict.verdict, names.split(",")[0])
        for group in groups_of(made)
        for names in group.names
    }


@pytest.mark.parametrize("number", [0, 1])
def test_faults_of_points_of_the_sample_are_found_and_named(sample, number):
    body, other = sample.bodies[number], sample.bodies[1 - number]
    points = list(dict.fromkeys(body.points))
    for k, point in enumerate(points[::2]):
        own, beside = channels_of(body, point), points[(2 * k + 3) % len(points)]
        partner = list(dict.fromkeys(other.points))[(2 * k) % 9]
        kind = ("position", "conjugate", "names", "bodies", "listed")[k % 5]
        expected = {(body.body, "label_swap", point)}
        if kind == "position":
            data, expected = moved(sample, number, own), {(body.body, "position", point)}
        elif kind == "conjugate":
            data, expected = altered(sample, number, own, np.conj), {(body.body, "sign", point)}
        elif kind == "names":
            data = named_as(sample, number, own, channels_of(body, beside))
            expected.add((body.body, "label_swap", beside))
        elif kind == "bodies":
            data = exchanged(sample, *((point, partner) if number == 0 else (partner, point)))
            expected.add((other.body, "label_swap", partner))
        else:
            data, expected = relisted(sample, number, point), {(other.body, "label_swap", "extra")}
        made = points2dof(data)
        assert accused(made) == expected, (kind, point)
        section = words("".join(verdict_section(made).blocks))
        assert all(name in section for _, name, _ in expected)


@pytest.mark.parametrize("channels", [[1, 16], [8, 23]])
def test_conjugated_channels_and_exchanged_lines_of_the_sample_are_named(sample, channels):
    def two_lines(value):
        """Exchange what was read: displacements in the file's own power of the frequency."""
        rate, made = sample.freq_hz[[10, 40]] ** sample.order, value.copy()
        made[..., [10, 40]] = value[..., [40, 10]] * rate[::-1] / rate
        return made

    for number, (body, channel) in enumerate(zip(sample.bodies, channels, strict=True)):
        for change, verdict in ((np.conj, "sign"), (two_lines, "label_swap")):
            made = points2dof(altered(sample, number, [channel], change))
            assert accused(made) == {(body.body, verdict, body.points[channel])}
