"""`import stapeskit`: from scan to stiffness and damping in memory, with the numbers of the commands."""

import subprocess
import sys
import tomllib
from pathlib import Path

import matplotlib.figure
import numpy as np
import pytest

import legacy.stapeskit as sk
from legacy.kinematics.options import LdvOptions
from legacy.stapeskit.provenance import content_hash
from tests.conftest import leave_drawing
from tests.pipeline.ears import make_ear

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("stapeskit", "ct_inertia", "kinematics", "fitting", "pipeline")


@pytest.fixture(scope="module")
def ear(tmp_path_factory):
    """A study file, its finished run, and the options of its scan."""
    folder = tmp_path_factory.mktemp("door")
    study = make_ear(folder / "ear")
    direction = tomllib.loads(study.read_text(encoding="utf-8"))["scan"]["anterior"]
    with pytest.MonkeyPatch.context() as patch:
        leave_drawing(patch)
        return study.parent, sk.scan2kd(study, out=folder / "out"), direction


@pytest.fixture(scope="module")
def chain(ear):
    """The same ear, in memory."""
    folder, _, anterior = ear
    mass = sk.ct2mass(folder / "stapes.ply", density=(1382.4, 14), side="left", anterior=anterior)
    points, fiducials = folder / "points.csv", folder / "fiducials.csv"
    motion = sk.points2dof(folder / "ldv.csv", points=points, fiducials=fiducials, mass=mass)
    return mass, motion, sk.dof2kd(motion, mass=mass)


def test_the_chain_in_memory_gives_the_numbers_of_scan2kd(ear, chain):
    _, study, _ = ear
    mass, motion, fit = chain
    content = fit.content()
    for key in ("stiffness_si", "damping_si", "covariance_si", "stiffness_sd_si", "mass_matrix_si"):
        np.testing.assert_allclose(np.array(content[key]), np.array(study.kd[key]), rtol=1e-12, err_msg=key)
    assert content["warnings"] == study.kd["warnings"]
    assert mass.body.mass_kg == study.mass["mass_kg"]
    assert isinstance(fit, sk.KDFit)
    assert motion.motion.runs == ("1",)


def test_files_of_one_step_serve_the_next(ear, chain, tmp_path):
    folder, _, _ = ear
    mass, motion, fit = chain
    names = {path.name for path in mass.write(tmp_path, report=False)}
    assert names == {"mass.json", "stapes.ply"}
    assert {path.name for path in motion.write(tmp_path, report=False)} >= {"dof.csv", "dof.h5"}
    again = sk.points2dof(
        [str(folder / "ldv.csv")],
        points=str(folder / "points.csv"),
        fiducials=folder / "fiducials.csv",
        mass=str(tmp_path / "mass.json"),
    )
    np.testing.assert_array_equal(again.motion.q, motion.motion.q)
    np.testing.assert_array_equal(again.motion.covariance, motion.motion.covariance)
    from_files = sk.dof2kd(tmp_path / "dof.h5", mass=tmp_path / "mass.json")
    np.testing.assert_allclose(from_files.stiffness, fit.stiffness, rtol=1e-12)
    matrix = mass.matrix.matrix[np.ix_([1, 3, 5], [1, 3, 5])]
    plain = sk.dof2kd(motion.motion, mass=matrix)
    without_load = sk.dof2kd(motion, mass=mass, inplane="ignore")
    np.testing.assert_allclose(plain.stiffness, without_load.stiffness, rtol=1e-6)
    whole = sk.dof2kd(motion.motion, mass=mass.matrix)
    np.testing.assert_allclose(whole.stiffness, fit.stiffness, rtol=1e-3)
    with pytest.raises(sk.StapeskitError) as raised:
        sk.dof2kd(motion.motion, mass=object())
    assert raised.value.faults[0].got == "object"


def test_results_write_nothing_over_what_they_read(ear, chain, tmp_path, undrawn):
    folder, _, _ = ear
    mass, motion, fit = chain
    before = content_hash(folder / "stapes.ply")
    with pytest.raises(sk.StapeskitError) as raised:
        mass.write(folder, force=True, report=False)
    assert [fault.expected for fault in raised.value.faults] == ["another file than the inputs"]
    assert content_hash(folder / "stapes.ply") == before
    (tmp_path / "kd.json").write_text("of another program")
    with pytest.raises(sk.StapeskitError):
        fit.write(tmp_path)
    assert fit.write(tmp_path, force=True)[0].read_text().startswith("{")
    with pytest.raises(sk.StapeskitError):
        motion.write(folder, name="ldv.csv", force=True, report=False)


def test_results_print_in_one_screen(ear, chain):
    for result in (*chain, ear[1]):
        text = repr(result)
        assert len(text.splitlines()) < 30
        assert len(text.encode()) < 2048
        assert text == str(result)
        html = result._repr_html_()
        assert html.count("<tr") >= 3
        assert len(html) < 20_000


def test_results_give_tables_figures_and_warnings(ear, chain):
    mass, motion, fit = chain
    table = mass.to_frame()
    assert len(table) == 21
    assert table.value_si[0] == mass.matrix.matrix[0, 0]
    rows = motion.to_frame()
    csv = (ear[1].out / "dof.csv").read_text(encoding="utf-8").splitlines()
    assert list(rows.columns) == csv[0].split(",")
    assert len(rows) == len(csv) - 1
    assert rows.y_re_m.iloc[3] == float(csv[4].split(",")[list(rows.columns).index("y_re_m")])
    parameters = fit.to_frame()
    assert list(parameters.parameter) == list(fit.parameters)
    assert list(ear[1].to_frame().quantity)[:2] == ["mass", "K11"]
    for result in (mass, motion, fit, ear[1]):
        assert isinstance(result.plot(), matplotlib.figure.Figure)
        assert result.warnings == result.notices
        assert all(notice.code and notice.text for notice in result.warnings)


def test_a_finished_study_is_copied(ear, tmp_path):
    _, study, _ = ear
    written = study.write(tmp_path / "copy")
    assert {path.name for path in written} == {path.name for path in study.files}
    assert content_hash(tmp_path / "copy" / "kd.json") == content_hash(study.out / "kd.json")


@pytest.mark.parametrize(
    ("call", "got", "hint"),
    [
        (lambda: sk.ct2mass("scan.tif", densty=1900), "densty", "density"),
        (lambda: sk.points2dof("ldv.csv", point="a.csv"), "point", "points"),
        (lambda: sk.dof2kd("dof.csv", mass="mass.json", estimater="ml"), "estimater", "estimator"),
    ],
)
def test_an_unknown_keyword_names_the_nearest(call, got, hint):
    with pytest.raises(sk.StapeskitError) as raised:
        call()
    (fault,) = raised.value.faults
    assert fault.got == got
    assert hint in fault.next_step


def test_options_of_writing_belong_to_write():
    with pytest.raises(sk.StapeskitError) as raised:
        sk.points2dof("ldv.csv", out="folder", force=True)
    assert [fault.got for fault in raised.value.faults] == ["out", "force"]
    assert all(".write(" in fault.next_step for fault in raised.value.faults)


def test_keywords_take_values_of_python():
    given = LdvOptions.of(
        ldv=["a.csv", Path("b.csv")],
        body={"stapes": "1-10", "base": "b.uff:1-3"},
        beam=np.array([0.0, -0.6, 0.8]),
        dof=("y", "alpha"),
        calibrate=True,
        mirror=None,
        n_avg=np.int64(20),
    )
    assert given.ldv == (Path("a.csv"), Path("b.csv"))
    assert given.body == ("stapes=1-10", "base=b.uff:1-3")
    assert given.beam == "0.0,-0.6,0.8"
    assert given.dof == ("y", "alpha")
    assert given.calibrate
    assert given.n_avg == 20.0


def test_a_plain_matrix_counts_by_the_fixed_order(chain):
    with pytest.raises(sk.StapeskitError) as raised:
        sk.dof2kd(chain[1], mass=np.eye(2), dof=("alpha", "y"))
    assert [fault.thing for fault in raised.value.faults] == ["dof"]


def test_the_import_is_light_and_every_name_is_there():
    code = (
        "import sys; before = set(sys.modules); import stapeskit; print(*sorted(set(sys.modules) - before))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert not loaded & {"numpy", "scipy", "argparse", *ROOMS[1:]}, loaded
    for name in sk.__all__:
        assert getattr(sk, name) is not None
    assert set(sk.__all__) <= set(dir(sk))
    with pytest.raises(AttributeError):
        _ = sk.nothing_of_that_name


@pytest.mark.parametrize("room", ROOMS)
def test_types_are_published(room):
    assert (ROOT / room / "py.typed").is_file()
