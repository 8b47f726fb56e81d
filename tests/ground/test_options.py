"""One declaration of an option serves command line, --config, study file, Python, help and template."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import pytest

from stapeskit.command_line import parse
from stapeskit.faults import Fault, StapeskitError
from stapeskit.option_types import (
    Box,
    Direction,
    DofList,
    Flag,
    Masses,
    PositiveWithSd,
    Range,
    Ranges,
    ReadFile,
    Spacing,
    WithSd,
    ZeroOrWithSd,
)
from stapeskit.options import Opt, Options, Rule, template


class Scan(Options):
    """A table with every kind of value."""

    table = "scan"
    rules = (
        Rule(lambda v: v.file is None, Fault("SCAN", "given", "nothing")),
        Rule(
            lambda v: v.density_kg_m3 is not None and v.density_kg_m3.value > 3000,
            Fault("--density", "of bone"),
        ),
    )
    file: Annotated[ReadFile | None, Opt("a volume", positional=True, name="scan", example="scan.tif")] = None
    density_kg_m3: Annotated[PositiveWithSd | None, Opt("density, kg/m3", "mass", "1900+-60")] = None
    coat_um: Annotated[ZeroOrWithSd | None, Opt("thickness of mucosa, um", "find", 35)] = None
    spacing_mm: Annotated[Spacing | None, Opt("voxel size, mm", "read", 0.02)] = None
    box_mm: Annotated[Box | None, Opt("part to look at", "find", [0.0, 0.0, 0.0, 8.0, 8.0, 6.0])] = None
    anterior: Annotated[Direction | None, Opt("towards anterior", "frames", [-0.9, 0.1, 0.0])] = None
    mirror: Annotated[Literal["x", "y", "z"] | None, Opt("reverse an axis", "read", "z")] = None
    add_mass: Annotated[Masses, Opt("a point mass", "mass", [[4.0, 5.0, 3.0, 0.02]], repeats=True)] = ()
    nan_as_air: Annotated[Flag, Opt("let voxels that are not finite be air", "read")] = False


class Fit(Options):
    """A second table of the same command."""

    table = "fit"
    dof: Annotated[DofList, Opt("degrees of freedom", "fit")] = ("y", "alpha", "gamma")
    band_hz: Annotated[Range | None, Opt("band", "fit", [400, 5000])] = None
    exclude_hz: Annotated[Ranges, Opt("left out", "fit", [[45, 55]], repeats=True)] = ()


@pytest.fixture
def scan_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "scan.tif"
    path.touch()
    return path


def parsed(words: str) -> tuple[Scan, Fit]:
    scan, fit = parse("ct2mass", "Mass.", [Scan, Fit], words.split())
    return scan, fit


VALUES = {
    "--density 1900+-60": ("density_kg_m3", WithSd(1900.0, 60.0)),
    "--density 1900": ("density_kg_m3", WithSd(1900.0)),
    "--density=1900±60": ("density_kg_m3", WithSd(1900.0, 60.0)),
    "--coat 0": ("coat_um", WithSd(0.0)),
    "--spacing 0.02": ("spacing_mm", (0.02, 0.02, 0.02)),
    "--spacing 0.02,0.02,0.05": ("spacing_mm", (0.02, 0.02, 0.05)),
    "--box -1,-2,-3,4,5,6": ("box_mm", (-1.0, -2.0, -3.0, 4.0, 5.0, 6.0)),
    "--anterior -0.9,0.1,0": ("anterior", (-0.9, 0.1, 0.0)),
    "--anterior=-0.9,0.1,0": ("anterior", (-0.9, 0.1, 0.0)),
    "--anterior \N{MINUS SIGN}0.9,0.1,0": ("anterior", (-0.9, 0.1, 0.0)),
    "--mirror z": ("mirror", "z"),
    "--nan-as-air": ("nan_as_air", True),
    "--add-mass 1,2,3,.5+-.1 --add-mass 0,0,0,1": ("add_mass", ((1, 2, 3, 0.5, 0.1), (0, 0, 0, 1, 0))),
    "--dof gamma,y": ("dof", ("y", "gamma")),
    "--dof all": ("dof", ("x", "y", "z", "alpha", "beta", "gamma")),
    "--band 400-5000": ("band_hz", (400.0, 5000.0)),
    "--exclude 45-55 --exclude 1e3-1100": ("exclude_hz", ((45.0, 55.0), (1000.0, 1100.0))),
}


@pytest.mark.parametrize("words", VALUES)
def test_command_line_study_and_python_read_the_same_value(words: str, scan_file: Path) -> None:
    key, expected = VALUES[words]
    tables = {key: table for table in parsed(f"scan.tif {words}") for key in type(table).key_names()}
    assert getattr(tables[key], key) == expected
    table = type(tables[key])
    name = next(entry.name for entry in table.entries() if entry.key == key)
    needed = {"scan": scan_file} if table is Scan else {}
    again = table.of(**needed, **{name: expected})
    assert getattr(again, key) == expected


UNFIT = {
    "--density 19x": "--density",
    "--density -3": "--density",
    "--density 1900+-60+-3": "--density",
    "--box 1,2,3,0,5,6": "--box",
    "--box 1,2,3": "--box",
    "--spacing 0,02": "--spacing",
    "--mirror q": "--mirror",
    "--anterior 0,0,0": "--anterior",
    "--anterior nan,0,1": "--anterior",
    "--dof y,y": "--dof",
    "--dof delta": "--dof",
    "--band 5000-400": "--band",
    "--add-mass 1,2,3": "--add-mass",
    "--treshold 3": "--treshold",
    "--density 1 --density 2": "--density",
    "--box=": "--box",
    "--density": "--density",
    "other.tif": "other.tif",
    "nothing.tif": "SCAN",
}


@pytest.mark.parametrize("words", UNFIT)
def test_unfit_values_are_refused_by_name(words: str, scan_file: Path) -> None:
    line = words if words.startswith("nothing") else f"{scan_file.name} {words}"
    with pytest.raises(StapeskitError) as raised:
        parsed(line)
    assert [fault.thing for fault in raised.value.faults] == [UNFIT[words]]


def test_a_wrong_name_in_python_is_refused() -> None:
    with pytest.raises(StapeskitError) as raised:
        Scan.of(densty=3)
    assert raised.value.faults[0].thing == "densty"


def test_all_faults_come_together(scan_file: Path) -> None:
    with pytest.raises(StapeskitError) as raised:
        parsed("scan.tif --density 19x --box 1,2,3,0,5,6 --mirror q --band 3 --nothing")
    assert {fault.thing for fault in raised.value.faults} == {
        *("--density", "--box", "--mirror", "--band", "--nothing")
    }


def test_rules_are_checked_once_every_value_is_right(scan_file: Path) -> None:
    with pytest.raises(StapeskitError) as raised:
        parsed("--density 4000")
    assert [fault.thing for fault in raised.value.faults] == ["SCAN", "--density"]


def test_config_gives_options_and_the_command_line_wins(scan_file: Path, tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "other.tif").touch()
    (tmp_path / "sub" / "c.toml").write_text('density = "1800+-50"\nmirror = "x"\nscan = "other.tif"\n')
    scan, _ = parsed("--config sub/c.toml --mirror y")
    assert scan.density_kg_m3 == WithSd(1800.0, 50.0)
    assert scan.mirror == "y"
    assert scan.file == Path("sub/other.tif")
    (tmp_path / "sub" / "c.toml").write_text("densty = 3\n")
    with pytest.raises(StapeskitError) as raised:
        parsed("scan.tif --config sub/c.toml")
    assert raised.value.faults[0].thing == "densty"


def test_a_study_names_its_keys_and_file(scan_file: Path, tmp_path: Path) -> None:
    found = Scan.from_study({"file": "scan.tif", "box_mm": [0, 0, 0, 1, 1, 1]}, "study.toml", tmp_path)
    assert found.file == tmp_path / "scan.tif"
    with pytest.raises(StapeskitError) as raised:
        Scan.from_study({"file": "scan.tif", "box_mm": 3, "dens": 1}, "study.toml", tmp_path)
    faults = raised.value.faults
    assert {(fault.thing, fault.where) for fault in faults} == {
        *(("scan.box_mm", "study.toml"), ("dens", "study.toml"))
    }


def test_the_template_is_a_study_that_can_be_read(scan_file: Path, tmp_path: Path) -> None:
    import tomllib

    text = template("A study", [Scan, Fit])
    content = tomllib.loads(text.replace("# ", "", 1) and "\n".join(
        line.removeprefix("# ") if " = " in line else line for line in text.splitlines()
    ))  # fmt: skip
    made = Scan.from_study(content["scan"], "study.toml", tmp_path)
    assert made.box_mm == (0.0, 0.0, 0.0, 8.0, 8.0, 6.0)
    assert Fit.from_study(content["fit"], "study.toml", tmp_path).exclude_hz == ((45.0, 55.0),)


@pytest.mark.parametrize("stated", ["2+-3", "1900"])
def test_a_broken_rule_is_told_by_the_key_and_file_of_a_study(tmp_path: Path, stated: str) -> None:
    from ct_inertia.options import MassOptions

    (tmp_path / "stapes.stl").touch()
    values = {"file": "stapes.stl", "density_kg_m3": stated, "threshold": 300.0}
    with pytest.raises(StapeskitError) as raised:
        MassOptions.from_study(values, "study.toml", tmp_path)
    assert "scan.threshold" in [fault.thing for fault in raised.value.faults]
    assert all(fault.where == "study.toml" and "--" not in str(fault) for fault in raised.value.faults)
