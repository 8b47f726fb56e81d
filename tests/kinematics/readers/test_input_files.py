"""One measurement written in several files and formats, read by the library and by the command."""

from __future__ import annotations

import csv
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from legacy.kinematics.cli import parser, work
from legacy.kinematics.measure_motion import motion_inputs, read_inputs
from legacy.kinematics.options import LdvOptions
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.readers.input_options import InputOptions
from legacy.kinematics.readers.measurement_files import read_measurement
from legacy.kinematics.tidy.ldv_csv import read_ldv
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.option_kinds import BEAM
from legacy.stapeskit.records.motion_files import write_motion
from tests.kinematics import written_uff as uff
from tests.kinematics.readers.test_inputs import PLACES, F, codes, value
from tests.kinematics.rewritten import write_three_ways
from tests.kinematics.written_psv import fastscan

pytestmark = pytest.mark.usefixtures("undrawn")

SAMPLE = Path(__file__).resolve().parents[3] / "sample_volumes"


def points_file(path):
    rows = [
        f"{'stapes' if n < 6 else 'base'},{n + 1},{','.join(map(repr, PLACES[n].tolist()))},0.02"
        for n in range(12)
    ]
    path.write_text("body,point,x_mm,y_mm,z_mm,sd_mm\n" + "\n".join(rows) + "\n")


def noisy(number, axis):
    rng = np.random.default_rng([number, axis])
    clean = value(number, axis) * (1.0 if number < 6 else 0.7)
    noise = rng.normal(size=(40, 2)) @ [1.0, 1.0j]
    return clean + 0.01 * np.mean(np.abs(clean)) * noise


def tidy(path, numbers=range(12)):
    rows = ["body,point,dir,freq_hz,re_m_s,im_m_s"]
    for n in numbers:
        for axis in range(3):
            for f, v in zip(F, noisy(n, axis), strict=True):
                name = "stapes" if n < 6 else "base"
                rows.append(f"{name},{n + 1},{'xyz'[axis]},{float(f)!r},{float(v.real)!r},{float(v.imag)!r}")
    path.write_text("\n".join(rows) + "\n")


def universal(path, numbers=range(12), binary="<", coordinates=True, **how):
    parts = [uff.units()]
    if coordinates:
        parts.append(uff.nodes_2411({n + 1: PLACES[n] * 1e-3 for n in numbers}))
    parts += [
        uff.function(F, noisy(n, axis), n + 1, axis + 1, form=6, binary=binary, kind=uff.SPECTRUM, **how)
        for n in numbers
        for axis in range(3)
    ]
    path.write_bytes(b"".join(parts))


def scanned(folder):
    folder.mkdir()
    for k, f in enumerate(F):
        values = np.array([[noisy(n, axis)[k] for axis in range(3)] for n in range(12)])
        (folder / f"{f:g}.txt").write_bytes(fastscan(f, PLACES * 1e-3, values))


def dof_of(path):
    with path.open(newline="") as stream:
        return [
            [cell if k < 2 else float(cell) for k, cell in enumerate(row)]
            for row in list(csv.reader(stream))[1:]
        ]


def run(tmp_path, *arguments, name="dof"):
    """The whole command."""
    out = tmp_path / f"{name}.csv"
    _, outcome = work([*map(str, arguments), "--out", str(out)])
    return out, outcome


def solved(tmp_path, file, points, name):
    """The table that the command writes, without its pages."""
    result = points2dof(read_measurement([file], points, "footplate"))
    write_motion(tmp_path, name, result.motion)
    return tmp_path / f"{name}.csv"


def close(one, two, rtol):
    rows = list(zip(dof_of(one), dof_of(two), strict=True))
    assert rows
    for a, b in rows:
        assert a[:2] == b[:2]
        np.testing.assert_allclose(a[2:], b[2:], rtol=rtol, atol=1e-20)


def same_measurement(one, two, rtol):
    """Channels, positions and displacements of two measurements agree."""
    np.testing.assert_allclose(one.freq_hz, two.freq_hz, rtol=1e-12)
    for a, b in zip(one.bodies, two.bodies, strict=True):
        assert (a.body, a.points) == (b.body, b.points)
        np.testing.assert_allclose(a.directions, b.directions, atol=1e-12)
        np.testing.assert_allclose(a.positions_mm, b.positions_mm, rtol=1e-9)
        np.testing.assert_allclose(a.displacement, b.displacement, rtol=rtol)


def test_three_ways_to_write_a_measurement_are_one(tmp_path):
    points = tmp_path / "points.csv"
    points_file(points)
    tidy(tmp_path / "ldv.csv")
    universal(tmp_path / "ldv.uff")
    scanned(tmp_path / "scan")
    plain = read_measurement([tmp_path / "ldv.csv"], points)
    same = read_measurement([tmp_path / "ldv.uff"], points)
    same_measurement(same, plain, 0.0)
    assert set(codes(same)) == {"spectra_phase", "amplitude_assumed"}
    fast = read_measurement([tmp_path / "scan"], points)
    same_measurement(fast, plain, 1e-7)
    assert "length_unit_assumed" in codes(fast)
    bodies = ("stapes=1-6", "base=7-12")
    own = read_measurement([tmp_path / "ldv.uff"], options=InputOptions(body=bodies, amplitude="peak"))
    same_measurement(own, plain, 0.0)
    assert codes(own) == ["spectra_phase"]


def test_the_sample_study_written_in_three_ways_gives_one_result(tmp_path):
    sample = read_ldv(SAMPLE / "ldv.csv", SAMPLE / "points.csv")
    bodies = tuple(
        replace(body, displacement=body.displacement[..., ::5], sd=body.sd[..., ::5])
        for body in sample.bodies
    )
    write_three_ways(tmp_path, replace(sample, freq_hz=sample.freq_hz[::5], bodies=bodies))
    points = tmp_path / "points.csv"
    made = {n: solved(tmp_path, tmp_path / n, points, f"d{n[3:]}") for n in ("xyz.csv", "xyz.uff", "xyz")}
    assert len(dof_of(made["xyz.csv"])) == 80
    assert made["xyz.uff"].read_bytes() == made["xyz.csv"].read_bytes()
    close(made["xyz"], made["xyz.csv"], 1e-5)


def test_bodies_in_files_of_different_kinds(tmp_path):
    points = tmp_path / "points.csv"
    points_file(points)
    tidy(tmp_path / "ldv.csv")
    tidy(tmp_path / "stapes.csv", range(6))
    universal(tmp_path / "base.uff", range(6, 12), ">", False)
    both = read_measurement([tmp_path / "stapes.csv", tmp_path / "base.uff"], points)
    same_measurement(both, read_measurement([tmp_path / "ldv.csv"], points), 1e-9)


def test_runs_in_several_files_said_on_the_line_and_in_a_config_file(tmp_path):
    points_file(tmp_path / "points.csv")
    universal(tmp_path / "push.uff", range(12), "")
    universal(tmp_path / "tilt.uff", quantity=uff.ACCELERATION, unit="g")
    (tmp_path / "c.toml").write_text('run = ["up=push", "down=tilt.uff"]\namplitude = "rms"\n')
    files = [str(tmp_path / name) for name in ("push.uff", "tilt.uff")]
    points = str(tmp_path / "points.csv")
    words = [*files, "--points", points, "--config", str(tmp_path / "c.toml")]
    measurement = read_inputs(motion_inputs(parser().parse(words).make(LdvOptions))).measurement
    assert measurement.runs == ("up", "down")
    assert "spectra_phase" in codes(measurement)
    assert "amplitude_assumed" not in codes(measurement)
    measurement = read_measurement([Path(file) for file in files], Path(points))
    assert measurement.runs == ("push", "tilt")
    assert "runs_by_file" in codes(measurement)


@pytest.mark.parametrize("word", ["-z", "-0.6,0,0.8"])
def test_directions_may_begin_with_a_minus(word, tmp_path):
    file = tmp_path / "a.uff"
    file.touch()
    beams = {parser().parse([str(file), *words]).beam for words in (["--beam", word], [f"--beam={word}"])}
    assert beams == {BEAM.read(word)}


def test_refusals_of_the_command(tmp_path):
    points_file(tmp_path / "points.csv")
    tidy(tmp_path / "ldv.csv", [0, 1, 7, 8])
    with pytest.raises(StapeskitError) as caught:
        run(
            tmp_path,
            tmp_path / "ldv.csv",
            "--points",
            tmp_path / "points.csv",
            "--body",
            "stapes=1",
            "--beam",
            "z",
        )
    assert "--body must be left out for a tidy table, whose column body says it" in str(caught.value)
    assert len(str(caught.value).splitlines()) == 2
    (tmp_path / "more").mkdir()
    tidy(tmp_path / "more" / "ldv.csv", [0])
    with pytest.raises(StapeskitError, match=r"names of the vibrometer files must be different; got ldv.csv"):
        run(tmp_path, tmp_path / "ldv.csv", tmp_path / "more" / "ldv.csv")
    with pytest.raises(StapeskitError) as caught:
        run(tmp_path, tmp_path / "none.uff", tmp_path / "nor.uff")
    assert len(str(caught.value).splitlines()) == 2
    with pytest.raises(StapeskitError, match="--amplitude must be one of peak, rms; got pp"):
        run(tmp_path, tmp_path / "ldv.csv", "--amplitude", "pp")
    with pytest.raises(StapeskitError, match="--beam must be x, y, z"):
        run(tmp_path, tmp_path / "ldv.csv", "--beam", "up")
    (tmp_path / "a.uff").write_bytes(b"    -1\n    58\n")
    (tmp_path / "b.uff").write_bytes(b"    -1\n   164\n")
    with pytest.raises(StapeskitError) as caught:
        run(tmp_path, tmp_path / "a.uff", tmp_path / "b.uff")
    assert len(str(caught.value).splitlines()) == 2
    assert not (tmp_path / "dof.csv").exists()


def test_a_tidy_table_and_its_recordings_are_one_measurement(tmp_path):
    points_file(tmp_path / "points.csv")
    tidy(tmp_path / "one.csv", range(6))
    tidy(tmp_path / "two.csv", range(6, 12))
    tidy(tmp_path / "both.csv")
    parts = read_measurement([tmp_path / "one.csv", tmp_path / "two.csv"], tmp_path / "points.csv")
    whole = read_measurement([tmp_path / "both.csv"], tmp_path / "points.csv")
    assert list(parts.inputs) == ["ldv", "ldv 2", "points"]
    for one, two in zip(parts.bodies, whole.bodies, strict=True):
        np.testing.assert_allclose(one.displacement, two.displacement, rtol=1e-12)
        assert one.points == two.points


def test_the_help_names_every_way_in():
    text = parser().format_help()
    for word in (
        "--body",
        "--run",
        "--beam",
        "--amplitude",
        "--length-unit",
        ".uff",
        "FastScan",
        ".svd",
        "2411",
    ):
        assert word in text


def test_empty_files_and_archives_say_what_they_are(tmp_path):
    with zipfile.ZipFile(tmp_path / "scan.uff", "w") as archive:
        archive.writestr("scan.txt", "hello")
    (tmp_path / "empty.mat").write_bytes(b"")
    with pytest.raises(StapeskitError) as caught:
        read_measurement([tmp_path / "scan.uff", tmp_path / "empty.mat", tmp_path / "none.h5"])
    told = str(caught.value).splitlines()
    assert "got a ZIP archive (scan.uff). Unpack it" in told[0]
    assert told[1] == (
        "the vibrometer file must be one with content; got 0 bytes (empty.mat). Export or copy it again."
    )
    assert "the vibrometer file must be an existing file" in told[2]


def test_files_that_cannot_be_opened_are_told_in_one_sentence(tmp_path, monkeypatch):
    (tmp_path / "a.uff").write_bytes(uff.function(F, value(0, 0)))

    def refused(self, *_):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr("pathlib.Path.open", refused)
    with pytest.raises(StapeskitError, match=r"must be readable; got Permission denied \(a.uff\). Check"):
        read_measurement([tmp_path / "a.uff"])
