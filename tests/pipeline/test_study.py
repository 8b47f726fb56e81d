"""Study files: every fault in one message, with table, key and the nearest valid key."""

import re
import tomllib

import pytest

from legacy.pipeline.errors import PipelineError
from legacy.pipeline.study import TABLES, parse_study, read_study
from legacy.pipeline.template import TEMPLATE
from legacy.stapeskit.options import declared

GOOD = """
[scan]
file = "scan.tif"
density_kg_m3 = "1382+-14"
[ldv]
file = "ldv.csv"
"""


RAW = GOOD.replace(
    "[ldv]",
    """shape = [40, 50, 60]
dtype = "int16"
byte_order = "big"
header_bytes = 512
spacing_mm = 0.02
[ldv]""",
)


def parsed(text, tmp_path):
    return parse_study(text, tmp_path, check_files=False)


def fault(text, tmp_path):
    with pytest.raises(PipelineError) as caught:
        parsed(text, tmp_path)
    return str(caught.value)


def test_template_parses_and_names_every_key(tmp_path):
    study = parsed(TEMPLATE, tmp_path)
    assert study.scan.density == (1900.0, 60.0)
    assert study.fit.dof == ("y", "alpha", "gamma")
    every = re.sub(r"(?m)^# (?=\w+ = )", "", TEMPLATE)
    tables = tomllib.loads(every)
    for table, kind in TABLES.items():
        assert set(tables[table]) == {one.key for one in declared(kind) if one.table}, table


def test_every_optional_line_of_the_template_is_valid(tmp_path):
    every = re.sub(r"(?m)^# (?=\w+ = )", "", TEMPLATE)
    labels = ("labels", "stapes_label", "plate_label")
    for key in ("mass_mg", "calibration", "frame", "correct", "period_s", "lower", "upper", *labels):
        every = re.sub(rf"(?m)^{key} = .*$", "", every)
    study = parsed(every, tmp_path)
    assert study.scan.add_mass == ((4.0, 5.1, 3.3, 0.02, 0.0),)
    assert study.fit.exclude_hz == ((49.0, 51.0), (990.0, 1010.0))
    assert study.scan.spacing_mm == (0.020,)


@pytest.mark.parametrize(
    ("given", "value"),
    [('"1382+-14"', (1382.0, 14.0)), ("1382", (1382.0, None)), ('"1382±14"', (1382.0, 14.0))],
)
def test_density_as_text_or_number(given, value, tmp_path):
    assert parsed(GOOD.replace('"1382+-14"', given), tmp_path).scan.density == value


def test_the_layout_of_raw_voxels_reaches_ct2mass(tmp_path):
    layout = parsed(RAW, tmp_path).scan.raw
    assert (layout.shape, layout.dtype) == ((40, 50, 60), "int16")
    assert (layout.byte_order, layout.header_bytes) == ("big", 512)
    short = RAW.replace('byte_order = "big"\nheader_bytes = 512\n', "")
    layout = parsed(short, tmp_path).scan.raw
    assert (layout.byte_order, layout.header_bytes) == ("little", 0)
    assert parsed(GOOD, tmp_path).scan.raw is None


def test_several_ways_to_the_mass_may_be_given(tmp_path):
    scan = parsed(GOOD.replace("[ldv]", 'mass_mg = "3.1+-0.05"\n[ldv]'), tmp_path).scan
    options = scan
    assert options.mass_known_by == "mass"
    assert options.density == (1382.0, 14.0)


def test_paths_are_relative_to_the_study_file(tmp_path, monkeypatch):
    folder = tmp_path / "ear"
    folder.mkdir()
    (folder / "study.toml").write_text(GOOD)
    for name in ("scan.tif", "ldv.csv"):
        (folder / name).write_bytes(b"")
    monkeypatch.chdir(tmp_path)
    study = read_study(folder / "study.toml")
    assert study.scan.scan == folder / "scan.tif"
    assert study.ldv.ldv == (folder / "ldv.csv",)


def test_missing_files_are_named_together(tmp_path):
    (tmp_path / "study.toml").write_text(GOOD)
    with pytest.raises(PipelineError) as caught:
        read_study(tmp_path / "study.toml")
    text = str(caught.value)
    assert "scan.file must be an existing file" in text
    assert "got scan.tif (study.toml)" in text
    assert "ldv.file must be an existing vibrometer file" in text


def test_all_faults_of_a_file_in_one_message(tmp_path):
    text = fault(
        """
[study]
name = 3
[scan]
fille = "scan.tif"
spacing_mm = -1
density_kg_m3 = "heavy"
side = "top"
anterior = [0, 0, 0]
box_mm = [0, 0, 0, 1, 1, -1]
nan_as_air = 1
[ldv]
points = 4
[fit]
estimater = "ml"
dof = "y,phi"
band_hz = [5000, 400]
""",
        tmp_path,
    )
    for key in ("study.name", "scan.spacing_mm", "scan.density_kg_m3", "scan.side", "scan.anterior"):
        assert f"{key} must be" in text
    for key in ("scan.box_mm", "scan.nan_as_air", "ldv.file", "ldv.points", "fit.dof", "fit.band_hz"):
        assert f"{key} must be" in text
    assert "Did you mean file" in text
    assert "?." not in text
    assert "Did you mean estimator" in text
    assert all("(study.toml)" in line for line in text.splitlines())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (GOOD + "[fits]\n", "Did you mean [fit]"),
        (GOOD + "estimator = 'ml'\n", "Did you mean fit.estimator"),
        ("name = 'x'\n" + GOOD, "Did you mean name in [study]"),
        (
            GOOD.replace('density_kg_m3 = "1382+-14"\n', ""),
            "at least one of scan.density_kg_m3, scan.mass_mg and scan.calibration",
        ),
        (GOOD.replace('file = "scan.tif"\n', ""), "scan.file must be given, or scan.labels"),
        (GOOD + 'fiducials = "f.csv"\nframe = "plate"\n', "ldv.frame must be left out"),
        (
            GOOD + '[fit]\nestimator = "pinv"\nrobust = "t4"\n',
            "fit.robust must be none with this fit.estimator",
        ),
        (GOOD + "[fit]\nlower = { K11 = 1.0 }\n", "unless fit.estimator takes bounds"),
        (GOOD + "[fit]\nupper = { K11 = 'x' }\n", "fit.upper must be an entry and a number in SI"),
        (GOOD.replace('"scan.tif"', "scan.tif"), "must be valid TOML"),
        ("scan = 3\n[ldv]\nfile='a'\n", "the table [scan] must be a table of keys"),
        ('[scan]\nfile = "s"\nmass_mg = 3\n', "the table [ldv] must be given"),
        (
            GOOD.replace("[ldv]", "add_mass = [[1, 2, 3]]\n[ldv]"),
            "scan.add_mass must be a list of point masses",
        ),
        (GOOD.replace("[ldv]", "threshold = true\n[ldv]"), "scan.threshold must be a number"),
        (GOOD.replace("[ldv]", "stapes_label = 0\n[ldv]"), "scan.stapes_label must be a whole number"),
        (GOOD.replace("[ldv]", "voxel_size_sd_percent = 80\n[ldv]"), "scan.voxel_size_sd_percent must be"),
        (GOOD.replace("[ldv]", "seed_mm = [1, 2]\n[ldv]"), "scan.seed_mm must be three numbers"),
        (RAW.replace("40, 50, 60", "40, 50.5, 60"), "scan.shape must be three whole numbers of at least 2"),
        (RAW.replace("40, 50, 60", "40, 1, 60"), "scan.shape must be three whole numbers of at least 2"),
        (RAW.replace("int16", "short"), "scan.dtype must be one of uint8, int8"),
        (RAW.replace("big", "network"), "scan.byte_order must be one of little, big"),
        (RAW.replace("512", "-1"), "scan.header_bytes must be a whole number, 0 or more"),
        (
            RAW.replace('dtype = "int16"\n', ""),
            "scan.dtype must be given with the other",
        ),
        (
            RAW.replace("shape = [40, 50, 60]\n", ""),
            "scan.shape must be given with the other",
        ),
        (GOOD + "[fit]\nexclude_hz = [60, 50]\n", "fit.exclude_hz must be a range of two frequencies"),
        (GOOD + "[fit]\nbands = 1\n", "fit.bands must be 0, or 2 to 100 parts of the band; got 1"),
        (
            GOOD + "[fit]\nmonte_carlo = 5\n",
            "fit.monte_carlo must be a whole number from 20 to 1000000, or 0",
        ),
    ],
)
def test_one_fault_each(text, words, tmp_path):
    assert words in fault(text, tmp_path)


def test_a_missing_study_file_says_how_to_get_one(tmp_path):
    with pytest.raises(PipelineError, match="--template"):
        read_study(tmp_path / "no.toml")


def test_a_byte_order_mark_is_read_and_other_encodings_are_refused(tmp_path):
    path = tmp_path / "study.toml"
    path.write_bytes(b"\xef\xbb\xbf[study]\nname = 'a'\n")
    with pytest.raises(PipelineError, match=r"the table \[scan\] must be given"):
        read_study(path)
    path.write_bytes(b"\xff\xfe[\x00")
    with pytest.raises(PipelineError, match="must be UTF-8 text"):
        read_study(path)


@pytest.mark.parametrize(
    ("line", "step"),
    [
        ('name = "C:\\Users\\Ohr"', "Write paths with / instead of \\"),
        ("name = 1,394", "Write texts and paths in quotes, numbers with decimal points"),
    ],
)
def test_what_breaks_toml_is_explained(tmp_path, line, step):
    path = tmp_path / "study.toml"
    path.write_text(f"[study]\n{line}\n")
    with pytest.raises(PipelineError) as caught:
        read_study(path)
    (fault,) = caught.value.faults
    assert fault.next_step.startswith(step)


def test_values_nested_too_deep_are_a_fault(tmp_path):
    assert "nested too deep" in fault("a = " + "[" * 50_000, tmp_path)


def test_contradicting_sides_are_a_fault(tmp_path):
    sides = '[study]\nside = "left"\n' + GOOD.replace("[ldv]", 'side = "right"\n[ldv]')
    with pytest.raises(PipelineError) as caught:
        parsed(sides, tmp_path)
    assert caught.value.faults[0].thing == "the side of the ear"
    assert parsed(sides.replace("right", "left"), tmp_path).study.side == "left"
    once = parsed(sides.replace('side = "right"\n', ""), tmp_path)
    assert once.scan.side == "left"
