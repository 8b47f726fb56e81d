"""The options of points2dof on where the vibrometer stood, on a scan's folder as ct2mass leaves it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from legacy.kinematics.cli import work
from legacy.stapeskit.faults import StapeskitError
from tests.kinematics.registration.test_sample_displacement import (
    MARKS,
    PLATE,
    SCAN_FROM_PLATE,
    VIBROMETER,
    bone_places,
    scan,
    setting,
)
from tests.kinematics.surfaces import on_faces

pytestmark = pytest.mark.usefixtures("undrawn")

__all__ = ["scan"]


@pytest.fixture
def files(tmp_path):
    """Write ldv.csv, points.csv, fiducials.csv, plate.csv and bone.csv."""
    measurement, marks = setting(6)
    rng = np.random.default_rng(12)
    rows, places = [], []
    for body in measurement.bodies:
        beams = VIBROMETER.inverse().vectors(np.array([[0.3, 0, 1], [-0.2, 0.3, 1], [-0.2, -0.3, 1]]))
        beams /= np.linalg.norm(beams, axis=1)[:, None]
        motion = rng.normal(size=(6, 2)) @ [1, 1j]
        for name, place in zip(body.points, body.positions_mm, strict=True):
            places.append(f"{body.body},{name},{','.join(f'{v:.9g}' for v in place)},0.01")
            for beam in beams:
                clean = (motion[:3] + np.cross(motion[3:], place * 0.1)) @ beam
                for freq in (500.0, 600.0, 700.0):
                    value = 1e-4 * (clean + 0.01 * rng.normal(size=2) @ [1, 1j])
                    direction = ",".join(f"{v:.12g}" for v in beam)
                    rows.append(
                        f"{body.body},{name},{direction},{freq},{value.real:.9g},{value.imag:.9g},1e-6"
                    )
    head = "body,point,dir_x,dir_y,dir_z,freq_hz,re_m_s,im_m_s,sd_m_s"
    (tmp_path / "ldv.csv").write_text("\n".join([head, *rows]) + "\n")
    (tmp_path / "points.csv").write_text("\n".join(["body,point,x_mm,y_mm,z_mm,sd_mm", *places]) + "\n")
    listed = [
        f"{name},{','.join(f'{v:.9g}' for v in (*a, *b))},plate,0.01"
        for name, a, b in zip("abcdef", marks.vibrometer_mm, MARKS, strict=True)
    ]
    head = "name,x_mm,y_mm,z_mm,x_ref_mm,y_ref_mm,z_ref_mm,frame,sd_mm"
    (tmp_path / "fiducials.csv").write_text("\n".join([head, *listed]) + "\n")
    plate = SCAN_FROM_PLATE.points(on_faces(PLATE, rng, 50))
    for name, seen in (("plate", plate), ("bone", bone_places(6) + np.array([0.0, 0.0, 0.15]))):
        noisy = VIBROMETER.inverse().points(seen) + 0.01 * rng.normal(size=seen.shape)
        text = "\n".join(f"{','.join(f'{v:.9g}' for v in place)},0.01" for place in noisy)
        (tmp_path / f"{name}.csv").write_text(f"x_mm,y_mm,z_mm,sd_mm\n{text}\n")
    return tmp_path


def run(files, scan, *more, fiducials=True):
    arguments = [str(files / "ldv.csv"), "--points", str(files / "points.csv")]
    arguments += ["--mass", str(scan[0] / "mass.json")]
    if fiducials:
        arguments += ["--fiducials", str(files / "fiducials.csv")]
    return work([*arguments, *map(str, more), "--out", str(files / "dof.csv"), "--quiet"])[1]


def test_plate_points_bone_points_and_calibration_reach_every_output(files, scan):
    more = ["--plate-points", files / "plate.csv", "--bone-points", files / "bone.csv", "--calibrate"]
    more += ["--axes-sd", "0.5", "--beam-sd", "0.2", "--gain-sd", "0.5"]
    done = run(files, scan, *more, fiducials=False)
    told = json.loads(json.dumps(done.result))
    assert told["registration"]["kind"] == "plate points"
    assert 0.0 < told["registration"]["error_at_footplate_centre_mm"] < 0.05
    assert [check["body"] for check in told["surface_checks"]] == ["bone", "stapes", "base"]
    assert told["surface_checks"][0]["p_value"] < 1e-3 < told["surface_checks"][1]["p_value"]
    prior = dict(zip(told["calibration"]["names"], told["calibration"]["prior_sd_si"], strict=True))
    assert prior["axes.alpha"] == pytest.approx(np.deg2rad(0.5))
    assert prior["gain.laser1"] == pytest.approx(0.005)
    assert prior["position.stapes.0.x"] == pytest.approx(1e-5)
    codes = {notice.code for notice in done.notices}
    assert {"calibrated", "sample_moved"} <= codes
    page = (files / "dof.html").read_text(encoding="utf-8")
    for heading in (
        "Points on the surfaces of the scan",
        "Geometry estimated with the motion",
        "plate points",
    ):
        assert heading in page
    words = " ".join(f"{a} {b}" for a, b in done.rows)
    assert "plate points" in words
    assert "bone on the bone" in words
    assert "axes turned" in words


def test_without_the_options_fiducials_and_checks_are_told(files, scan):
    told = run(files, scan).result
    assert told["registration"]["kind"] == "fiducials"
    assert told["calibration"] is None
    assert [check["surface"] for check in told["surface_checks"]] == ["stapes", "bone"]


@pytest.mark.parametrize(
    ("more", "match"),
    [
        (["--axes-sd", "1"], "--axes-sd must be given with --calibrate"),
        (["--calibrate", "--beam-sd", "-1"], "--beam-sd must be a number from 0 to 20"),
        (["--plate-points", "none.csv"], "--plate-points must be an existing .*; got none.csv"),
        (["--bone-points", "none.csv"], "--bone-points must be an existing .*; got none.csv"),
    ],
)
def test_options_that_do_not_go_together_are_refused(files, scan, more, match):
    with pytest.raises(StapeskitError, match=match):
        run(files, scan, *more)


def test_surface_points_need_a_mass_file_and_no_frame(files):
    base = [str(files / "ldv.csv"), "--points", str(files / "points.csv"), "--plate-points",
            str(files / "plate.csv"), "--frame", "footplate"]  # fmt: skip
    with pytest.raises(StapeskitError, match=r"--plate-points must be given with --mass") as told:
        work(base)
    assert "--frame must be left out when --plate-points is given" in str(told.value)


def test_positions_that_alone_are_mirrored_are_refused_and_cured(files, scan):
    """Turn y of all positions round in the files: refused by fiducials, right with --mirror-points."""
    from legacy.stapeskit.records.motion_files import read_motion

    run(files, scan)
    wanted = read_motion(files / "dof.h5").q
    for name, column in (("points", 3), ("fiducials", 2)):
        path = files / f"{name}.csv"
        head, *rows = path.read_text().splitlines()
        cells = [row.split(",") for row in rows]
        for row in cells:
            row[column] = str(-float(row[column]))
        path.write_text("\n".join([head, *(",".join(row) for row in cells)]) + "\n")
    with pytest.raises(StapeskitError, match="right-handed"):
        run(files, scan)
    run(files, scan, "--mirror-points", "y")
    assert np.allclose(read_motion(files / "dof.h5").q, wanted, rtol=1e-6, atol=1e-16)
