"""Channels that the user leaves out by their names in the files."""

from __future__ import annotations

import csv
import tomllib

import numpy as np
import pytest

from legacy.kinematics.cli import work
from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.exclude_channels import without_channels
from legacy.kinematics.measurement import from_arrays
from legacy.kinematics.options import LdvOptions
from legacy.stapeskit.options import read_table
from tests.kinematics.simulated import HEADER, csv_rows, scene

pytestmark = pytest.mark.usefixtures("undrawn")

FREQ = np.array([500.0, 1000.0])


def two_bodies():
    made = {}
    for name in ("stapes", "a:b"):
        points = ("1", "1", "2", "p:3")
        made[name] = {
            "points": points,
            "positions_mm": np.arange(12.0).reshape(4, 3),
            "directions": np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 0.6, 0.8], [0, 1.0, 0]]),
            "value": np.arange(8.0).reshape(4, 2) + 1.0,
            "sd": np.ones((4, 2)),
        }
    return from_arrays(made, FREQ, order=0)


@pytest.mark.parametrize(
    ("name", "body", "kept"),
    [
        ("stapes:1", 0, ("2", "p:3")),
        ("stapes:1:-z", 0, ("1", "2", "p:3")),
        ("stapes:2:0,0.6,0.8", 0, ("1", "1", "p:3")),
        ("stapes:p:3", 0, ("1", "1", "2")),
        ("a:b:p:3:y", 1, ("1", "1", "2")),
    ],
)
def test_points_and_beams_go_with_all_that_belongs_to_them(name, body, kept):
    before = two_bodies()
    after = without_channels(before, [name])
    assert after.bodies[body].points == kept
    left = [
        k for k in range(4) if before.bodies[body].displacement[0, k, 0] in after.bodies[body].displacement
    ]
    for field in ("positions_mm", "directions", "reported_directions", "reported_positions_mm"):
        assert np.array_equal(getattr(after.bodies[body], field), getattr(before.bodies[body], field)[left])
    assert len(after.left_out) == 4 - len(kept)
    assert after.bodies[1 - body].points == before.bodies[1 - body].points


@pytest.mark.parametrize(
    ("names", "got"),
    [
        (["stapes:4"], ["stapes:4"]),
        (["stapes:1:y", "incus:1"], ["stapes:1:y", "incus:1"]),
        (["stapes:1", "stapes:2", "stapes:p:3"], ["all 4"]),
    ],
)
def test_names_that_mean_nothing_are_refused_together(names, got):
    with pytest.raises(KinematicsError) as caught:
        without_channels(two_bodies(), names)
    assert [fault.got for fault in caught.value.faults] == got
    assert {fault.thing for fault in caught.value.faults} == {"{leave_out}"}


def test_the_command_leaves_out_what_spoils_the_motion_and_lists_it(tmp_path):
    made = scene(3, lines=12)
    rows = csv_rows("stapes", made)
    point = made.points[0]
    spoilt = list(rows)
    for k, row in enumerate(spoilt):
        cells = row.split(",")
        if cells[1] == point:
            cells[HEADER.split(",").index("re_m_s")] = "1.0"
            spoilt[k] = ",".join(cells)
    for name, text in (("good.csv", rows), ("bad.csv", spoilt)):
        (tmp_path / name).write_text("\n".join([HEADER, *text]) + "\n")
    results = []
    for name in ("good.csv", "bad.csv"):
        out = tmp_path / f"dof_{name}"
        work([str(tmp_path / name), "--leave-out", f"stapes:{point}", "--out", str(out)])
        results.append(out.read_text())
    assert results[0] == results[1]
    with (tmp_path / "dof_bad.channels.csv").open() as stream:
        listed = [row for row in csv.DictReader(stream) if row["verdict"] == "unused"]
    assert {(row["body"], row["point"], row["estimate"]) for row in listed} == {("stapes", point, "left out")}


def test_a_study_holds_the_same_names(tmp_path):
    (tmp_path / "ldv.csv").write_text("x")
    table = tomllib.loads('file = "ldv.csv"\nleave_out = ["stapes:3", "base:7:z"]\n')
    options, faults = read_table(LdvOptions, table, "study.toml", tmp_path)
    assert not faults
    assert options.leave_out == ("stapes:3", "base:7:z")
    assert options.parameters()["leave_out"] == ["stapes:3", "base:7:z"]
