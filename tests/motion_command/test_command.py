"""points2dof as a command and as a function: companions, outputs, refusals, provenance, page, JSON."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from scipy.io import loadmat

from fitting.dof2kd import dof2kd
from fitting.verdict import unused_codes
from kinematics.api import points2dof
from kinematics.cli import work
from kinematics.inputs import check_inputs, with_companions
from kinematics.options import MotionOptions
from kinematics.place.fiducials import read_fiducials
from kinematics.report.page import motion_verdict
from kinematics.results import ENDINGS
from stapeskit.faults import StapeskitError
from stapeskit.provenance import frames_hash, input_record
from stapeskit.records.motion_file import read_motion, write_motion
from stapeskit.warnings import Notice
from tests.motion_command.ears import error_in_sd, mass_of, measured, options, rewrite, simulated, write_mass


@pytest.fixture(scope="module")
def ear(tmp_path_factory):
    """One ear on disk: measurement, companions and scan_mass/mass.json."""
    folder = tmp_path_factory.mktemp("ear")
    truth = simulated(folder, lines=16, seed=11)
    write_mass(folder / "scan_mass", mass_of(truth))
    return folder, truth


def test_what_lies_beside_the_measurement_is_taken_and_named(ear, tmp_path, monkeypatch):
    folder, truth = ear
    monkeypatch.chdir(tmp_path)
    outcome = work([str(folder / "ldv.csv"), "--out", "ear1"])
    rows = dict(outcome.rows)
    for role, name in (
        ("points", "points.csv"),
        ("fiducials", "fiducials.csv"),
        ("mass", "scan_mass/mass.json"),
    ):
        assert rows[f"{role} (found beside LDV)"] == str(folder / name)
    assert sorted(path.name for path in outcome.files) == sorted(f"ear1{ending}" for ending in ENDINGS)
    assert all((tmp_path / f"ear1{ending}").is_file() for ending in ENDINGS)
    motion = read_motion(tmp_path / "ear1.csv")
    assert motion.provenance["parameters"]["found_beside"] == ["fiducials", "mass", "points"]
    assert set(motion.provenance["inputs"]) == {"ldv", "points", "fiducials", "mass"}
    assert (
        motion.provenance["inputs"]["mass"]["document_hash"]
        == input_record(folder / "scan_mass" / "mass.json")["document_hash"]
    )
    page = (tmp_path / "ear1.html").read_text(encoding="utf-8")
    assert str(folder / "points.csv") in page
    result = points2dof(folder / "ldv.csv")
    assert set(result.taken) == {"points", "fiducials", "mass"}
    assert np.array_equal(result.motion.q, motion.q)
    assert np.max(np.abs(error_in_sd(result, truth))) < 6.0


def test_none_turns_a_companion_off(ear):
    folder, _ = ear
    chosen = MotionOptions.of(ldv=folder / "ldv.csv", fiducials="none")
    found = with_companions(chosen, "none")
    assert set(found.taken) == {"points"}
    assert found.mass is None
    assert found.options.source_frame == "footplate"
    chosen = MotionOptions.of(ldv=folder / "ldv.csv", frame="plate", points="none")
    assert set(with_companions(chosen).taken) == {"mass"}
    with pytest.raises(StapeskitError) as caught:
        points2dof(folder / "ldv.csv", points="none")
    assert {fault.next_step for fault in caught.value.faults} == {"Give them with --points points.csv"}


def test_fiducials_on_the_plate_without_a_mass_say_how_to_go_on(tmp_path):
    simulated(tmp_path, lines=12)
    with pytest.raises(StapeskitError) as caught:
        points2dof(tmp_path / "ldv.csv")
    fault = caught.value.faults[0]
    assert fault.got == "no mass.json"
    assert "--fiducials none" in fault.next_step


def test_two_masses_beside_a_measurement_are_refused(tmp_path):
    simulated(tmp_path, lines=12)
    for name in ("a_mass", "b_mass"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "mass.json").write_text("{}")
    with pytest.raises(StapeskitError) as caught:
        with_companions(MotionOptions.of(ldv=tmp_path / "ldv.csv"))
    assert caught.value.faults[0].got == "a_mass/mass.json, b_mass/mass.json"


def test_json_holds_verdicts_registration_and_warnings(ear, tmp_path):
    folder, _ = ear
    outcome = work([str(folder / "ldv.csv"), "--out", str(tmp_path / "dof.csv"), "--json"])
    content = json.loads(json.dumps(outcome.content, allow_nan=False))
    assert content["schema"] == "stapeskit.points2dof/1"
    assert content["verdicts"] == []
    assert len(content["registration"]["residuals_mm"]) == 6
    assert content["surface_checks"][0]["body"] == "stapes"
    assert {row["unit"] for row in content["lasers"]} == {"%", "°", "µs"}
    assert len(content["found_beside"]) == 3


def test_result_prints_a_screen_and_makes_table_figure_and_files(ear, tmp_path):
    folder, _ = ear
    result = points2dof(folder / "ldv.csv")
    assert len(repr(result).splitlines()) < 30
    frame = result.to_frame()
    assert list(frame.columns[:5]) == ["run", "body", "freq_hz", "x_re_m", "x_im_m"]
    assert len(frame) == 2 * 16
    figure = result.plot()
    assert len(figure.axes) == 12
    assert hasattr(figure, "_repr_png_")  # a notebook shows it
    assert [path.name for path in result.write(tmp_path, name="ear.csv")] == [f"ear{end}" for end in ENDINGS]


def test_the_verdict_of_the_page_is_that_of_the_worst_warning():
    assert motion_verdict(())[0] == "believe"
    assert motion_verdict([Notice("noise_estimated", "")])[0] == "believe"
    assert motion_verdict([Notice("noise_estimated", ""), Notice("channel_gain", "")])[0] == "check"
    assert motion_verdict([Notice("channel_gain", ""), Notice("phase_convention", "")])[0] == "do not use"


def test_a_mass_in_memory_leaves_the_hash_of_its_frames(ear):
    folder, truth = ear
    mass = mass_of(truth)
    result = points2dof(folder / "ldv.csv", mass)
    assert "mass" not in result.taken
    assert result.motion.provenance["frames_hash"] == frames_hash(mass.raw)


def test_the_frames_of_the_fiducials_are_recorded(ear, tmp_path):
    """Warnings of plate and handedness count in the fit only where a frame of the plate took part."""
    folder, truth = ear
    motion = points2dof(folder / "ldv.csv", mass_of(truth)).motion
    frames = [read_fiducials(folder / "fiducials.csv").frame]
    write_motion(tmp_path, "dof", motion)
    assert read_motion(tmp_path / "dof.h5").provenance["registered_in"] == frames
    assert unused_codes(motion.provenance) == ()
    assert "handedness_unconfirmed" in unused_codes({"registered_in": ["scan"]})


def test_check_of_inputs_reports_all_faults_together(tmp_path):
    simulated(tmp_path, lines=12)
    check_inputs(options(tmp_path))
    points = tmp_path / "points.csv"
    points.write_text(points.read_text(encoding="utf-8").replace("x_mm", "x_m"))

    def mirrored(table):
        table["x_mm"] *= -1.0

    rewrite(tmp_path / "fiducials.csv", mirrored)
    with pytest.raises(StapeskitError) as caught:
        check_inputs(options(tmp_path))
    assert len(caught.value.faults) == 2
    assert any("--mirror" in fault.next_step for fault in caught.value.faults)


def test_mirror_turns_left_handed_coordinates_round(tmp_path):
    truth = simulated(tmp_path, lines=16, mirror="z", seed=12)
    mass = mass_of(truth)
    with pytest.raises(StapeskitError):
        measured(tmp_path, mass)
    result = measured(tmp_path, mass, mirror="z")
    assert np.max(np.abs(error_in_sd(result, truth))) < 6.0


def test_channels_are_left_out_and_listed(ear):
    folder, _ = ear
    result = measured(folder, mass_of(ear[1]), leave_out=["stapes:3"])
    unused = [one for one in result.channels if one.verdict == "unused"]
    assert {(one.body, one.point, one.estimate) for one in unused} == {("stapes", "3", "left out")}
    for rule in ("bone:1", "stapes:99", "stapes:3:x"):
        with pytest.raises(StapeskitError) as caught:
            measured(folder, mass_of(ear[1]), leave_out=[rule])
        assert caught.value.faults[0].thing == f"--leave-out {rule}"


def test_a_gain_is_found_and_corrected(tmp_path):
    truth = simulated(tmp_path, in_footplate=True, lines=24, seed=13)

    def louder(table):
        own = (table.body == "stapes") & (table.point == 4) & (table.dir_x == table.dir_x[0])
        table.loc[own, ["re_m_s", "im_m_s"]] *= 1.4

    rewrite(tmp_path / "ldv.csv", louder)
    found = measured(tmp_path)
    assert [(one.point, one.verdict) for one in found.channels if one.verdict != "ok"] == [("4", "gain")]
    assert {notice.code for notice in found.notices} == {"channel_gain"}
    corrected = measured(tmp_path, correct=True)
    assert np.max(np.abs(error_in_sd(corrected, truth))) < 6.0 < np.max(np.abs(error_in_sd(found, truth)))
    assert "corrected" in {notice.code for notice in corrected.notices}


def test_a_point_that_moves_with_the_other_body_is_named(tmp_path):
    simulated(tmp_path, in_footplate=True, lines=24, stapes_points=8, bone_points=6, seed=2)
    table = pd.read_csv(tmp_path / "points.csv")
    point = table[table.body == "base"].point.iloc[2]

    def renamed(table):
        table["point"] = table.point.astype(str)
        table.loc[(table.body == "base") & (table.point == str(point)), ["body", "point"]] = "stapes", "wrong"

    for name in ("points.csv", "ldv.csv"):
        rewrite(
            tmp_path / name,
            lambda table: (table.__setitem__("point", table.point.astype(str)), renamed(table)),
        )
    result = measured(tmp_path, fiducials="none")
    told = [notice.text for notice in result.notices if notice.code == "channel_label_swap"]
    assert len(told) == 1
    assert "wrong of body stapes" in told[0]
    assert {one.point for one in result.channels if one.verdict != "ok"} == {"wrong"}


def test_the_motion_is_written_for_matlab_and_octave(ear, tmp_path, monkeypatch):
    folder, _ = ear
    monkeypatch.chdir(tmp_path)
    outcome = work([str(folder / "ldv.csv"), "--out", "ear1.csv", "--export", "mat"])
    assert {path.name for path in outcome.files} == {f"ear1{ending}" for ending in (*ENDINGS, ".mat")}
    motion, content = read_motion(tmp_path / "ear1.h5"), loadmat(tmp_path / "ear1.mat")
    for name in ("q", "covariance", "chi2", "n_dof"):
        np.testing.assert_array_equal(content[name], getattr(motion, name))
    np.testing.assert_array_equal(content["q_sd"], motion.standard_deviation)
    np.testing.assert_array_equal(content["freq_hz"].ravel(), motion.freq_hz)
    np.testing.assert_array_equal(content["shared_covariance"], motion.shared.covariance)
    named = {name: [str(cell.item()) for cell in content[name].ravel()] for name in ("dof", "bodies", "runs")}
    assert named == {name: list(getattr(motion, name)) for name in named}
    with pytest.raises(StapeskitError) as error:
        work([str(folder / "ldv.csv"), "--export", "xlsx"])
    assert error.value.faults[0].thing == "--export"


def test_amplitudes_of_the_other_sign_of_time_are_told_before_k_and_d_are_believed(ear, tmp_path):
    """The same file as stated says nothing; conjugated, the motion and the fit are not to be used."""
    folder, truth = ear
    for name in ("ldv.csv", "points.csv", "fiducials.csv"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    rewrite(tmp_path / "ldv.csv", lambda table: table.update(-table["im_m_s"]))
    for place, expected in ((folder, False), (tmp_path, True)):
        moved = measured(place, mass_of(truth))
        assert ("phase_convention" in {notice.code for notice in moved.notices}) is expected
        fit = dof2kd(moved, mass=mass_of(truth), unknowns="none")
        codes = {notice.code for notice in fit.notices}
        assert ("phase_convention" in codes) is expected
        assert (fit.verdict.level == "do not use") is expected


@pytest.mark.parametrize("sd_mm", [1e-4, 0.02, 1.0])
def test_stated_positions_and_readings_without_noise_end_in_a_result(tmp_path, sd_mm):
    truth = simulated(tmp_path, lines=20, in_footplate=True, exact=True, seed=31)
    rewrite(tmp_path / "points.csv", lambda table: table.__setitem__("sd_mm", sd_mm))
    result = measured(tmp_path)
    found = result.motion.q[0, result.motion.body("stapes"), :, 1]
    assert np.allclose(found, truth.motion_m["stapes"][0, :, 1], rtol=1e-9)
    assert {one.verdict for one in result.channels} == {"ok"}


@pytest.mark.parametrize("lines", [1, 3, 40])
def test_an_exact_motion_along_one_direction_ends_in_a_result(tmp_path, lines):
    """When everything moves in one direction, the readings do not determine the gain of a laser."""
    truth = simulated(tmp_path, lines=lines, in_footplate=True, exact=True, others=0.0, seed=303)
    result = measured(tmp_path)
    found = result.motion.q[0, result.motion.body("base"), :, 1]
    assert np.allclose(found, truth.motion_m["base"][0, :, 1], rtol=1e-9)
    assert {one.verdict for one in result.channels} == {"ok"}
