"""The command from end to end: files in, files out, one sentence for every fault."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from legacy.kinematics.cli import work
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.registration.fiducials import read_fiducials
from legacy.kinematics.registration.placement import place
from legacy.kinematics.tidy.ldv_csv import read_ldv
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.records.mass_record import read_mass_record
from legacy.stapeskit.records.motion_files import read_motion, standard_deviation
from legacy.stapeskit.spatial import matrix_from_parameters
from sample_volumes.faults import Fault, faulty
from sample_volumes.old_study import write_recording
from sample_volumes.vibrometer import Vibrometry, base_motion, record, stapes_motion
from tests.kinematics.records import PARAMETERS, SCAN_FROM_FOOTPLATE, SCAN_FROM_PLATE, write_record
from tests.kinematics.simulated import HEADER, csv_rows, scene

pytestmark = pytest.mark.usefixtures("undrawn")

MARKS = [
    (name, np.array(place, dtype=float))
    for name, place in {
        "a": (-6, 0, -4),
        "b": (6, 0, -4),
        "c": (6, 0, 4),
        "d": (-6, 0, 4),
        "e": (0, 3, 0),
    }.items()
]
HOW = Vibrometry(lines=60, stapes_points=9, bone_points=8)


def make(folder, how=HOW, fault=None):
    """Write a simulated recording with its plate fiducials and a mass.json; return the common arguments."""
    mass = matrix_from_parameters(PARAMETERS)
    recording = record(mass, SCAN_FROM_FOOTPLATE.inverse() @ SCAN_FROM_PLATE, how, MARKS)
    recording = recording if fault is None else faulty(recording, fault)
    write_recording(folder, recording, how)
    write_record(folder)
    files = {"points": "points.csv", "fiducials": "fiducials.csv", "mass": "mass.json"}
    options = [f"--{name}={folder / file}" for name, file in files.items()]
    return [str(folder / "ldv.csv"), *options, "--out", str(folder / "out" / "dof.csv")]


def fitted(folder, mirror=""):
    """Run the library on a simulated recording."""
    mass = read_mass_record(folder / "mass.json")
    data = read_ldv(folder / "ldv.csv", folder / "points.csv")
    fiducials = read_fiducials(folder / "fiducials.csv")
    if mirror:
        data, fiducials = data.mirrored(mirror), fiducials.mirrored(mirror)
    return points2dof(data, place(fiducials, mass=mass), mass=mass)


def test_the_true_motion_is_found_within_its_uncertainty(tmp_path):
    _, outcome = work(make(tmp_path))
    motion = read_motion(tmp_path / "out" / "dof.csv")
    assert motion.bodies == ("stapes", "base")
    base = base_motion(motion.freq_hz, "y")
    from legacy.fitting.examples.paper import PAPER_DAMPING_CORRECTED, PAPER_STIFFNESS

    stapes = stapes_motion(
        motion.freq_hz, base, matrix_from_parameters(PARAMETERS), PAPER_STIFFNESS, PAPER_DAMPING_CORRECTED
    )
    error = motion.q[0] - np.stack([stapes, base])
    derivatives, shared = motion.shared.derivatives[:, 0], motion.shared.covariance
    systematic = np.real(np.einsum("pbfd,pq,qbfd->bfd", derivatives, shared, derivatives.conj()))
    total = np.sqrt(2.0 * standard_deviation(motion)[0] ** 2 + systematic)
    ratio = np.sqrt(np.mean(np.abs(error / total) ** 2))
    assert 0.5 < ratio < 1.6
    assert np.max(np.abs(error[:, :, 1])) < 0.05 * np.max(np.abs(stapes[:, 1]))
    sources = {name.split(".")[0] for name in motion.shared.names}
    lasers = {"laser_gain", "laser_phase", "laser_delay"}
    assert sources == {"registration", "plate_frame", "footplate_frame", "position"} | lasers
    assert outcome.notices == ()
    assert len(outcome.rows) + 2 <= 15


def test_exact_data_give_exact_motion(tmp_path):
    how = Vibrometry(lines=12, noise_free=True, stapes_points=9, bone_points=8)
    make(tmp_path, how)
    motion = fitted(tmp_path).motion
    base = base_motion(motion.freq_hz, "y")
    size = np.max(np.abs(base), axis=0)
    assert np.max(np.abs(motion.q[0, 1] - base) / size) < 1e-8
    assert {notice.code for notice in motion.notices} == {"noise_estimated"}


def test_a_left_handed_scanner_is_refused_and_turned_round(tmp_path):
    from dataclasses import replace

    arguments = make(tmp_path, replace(HOW, mirror="x"))
    with pytest.raises(StapeskitError, match=r"must be right-handed.*--mirror x, y or z"):
        work(arguments)
    mirrored = fitted(tmp_path, "x").motion
    make(tmp_path)
    assert np.allclose(mirrored.q, fitted(tmp_path).motion.q, rtol=1e-6, atol=1e-15)


def test_four_files_named_after_out(tmp_path):
    arguments = make(tmp_path, fault=Fault("sign", "stapes", "3", 1))
    _, outcome = work(arguments)
    names = ["dof.channels.csv", "dof.csv", "dof.h5", "dof.html"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [".stapeskit", *names]
    assert sorted(path.name for path in outcome.files) == names
    with (tmp_path / "out" / "dof.channels.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == [
        "run",
        "body",
        "point",
        "dir_x",
        "dir_y",
        "dir_z",
        "residual_rms_m",
        "weight",
        "verdict",
        "estimate",
        "p_value",
    ]
    assert len(rows) == 3 * 17
    bad = [row for row in rows if row["verdict"] != "ok"]
    assert [(row["body"], row["point"], row["verdict"]) for row in bad] == [("stapes", "3", "sign")]
    with (tmp_path / "ldv.csv").open() as stream:
        given = [row for row in csv.DictReader(stream) if (row["body"], row["point"]) == ("stapes", "3")]
    beams = list(dict.fromkeys((row["dir_x"], row["dir_y"], row["dir_z"]) for row in given))
    found = [float(bad[0][name]) for name in ("dir_x", "dir_y", "dir_z")]
    assert found == pytest.approx([float(part) for part in beams[1]], abs=1e-8)
    page = (tmp_path / "out" / "dof.html").read_text(encoding="utf-8")
    for words in (
        "Points and beams",
        "Verdict on every channel",
        "Registration",
        "channel_sign",
        "xxh3_128:",
    ):
        assert words in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert outcome.result["verdicts"][0]["verdict"] == "sign"
    json.dumps(outcome.result)


@pytest.mark.parametrize("kind", ["gain", "position", "zeros", "conjugate"])
def test_faults_of_the_sample_are_named(tmp_path, kind):
    size = {"gain": 0.08, "position": 0.3}.get(kind, 1.0)
    make(tmp_path, fault=Fault(kind, "stapes", "4", 2, size))
    wanted = {"zeros": "zero_rows", "conjugate": "phase_convention"}.get(kind, f"channel_{kind}")
    assert [notice.code for notice in fitted(tmp_path).notices] == [wanted]


def test_reference_and_subset(tmp_path):
    arguments = make(tmp_path)
    work([*arguments, "--dof", "y,alpha,gamma", "--reference", "base:y"])
    header = (tmp_path / "out" / "dof.csv").read_text(encoding="utf-8").splitlines()[0]
    assert header.startswith("run,body,freq_hz,y_re_m_per_ref,y_im_m_per_ref,alpha_re_rad_per_ref")
    motion = read_motion(tmp_path / "out" / "dof.h5")
    assert motion.reference == "base:y"
    assert np.allclose(motion.q[0, 1, :, 0], 1.0)
    assert motion.covariance.shape == (1, 60, 6, 6)


def write_plain(folder, seed=1, **more):
    """Write a table in the footplate frame with positions in it."""
    made = scene(seed, lines=5, **more)
    path = folder / "ldv.csv"
    path.write_text("\n".join([HEADER, *csv_rows("stapes", made)]) + "\n")
    return path, made


def test_without_fiducials_the_footplate_frame_is_meant(tmp_path, monkeypatch):
    path, made = write_plain(tmp_path, snr=1e7)
    monkeypatch.chdir(tmp_path)
    _, outcome = work([str(path), "--gain-sd", "0", "--phase-sd", "0", "--delay-sd", "0"])
    motion = read_motion(tmp_path / "dof.csv")
    assert np.max(np.abs(motion.q[0, 0] - made.q) / np.max(np.abs(made.q), axis=0)) < 1e-5
    assert motion.shared is None
    assert [str(file) for file in outcome.files] == ["dof.csv", "dof.h5", "dof.channels.csv", "dof.html"]


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (["--frame", "scan"], "--frame must be .*given with --mass mass.json; got scan"),
        (["--frame", "moon"], "--frame must be one of footplate, plate, scan; got moon"),
        (["--frame", "plate", "--fiducials", "f.csv"], "left out when --fiducials is given"),
        (["--out", "dof.xlsx"], "--out must be a file name that ends with .csv; got dof.xlsx"),
        (["--points", "nowhere.csv"], "--points must be an existing .*; got nowhere.csv"),
        (["--mass", "nowhere.json"], "--mass must be an existing .*; got nowhere.json"),
        (["--dof", "y,roll"], "--dof must be all, or a list"),
        (["--reference", "base:y"], "--reference must be BODY:DOF"),
        (["--robust", "median"], "--robust must be one of none, huber, t4; got median"),
        (["--calibration"], "--calibration must be a known option"),
    ],
)
def test_faulty_options_are_told_before_content(tmp_path, options, match):
    path, _ = write_plain(tmp_path)
    if "--reference" not in options:
        path.write_text("not,a,table\n")
    with pytest.raises(StapeskitError, match=match):
        work([str(path), *options])


def test_a_folder_at_the_place_of_the_output_is_refused_before_content(tmp_path):
    path, _ = write_plain(tmp_path)
    path.write_text("not,a,table\n")
    (tmp_path / "dof.csv").mkdir()
    with pytest.raises(StapeskitError, match="--out must be a file name"):
        work([str(path), "--out", str(tmp_path / "dof.csv")])


def test_a_fault_leaves_nothing_behind(tmp_path):
    path, _ = write_plain(tmp_path)
    path.write_text(path.read_text(encoding="utf-8").replace("stapes,1", "stapes,,1", 1))
    before = sorted(tmp_path.iterdir())
    with pytest.raises(StapeskitError, match="line"):
        work([str(path), "--out", str(tmp_path / "out" / "dof.csv")])
    assert sorted(tmp_path.iterdir()) == before


def command(*arguments, folder):
    code = "from kinematics.cli import main; main()"
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=Path(__file__).parents[2],
        env={"PYTHONPATH": str(Path(__file__).parents[2]), "HOME": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_process_ends_as_promised(tmp_path):
    path, _ = write_plain(tmp_path)
    done = command(str(path), "--out", str(tmp_path / "o.csv"), folder=tmp_path)
    assert done.returncode == 0
    assert done.stdout.splitlines()[0] == "points2dof"
    assert len(done.stdout.splitlines()) <= 15
    missing = command("nowhere.csv", folder=tmp_path)
    assert missing.returncode == 2
    assert "nowhere.csv" in missing.stderr
    assert missing.stderr.count("\n") == 1
    start = time.perf_counter()
    helped = command("--help", folder=tmp_path)
    assert time.perf_counter() - start < 1.5
    assert helped.returncode == 0
    assert "fiducials.csv: name, x_mm" in helped.stdout


def test_help_imports_nothing_heavy(tmp_path):
    code = "import sys; from kinematics.cli import parser; parser(); print(sorted(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=True,
    )
    for name in ("'numpy'", "'scipy'", "'pandas'", "'matplotlib'", "'h5py'", "'jinja2'"):
        assert name not in done.stdout


def recording_of(made, spread=True):
    """Return the rows of two bodies of one scene with all values replaced by a text."""

    def text(value):
        head = HEADER if spread else HEADER.rsplit(",", 1)[0]
        rows = [row.split(",") for body in ("stapes", "base") for row in csv_rows(body, made)]
        lines = [",".join([*row[:9], value, value, *(row[11:] if spread else [])]) for row in rows]
        return "\n".join([head, *lines]) + "\n"

    return text


def test_bodies_that_hold_nothing_are_refused(tmp_path):
    path = tmp_path / "ldv.csv"
    made = scene(3, lines=6)
    for spread, value, match in (
        (False, "nan", "values of body base must be numbers in at least one row.*NaN cells throughout"),
        (True, "", "values of body stapes must be numbers in at least one row"),
        (False, "0", "values of body stapes must be other than zero.*zeros throughout.*Give an sd column"),
    ):
        path.write_text(recording_of(made, spread)(value))
        with pytest.raises(StapeskitError, match=match) as caught:
            work([str(path), "--out", str(tmp_path / "dof.csv")])
        assert len(str(caught.value).splitlines()) == 2
    path.write_text(recording_of(made)("0"))
    _, outcome = work([str(path), "--out", str(tmp_path / "dof.csv")])
    assert {notice.code for notice in outcome.notices} == {"zero_rows"}


def test_a_body_with_too_few_channels_at_every_line_is_refused(tmp_path):
    made = scene(3, lines=12)
    rows = csv_rows("stapes", made)
    kept = [row for place, row in enumerate(rows) if (place // 12) % 12 == place % 12]
    (tmp_path / "ldv.csv").write_text("\n".join([HEADER, *kept]) + "\n")
    with pytest.raises(StapeskitError, match=r"body stapes must be measured by channels.*--dof"):
        work([str(tmp_path / "ldv.csv"), "--out", str(tmp_path / "dof.csv")])


@pytest.mark.parametrize("digits", [9, 12, 16])
def test_rounded_exact_data_are_rigid(tmp_path, digits):
    made = scene(5, lines=60, snr=1e15)
    rows = [row.rsplit(",", 1)[0] for row in csv_rows("stapes", made, digits)]
    (tmp_path / "ldv.csv").write_text("\n".join([HEADER.rsplit(",", 1)[0], *rows]) + "\n")
    _, outcome = work([str(tmp_path / "ldv.csv"), "--out", str(tmp_path / "dof.csv")])
    assert {notice.code for notice in outcome.notices} == {"noise_estimated"}
    assert outcome.result["verdicts"] == []
