"""dof.csv and dof.h5: written and read back, joined by content, every fault with its line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from stapeskit.faults import StapeskitError
from stapeskit.records.motion_file import RigidMotion, SharedErrors, motion_columns, read_motion, write_motion
from stapeskit.warnings import Notice

DOF = ("y", "alpha", "gamma")


@pytest.fixture
def motion() -> RigidMotion:
    rng = np.random.default_rng(0)
    shape = (2, 2, 5, 3)
    q = 1e-8 * (rng.normal(size=shape) + 1j * rng.normal(size=shape))
    q[1, 1, 2] = np.nan
    root = 1e-10 * (rng.normal(size=(*shape, 3)) + 1j * rng.normal(size=(*shape, 3)))
    maps = rng.normal(size=(2, 2, 6, 6)) + 0j
    maps[1] = np.nan
    shared = SharedErrors(
        ("registration.x", "footplate_frame.y"),
        np.diag([1e-8, 2e-8]),
        np.stack([q, 2 * q]),
        maps,
        np.array([1, 0]),
    )
    return RigidMotion(
        ("1", "side"),
        ("stapes", "base"),
        DOF,
        np.array([100.0, 150.5, 1e3 / 3, 400.0, 5e3]),
        q,
        root @ root.conj().swapaxes(-1, -2),
        np.where(np.isnan(q[..., 0]), np.nan, 4.5),
        np.full(q.shape[:3], 8),
        shared=shared,
        notices=(Notice("a", "b"),),
        provenance={"command": "points2dof x"},
    )


def per_reference(motion: RigidMotion) -> RigidMotion:
    """Divide by the motion of the base along y, with a joint covariance."""
    q = np.nan_to_num(motion.q, nan=1e-8)
    q = q / q[:, 1:, :, :1]
    joint = np.zeros((2, 5, 6, 6), dtype=complex)
    joint[..., :3, :3], joint[..., 3:, 3:] = motion.covariance[:, 0], motion.covariance[:, 1]
    joint[..., 3, :] = joint[..., :, 3] = 0.0
    return replace(motion, q=q, covariance=joint, reference="base:y", shared=None)


def assert_same_rows(one: RigidMotion, two: RigidMotion) -> None:
    assert (one.runs, one.bodies, one.dof) == (two.runs, two.bodies, two.dof)
    assert np.array_equal(one.freq_hz, two.freq_hz)
    assert np.array_equal(one.q, two.q, equal_nan=True)


def the_faults(path: Path) -> list[tuple[str, str, str]]:
    """Return thing, value and place of every fault of a file."""
    with pytest.raises(StapeskitError) as caught:
        read_motion(path)
    return [(fault.thing, fault.got, str(fault.where)) for fault in caught.value.faults]


def test_both_files_read_back_whole(tmp_path, motion):
    for path in write_motion(tmp_path, "dof", motion):
        read = read_motion(path)
        assert_same_rows(read, motion)
        for name in ("covariance", "chi2", "n_dof"):
            assert np.array_equal(getattr(read, name), getattr(motion, name), equal_nan=True)
        for name in ("names", "covariance", "derivatives", "maps", "powers"):
            stored, written = (np.asarray(getattr(m.shared, name)) for m in (read, motion))
            assert np.array_equal(stored, written, equal_nan=name != "names")
        assert (read.notices, dict(read.provenance)) == (motion.notices, dict(motion.provenance))
        assert (read.about, read.axes, read.reference) == ("footplate_centre", "footplate", "")


def test_the_header_is_the_promised_one(tmp_path, motion):
    csv, _ = write_motion(tmp_path, "dof", motion)
    lines = csv.read_text(encoding="utf-8").splitlines()
    q = "y_re_m,y_im_m,alpha_re_rad,alpha_im_rad,gamma_re_rad,gamma_im_rad"
    assert lines[0] == f"run,body,freq_hz,{q},y_sd_m,alpha_sd_rad,gamma_sd_rad,chi2,n_dof"
    assert len(lines) == 1 + 19


def test_a_csv_alone_has_uncorrelated_noise(tmp_path, motion):
    csv, h5 = write_motion(tmp_path, "dof", motion)
    h5.unlink()
    read, there = read_motion(csv), np.isfinite(motion.q)
    assert_same_rows(read, motion)
    assert np.allclose(read.standard_deviation[there], motion.standard_deviation[there], rtol=1e-8, atol=0)
    assert np.allclose(read.chi2[there[..., 0]], motion.chi2[there[..., 0]])
    assert read.covariance[0, 0, 0, 0, 1] == 0.0
    assert read.shared is None
    assert [notice.code for notice in read.notices] == ["motion_without_h5"]


def test_files_belong_together_by_content_not_by_name(tmp_path, motion):
    csv, h5 = write_motion(tmp_path, "dof", motion)
    csv, _ = csv.rename(tmp_path / "other.csv"), h5.rename(tmp_path / "other.h5")
    assert read_motion(csv).shared is not None
    csv.write_text("\n".join(csv.read_text().splitlines()[:-1]) + "\n")
    read = read_motion(csv)
    assert read.shared is None
    assert np.isnan(read.q[1, 1, 4]).all()


def test_responses_per_reference_read_back(tmp_path, motion):
    responses = per_reference(motion)
    csv, h5 = write_motion(tmp_path, "dof", responses)
    header = csv.read_text(encoding="utf-8").splitlines()[0].split(",")
    assert set(motion_columns(DOF, True)["re"]) < set(header)
    assert np.array_equal(read_motion(csv).covariance, responses.covariance)
    h5.unlink()
    assert the_faults(csv)[0][0] == "motion per reference"


def test_a_table_of_another_tool_is_read(tmp_path):
    path = tmp_path / "own.csv"
    path.write_text("body;freq_hz;y_re_m;y_im_m;y_sd_m\nbase;100,5;1e-9;0;1e-11\nstapes;100,5;2e-9;0;1e-11\n")
    read = read_motion(path)
    assert (read.runs, read.bodies, read.freq_hz.tolist()) == (("1",), ("base", "stapes"), [100.5])
    assert read.q[0, 1, 0, 0] == 2e-9
    assert read.n_dof.tolist() == [[[0], [0]]]


GOOD = "run,body,freq_hz,y_re_m,y_im_m,y_sd_m,chi2,n_dof"


@pytest.mark.parametrize(("row", "thing", "got"), [
    ("1,s,0,1,1,1,1,1", "freq_hz", "0"),
    ("1,s,inf,1,1,1,1,1", "freq_hz", "inf"),
    ("1,s,,1,1,1,1,1", "freq_hz", "nan"),
    ("1,s,1e-200,1,1,1,1,1", "freq_hz", "1e-200"),
    ("1,s,two,1,1,1,1,1", "freq_hz", '"two"'),
    ("1,s,2,x,1,1,1,1", "y_re_m", '"x"'),
    ("1,s,2,inf,1,1,1,1", "y_re_m", "inf"),
    ("1,s,2,1e200,1,1,1,1", "y_re_m", "1e+200"),
    ("1,s,2,1,1,-1,1,1", "y_sd_m", "-1"),
    ("1,s,2,1,1,1,-1,1", "chi2", "-1"),
    ("1,s,2,1,1,1,1,1.5", "n_dof", "1.5"),
    ("1,s,2,1,1,1,1,1e300", "n_dof", "1e+300"),
    ("1,,2,1,1,1,1,1", "body", "an empty cell"),
    ("1,s,1,1,1,1,1,1", "a row", "another"),
    ("1,s,2,1,1,1,1", "a row", "7"),
])  # fmt: skip
def test_every_faulty_cell_is_reported_with_its_line(tmp_path, row, thing, got):
    path = tmp_path / "dof.csv"
    path.write_text(f"{GOOD}\n1,s,1,1,1,1,1,1\n{row}\n")
    assert the_faults(path) == [(thing, got, "dof.csv, line 3")]


def test_all_faulty_cells_come_at_once(tmp_path):
    path = tmp_path / "dof.csv"
    path.write_text(f"{GOOD}\n1,s,0,1,1,1,1,1\n1,s,2,x,1,1,-1,1\n")
    assert {thing for thing, *_ in the_faults(path)} == {"freq_hz", "y_re_m", "chi2"}


@pytest.mark.parametrize(("head", "row", "got"), [
    (GOOD.replace("y_sd_m,", ""), "1,s,2,1,1,1,1", "no column y_sd_m"),
    ("run,body,freq_hz", "1,s,2", "no column x_re_m or another degree of freedom"),
])  # fmt: skip
def test_incomplete_headers_are_refused(tmp_path, head, row, got):
    path = tmp_path / "dof.csv"
    path.write_text(f"# a comment\n{head}\n{row}\n")
    ((_, value, _),) = the_faults(path)
    assert value == got


def test_other_files_are_refused(tmp_path):
    (tmp_path / "a.xlsx").write_text("x")
    (tmp_path / "a.h5").write_text("x")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file.attrs["schema"] = "other"
    assert the_faults(tmp_path / "none.csv")[0][0] == "the motion file"
    assert the_faults(tmp_path / "a.xlsx") == [("a motion file", "a.xlsx", "")]
    assert the_faults(tmp_path / "a.h5")[0][::2] == ("the motion file", "a.h5")
    assert the_faults(tmp_path / "b.h5") == [("schema", "other", "b.h5")]


@pytest.mark.parametrize("name", ["q", "covariance", "freq_hz", "chi2"])
def test_a_damaged_number_in_the_hdf5_file_is_refused(tmp_path, motion, name):
    _, path = write_motion(tmp_path, "dof", motion)
    whole = path.read_bytes()
    place = whole.index(np.ascontiguousarray(getattr(motion, name)).tobytes()[:64]) + 5
    path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
    assert the_faults(path)[0][0] == "the motion file"


def test_cut_hdf5_files_are_refused(tmp_path, motion):
    _, path = write_motion(tmp_path, "dof", motion)
    whole = path.read_bytes()
    for share in (0.1, 0.5, 0.9):
        path.write_bytes(whole[: int(share * len(whole))])
        assert the_faults(path)[0][2] == "dof.h5"


@pytest.mark.parametrize(("change", "thing"), [
    ({"chi2": np.zeros(3)}, "the shape of chi2"),
    ({"n_dof": np.zeros((2, 2, 4))}, "the shape of n_dof"),
    ({"covariance": np.zeros((2, 5, 6, 6), complex)}, "the shape of covariance"),
    ({"dof": ("gamma", "alpha", "y")}, "dof"),
    ({"freq_hz": np.array([1.0, 3.0, 2.0, 4.0, 5.0])}, "freq_hz"),
])  # fmt: skip
def test_motion_checks_itself(motion, change, thing):
    with pytest.raises(StapeskitError) as caught:
        replace(motion, **change)
    assert [fault.thing for fault in caught.value.faults] == [thing]


def test_pairs_of_bodies_have_noise_in_common_with_a_reference_alone(motion):
    q, covariance = motion.pair(0, 0, 1)
    assert np.array_equal(q[:, 3:], motion.q[0, 1])
    assert np.array_equal(covariance[:, 3:, 3:], motion.covariance[0, 1])
    assert not covariance[:, :3, 3:].any()
    responses = per_reference(motion)
    assert np.array_equal(responses.pair(1, 1, 0)[1][:, :3, :3], responses.covariance[1][:, 3:, 3:])
