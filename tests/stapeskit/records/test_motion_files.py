"""dof.csv and dof.h5: written and read back, joined by content, every fault named."""

from __future__ import annotations

from dataclasses import dataclass, replace

import h5py
import numpy as np
import pytest

from legacy.kinematics.fit.frf_ratio import per_reference
from legacy.kinematics.fit_options import Options
from legacy.kinematics.points2dof import points2dof
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.records import motion as motion_record
from legacy.stapeskit.records import motion_columns, motion_files
from legacy.stapeskit.records.motion import ROW_COLUMNS, STORED, RigidMotion, RowColumn, SharedErrors
from legacy.stapeskit.records.motion_columns import MotionColumns
from legacy.stapeskit.records.motion_files import read_motion, standard_deviation, write_motion
from legacy.stapeskit.warnings import Notice
from tests.kinematics.simulated import body, measurement, scene

DOF = ("y", "alpha", "gamma")


@pytest.fixture
def motion():
    rng = np.random.default_rng(0)
    shape = (2, 2, 5, 3)
    q = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    q[1, 1, 2] = np.nan
    root = rng.normal(size=(*shape, 3)) + 1j * rng.normal(size=(*shape, 3))
    covariance = root @ root.conj().swapaxes(-1, -2)
    shared = SharedErrors(
        ("registration.x", "footplate_frame.y"), np.diag([1e-8, 2e-8]), np.stack([q, 2 * q])
    )
    chi2 = np.where(np.isnan(q[..., 0]), np.nan, 4.5)
    return RigidMotion(
        ("1", "side"),
        ("stapes", "base"),
        DOF,
        np.array([100.0, 150.5, 1e3 / 3, 400.0, 5e3]),
        q,
        covariance,
        chi2,
        np.full(q.shape[:3], 8),
        shared=shared,
        notices=(Notice("a", "b"),),
        provenance={"command": "points2dof x"},
    )


def assert_same(one, two):
    assert (one.runs, one.bodies, one.dof) == (two.runs, two.bodies, two.dof)
    assert np.array_equal(one.freq_hz, two.freq_hz)
    assert np.array_equal(one.q, two.q, equal_nan=True)


def test_both_files_read_back(tmp_path, motion):
    csv, h5 = write_motion(tmp_path, "dof", motion)
    for path in (csv, h5):
        read = read_motion(path)
        assert_same(read, motion)
        assert np.array_equal(read.covariance, motion.covariance)
        assert np.array_equal(read.chi2, motion.chi2, equal_nan=True)
        assert read.shared.names == motion.shared.names
        assert np.array_equal(read.shared.derivatives, motion.shared.derivatives, equal_nan=True)
        assert read.notices == motion.notices
        assert dict(read.provenance) == {"command": "points2dof x"}


def test_columns_are_those_promised(tmp_path, motion):
    csv, _ = write_motion(tmp_path, "dof", motion)
    header = csv.read_text(encoding="utf-8").splitlines()[0].split(",")
    promised = [
        "run",
        "body",
        "freq_hz",
        "y_re_m",
        "y_im_m",
        "alpha_re_rad",
        "alpha_im_rad",
        "gamma_re_rad",
        "gamma_im_rad",
        "y_sd_m",
        "alpha_sd_rad",
        "gamma_sd_rad",
        "chi2",
        "n_dof",
    ]
    assert header[: len(promised)] == promised
    assert header == MotionColumns(DOF, False).all
    assert len(csv.read_text(encoding="utf-8").splitlines()) == 1 + 19


@pytest.mark.parametrize("column", ROW_COLUMNS, ids=lambda column: column.name)
def test_every_column_of_the_table_is_written_and_read_back(tmp_path, motion, column):
    if column.stored and getattr(motion, column.name) is None:
        motion = replace(motion, **{column.name: np.full(motion.q.shape[:3], 7 if column.whole else 0.7)})
    assert not np.any(column.is_wrong(np.array([column.least, min(column.most, 1e300)])))
    csv, h5 = write_motion(tmp_path, "dof", motion)
    values = column.of(motion)
    assert values.shape == motion.q.shape[:3]
    assert column.name in csv.read_text(encoding="utf-8").splitlines()[0].split(",")
    assert not np.any(column.is_wrong(values[np.isfinite(values)].astype(float)))
    h5.unlink()
    if column.stored:
        measured = np.isfinite(motion.q[..., 0])
        assert np.allclose(getattr(read_motion(csv), column.name)[measured], values[measured], rtol=1e-8)


@dataclass(frozen=True)
class LaterMotion(RigidMotion):
    """A motion of a version that stores one column more."""

    n_read: np.ndarray | None = None


def test_a_column_that_older_files_lack_reads_as_none(tmp_path, motion, monkeypatch):
    column = RowColumn("n_read", "readings", whole=True, missing=0.0, optional=True)
    for module in (motion_record, motion_columns, motion_files):
        monkeypatch.setattr(module, "ROW_COLUMNS", (*ROW_COLUMNS, column), raising=False)
        monkeypatch.setattr(module, "STORED", (*STORED, column), raising=False)
    monkeypatch.setattr(motion_files, "RigidMotion", LaterMotion)
    count = np.where(np.isnan(motion.q[..., 0]), 0, 7)
    for written, wanted in ((None, None), (count, count)):
        csv, h5 = write_motion(tmp_path, "dof", LaterMotion(**vars(motion), n_read=written))
        assert np.array_equal(read_motion(h5).n_read, wanted)
    h5.unlink()
    assert np.array_equal(read_motion(csv).n_read, count)
    with pytest.raises(StapeskitError):
        LaterMotion(**vars(motion), n_read=count[0])


def test_a_csv_alone_has_uncorrelated_noise(tmp_path, motion):
    csv, h5 = write_motion(tmp_path, "dof", motion)
    h5.unlink()
    read = read_motion(csv)
    assert_same(read, motion)
    there = np.isfinite(motion.q)
    assert np.allclose(standard_deviation(read)[there], standard_deviation(motion)[there])
    assert read.covariance[0, 0, 0, 0, 1] == 0.0
    assert read.shared is None
    assert [notice.code for notice in read.notices] == ["motion_without_h5"]


def test_a_changed_csv_is_not_completed_from_the_old_h5(tmp_path, motion):
    csv, _ = write_motion(tmp_path, "dof", motion)
    lines = csv.read_text(encoding="utf-8").splitlines()
    csv.write_text("\n".join(lines[:-1]) + "\n")
    read = read_motion(csv)
    assert read.shared is None
    assert np.isnan(read.q[1, 1, 4]).all()


def test_a_renamed_pair_still_belongs_together(tmp_path, motion):
    csv, h5 = write_motion(tmp_path, "dof", motion)
    csv.rename(tmp_path / "other.csv")
    h5.rename(tmp_path / "other.h5")
    assert read_motion(tmp_path / "other.csv").shared is not None


def test_responses_read_back(tmp_path):
    one, two = scene(1, lines=4), scene(2, lines=4)
    data = measurement(body("stapes", one), body("base", two), freq_hz=one.freq_hz)
    motion = per_reference(points2dof(data, options=Options(DOF)).motion, "base:y")
    csv, h5 = write_motion(tmp_path, "dof", motion)
    header = csv.read_text(encoding="utf-8").splitlines()[0]
    assert "y_re_m_per_ref,y_im_m_per_ref,alpha_re_rad_per_ref" in header
    assert "gamma_sd_rad_per_ref,chi2" in header
    assert np.array_equal(read_motion(csv).covariance, motion.covariance)
    h5.unlink()
    alone = read_motion(csv)
    assert alone.reference == "base:y"
    assert np.allclose(standard_deviation(alone), standard_deviation(motion), atol=1e-15)


def test_a_table_of_another_tool_is_read(tmp_path):
    path = tmp_path / "own.csv"
    path.write_text("body;freq_hz;y_re_m;y_im_m;y_sd_m\nbase;100,5;1e-9;0;1e-11\nstapes;100,5;2e-9;0;1e-11\n")
    read = read_motion(path)
    assert read.runs == ("1",)
    assert read.bodies == ("base", "stapes")
    assert read.q[0, 1, 0, 0] == 2e-9


GOOD = "run,body,freq_hz,y_re_m,y_im_m,y_sd_m,chi2,n_dof"


@pytest.mark.parametrize(
    ("head", "row", "match"),
    [
        (GOOD, "1,s,0,1,1,1,1,1", r"freq_hz must be positive and finite; got 0 \(dof.csv, line 3\)"),
        (GOOD, "1,s,2,x,1,1,1,1", r'y_re_m must be a number; got "x" \(dof.csv, line 3\)'),
        (GOOD, "1,s,2,1,1,-1,1,1", "a standard deviation must be positive and finite"),
        (GOOD, "1,s,2,inf,1,1,1,1", r"_re_m must be finite, or empty; got inf \(dof.csv, line 3\)"),
        (
            GOOD,
            "1,s,1e-200,1,1,1,1,1",
            r"freq_hz must be from 1e-12 to 1e.12 Hz; got 1e-200 \(dof.csv, line 3",
        ),
        (GOOD, "1,s,2,1e200,1,1,1,1", r"y_re_m must be below 1e.100, or empty; got 1e.200 \(dof.csv, line 3"),
        (GOOD, "1,s,2,1,1,1,-1,1", r"chi2 must be from 0 to 1e.15; got -1 \(dof.csv, line 3"),
        (GOOD, "1,s,2,1,1,1,1,1.5", r"n_dof must be a count; got 1.5 \(dof.csv, line 3"),
        (GOOD, "1,s,2,1,1,1,1,1e300", r"n_dof must be a count; got 1e.300 \(dof.csv, line 3"),
        (GOOD, "1,,2,1,1,1,1,1", "body must be a name"),
        (GOOD, "1,s,1,1,1,1,1,1", "the only one of its run, body and frequency"),
        (GOOD.replace("y_sd_m,", ""), "1,s,2,1,1,1,1", "no column y_sd_m"),
        ("run,body,freq_hz", "1,s,2", "no column x_re_m or another degree of freedom"),
        (GOOD.replace("_m", "_m_per_ref"), "1,s,2,5,1,1,1,1", "1 in the column of its reference"),
    ],
)
def test_faulty_tables_are_named(tmp_path, head, row, match):
    path = tmp_path / "dof.csv"
    path.write_text(f"{head}\n" + ",".join(["1", "s", *["1"] * (head.count(",") - 1)]) + f"\n{row}\n")
    with pytest.raises(StapeskitError, match=match):
        read_motion(path)


def test_other_files_are_refused(tmp_path):
    with pytest.raises(StapeskitError, match="Run points2dof first"):
        read_motion(tmp_path / "dof.csv")
    (tmp_path / "a.xlsx").write_text("x")
    with pytest.raises(StapeskitError, match=r"a \.csv or \.h5 file"):
        read_motion(tmp_path / "a.xlsx")
    (tmp_path / "a.h5").write_text("x")
    with pytest.raises(StapeskitError, match="a whole HDF5 file"):
        read_motion(tmp_path / "a.h5")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file.attrs["schema"] = "other"
    with pytest.raises(StapeskitError, match=r'schema must be "stapeskit\.dof/1"; got other'):
        read_motion(tmp_path / "b.h5")


def test_motion_checks_itself(motion):
    def changed(**parts):
        values = {name: getattr(motion, name) for name in motion.__dataclass_fields__} | parts
        return RigidMotion(**values)

    with pytest.raises(StapeskitError, match="the shape of chi2 must be"):
        changed(chi2=np.zeros(3))
    with pytest.raises(StapeskitError, match="dof must be in the order"):
        changed(dof=("gamma", "alpha", "y"))
    with pytest.raises(StapeskitError, match="positive and ascending"):
        changed(freq_hz=motion.freq_hz[::-1])
    with pytest.raises(StapeskitError, match="the body must be one of stapes, base; got bone"):
        motion.body("bone")
    with pytest.raises(StapeskitError, match="shared errors must be 2 parameters throughout"):
        SharedErrors(("a", "b"), np.eye(3), np.zeros((2, 1, 1, 1, 1), dtype=complex))
    q, covariance = motion.pair(0, 0, 1)
    assert q.shape == (5, 6)
    assert np.array_equal(covariance[:, 3:, 3:], motion.covariance[0, 1])
    assert not covariance[:, :3, 3:].any()


@pytest.mark.parametrize("name", ["q", "covariance", "freq_hz", "chi2"])
def test_a_damaged_number_in_the_hdf5_file_is_told(tmp_path, motion, name):
    _, path = write_motion(tmp_path, "dof", motion)
    value = np.ascontiguousarray(getattr(motion, name)).tobytes()[:64]
    whole = path.read_bytes()
    place = whole.index(value) + 5
    path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
    with pytest.raises(StapeskitError, match="the motion file must be a whole HDF5 file of points2dof"):
        read_motion(path)


def test_names_that_begin_a_formula_are_text_and_read_back(tmp_path, motion):
    names = ("=1+cmd|' /C calc'!A0", '@SUM(A1),"x"')
    path, h5 = write_motion(tmp_path, "dof", replace(motion, bodies=names, runs=("-x", "+1")))
    cells = [line.split(",")[0] for line in path.read_text(encoding="utf-8").splitlines()[1:]]
    assert set(cells) == {"'-x", "+1"}
    h5.unlink()
    read = read_motion(path)
    assert (set(read.bodies), set(read.runs)) == (set(names), {"-x", "+1"})
