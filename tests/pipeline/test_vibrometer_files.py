"""Studies whose vibrometer data are exports of a measuring system."""

from __future__ import annotations

import json

import numpy as np
import pytest

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.fit_options import fit_options
from legacy.kinematics.measure_motion import motion_inputs
from legacy.kinematics.readers.from_options import input_options
from legacy.kinematics.tidy.ldv_csv import read_ldv
from legacy.pipeline.errors import PipelineError
from legacy.pipeline.scan2kd import run_study
from legacy.pipeline.study import parse_study
from tests.kinematics.rewritten import write_three_ways
from tests.pipeline.ears import make_ear

SCAN = '[scan]\nfile = "a.tif"\ndensity_kg_m3 = 1900\n[ldv]\n'


def parsed(text, tmp_path, check=False):
    return parse_study(SCAN + text, tmp_path, check_files=check)


def test_keys_of_the_study_are_the_options_of_the_command(tmp_path):
    study = parsed(
        'file = ["s.uff", "b.uff"]\n'
        'body = { stapes = "1-10,12", base = ["b.uff:1-3", 7] }\n'
        'run = { push = "s.uff" }\n'
        'beam = [0, -0.6, 0.8]\namplitude = "rms"\nlength_unit = "mm"\n',
        tmp_path,
    )
    assert [path.name for path in study.ldv.files] == ["s.uff", "b.uff"]
    said = input_options(study.ldv)
    assert said.body == ("stapes=1-10,12", "base=b.uff:1-3,7")
    assert said.run == ("push=s.uff",)
    np.testing.assert_allclose(said.direction, [0.0, -0.6, 0.8])
    assert (said.amplitude, said.length_unit) == ("rms", "mm")
    assert list(motion_inputs(study.ldv).by_role)[:2] == ["ldv", "ldv 2"]
    one = parsed('file = "s.uff"\nbeam = "-z"\nbody = ["stapes=1-3"]\n', tmp_path)
    assert [path.name for path in one.ldv.files] == ["s.uff"]
    np.testing.assert_allclose(input_options(one.ldv).direction, [0.0, 0.0, -1.0])


def test_noise_of_the_reference_is_a_key(tmp_path):
    assert (
        fit_options(parsed('file = "s.uff"\nreference_noise = 0.01\n', tmp_path).ldv).reference_noise == 0.01
    )
    with pytest.raises(PipelineError, match=r"ldv.reference_noise must be from 0 to below 1; got 2"):
        parsed('file = "s.uff"\nreference_noise = 2\n', tmp_path)


def test_keys_of_time_series_go_together(tmp_path):
    (tmp_path / "channels.csv").write_text("channel\n")
    series = 'channels = "channels.csv"\nfrf = "h2"\nresolution_hz = 5\n'
    series += "frf_band_hz = [400, 5000]\nskip_periods = 0\n"
    said = input_options(parsed('file = "t.csv"\nn_avg = 20\n' + series, tmp_path).ldv)
    assert said.n_avg == 20.0
    assert (said.series.frf, said.series.resolution_hz) == ("h2", 5.0)
    assert (said.series.frf_band_hz, said.series.skip_periods) == ((400.0, 5000.0), 0)
    with pytest.raises(KinematicsError, match=r"--window must be given with --channels; got alone"):
        input_options(parsed('file = "t.csv"\nwindow = "hann"\n', tmp_path).ldv)
    (tmp_path / "t.uff").write_text("    -1\n    58\n")
    said = input_options(parsed('file = "t.uff"\nwindow = "hann"\n', tmp_path).ldv)
    assert (said.series.window, said.series.channels) == ("hann", None)
    study = parsed('file = "t.csv"\nmapping = "m.toml"\n' + series, tmp_path)
    assert {"ldv", "mapping", "channels"} <= {
        name for name, path in motion_inputs(study.ldv).by_role.items() if path
    }
    (tmp_path / "t.csv.toml").write_text("")
    assert "t.csv.toml" in motion_inputs(study.ldv).by_role


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('file = "s.uff"\naverages = 2.5', "ldv.averages must be a whole number"),
        ("file = []", "ldv.file must be an existing vibrometer file or folder"),
        ('file = ["s.uff", 3]', "ldv.file must be an existing vibrometer file or folder; got s.uff,3"),
        ('file = "s.uff"\nbody = "stapes"', "ldv.body must be NAME=POINTS, or a table like { stapes"),
        (
            'file = "s.uff"\nbody = { stapes = [1.5] }',
            "ldv.body must be NAME=POINTS, or a table like { stapes",
        ),
        ('file = "s.uff"\nrun = 3', "ldv.run must be NAME=FILE, or a table like"),
        ('file = "s.uff"\nbeam = [1, 0]', "ldv.beam must be x, y, z, -x, -y, -z or three numbers"),
        ('file = "s.uff"\namplitude = "pp"', "ldv.amplitude must be one of peak, rms"),
        ('file = "s.uff"\nlength_unit = "inch"', "ldv.length_unit must be one of m, mm, um"),
    ],
)
def test_keys_with_impossible_values_are_named(text, words, tmp_path):
    with pytest.raises(PipelineError) as caught:
        parsed(text, tmp_path)
    assert words in str(caught.value)


def test_every_missing_file_of_a_list_is_found(tmp_path):
    with pytest.raises(PipelineError, match=r"ldv.file must be an existing vibrometer file"):
        parsed('file = ["s.uff", "b.uff"]', tmp_path, True)


def ear_in_three_ways(tmp_path):
    """An ear whose velocities along x, y, z stand in a table, a universal file and a FastScan folder."""
    study = make_ear(tmp_path / "ear")
    folder = study.parent
    write_three_ways(folder, read_ldv(folder / "ldv.csv", folder / "points.csv"))
    return study


def test_the_whole_chain_from_three_ways_to_write_a_measurement(tmp_path):
    study = ear_in_three_ways(tmp_path)
    text = study.read_text(encoding="utf-8")
    found = {}
    for name in ("xyz.csv", "xyz.uff", "xyz"):
        study.write_text(text.replace('"ldv.csv"', f'"{name}"'), encoding="utf-8")
        found[name] = run_study(study, tmp_path / "out")
        assert [run.name for run in found[name].stages if run.reused][:1] == ["scan"] or name == "xyz.csv"
    plain = np.array(found["xyz.csv"].kd["stiffness_si"])
    assert (tmp_path / "out" / "dof.csv").is_file()
    np.testing.assert_allclose(found["xyz.uff"].kd["stiffness_si"], plain, rtol=1e-9)
    np.testing.assert_allclose(found["xyz"].kd["stiffness_si"], plain, rtol=1e-4)
    codes = {notice.code for notice in found["xyz"].notices}
    assert "length_unit_assumed" in codes
    texts = [notice.text for notice in found["xyz"].notices]
    assert any("ldv.length_unit" in line for line in texts)
    json.dumps(found["xyz.uff"].kd["warnings"])


def test_what_is_said_wrongly_is_told_once_and_in_words_of_the_study(tmp_path):
    study = make_ear(tmp_path / "ear")
    text = study.read_text(encoding="utf-8").replace(
        "[fit]", 'run = ["a=s.uff"]\nbody = ["stapes=9-1"]\n[fit]'
    )
    study.write_text(text, encoding="utf-8")
    with pytest.raises(PipelineError) as caught:
        run_study(study, tmp_path / "out")
    lines = str(caught.value).splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("the points of ldv.body must be")
