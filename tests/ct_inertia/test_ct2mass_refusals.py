"""What the command refuses, in one sentence each; its help and its exit codes."""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np
import pytest

from legacy.ct_inertia.cli import output_folder, parser
from legacy.ct_inertia.errors import CtInertiaError
from legacy.stapeskit.faults import StapeskitError
from tests.ct_inertia.shapes import stapes
from tests.ct_inertia.test_ct2mass import mesh, run

__all__ = ["mesh"]


class TestFaults:
    @pytest.mark.parametrize(
        ("words", "message"),
        [
            ("", "the mass of the stapes must be given by at least one of .*; got none of them"),
            ("--density -5", "--density must be a positive number"),
            ("--density 1900+-x", "--density must be a positive number .*; got 1900"),
            ("--density 1.9", "--density must be between 500 and 4000 kg/m3; got 1.9. Bone has"),
            ("--density 1.9+-0.1", r"got 1\.9\+-0\.1\. Bone has"),
            ("--mass-mg 300", "--mass-mg must be a mass that gives the volume"),
            ("--density 1900 --anterior 1,0", "--anterior must be three numbers"),
            (
                "--density 1900 --anterior 0,0,0",
                "--anterior must be three numbers x, y, z that are not all zero",
            ),
            ("--density 1900+-1900", "the standard deviation of --density must be smaller than its value"),
            ("--mass-mg 3.2+-4", "the standard deviation of --mass-mg must be smaller than its value"),
            ("--density 1900 --side up", "--side must be one of left, right; got up"),
            ("--density 1900 --spacing 0.02", "--spacing must be left out when the input is a surface mesh"),
            ("--density 1900 --threshold 5", "--threshold must be left out"),
            ("--density 1900 --seed 1,2,3", "--seed must be left out"),
            ("--density 1900 --box 0,0,0,1,1,1", "--box must be left out"),
            (
                "--density 1900 --box 0,0,0,-1,1,1",
                "--box must be six numbers x0, y0, z0, x1, y1, z1 in mm with x0 < x1",
            ),
            ("--density 1900 --mirror x", "--mirror must be left out"),
            ("--density 1900 --spacing 0", "--spacing must be a positive number"),
            ("--density 1900 --voxel-size-sd 90", "--voxel-size-sd must be a percentage"),
            ("--density 1900 --add-mass 1,2,3", "--add-mass must be a list of point masses"),
            ("--density 1900 --landmarks none.csv", "--landmarks must be an existing file"),
            ("--density 1900 --plate-fiducials none.csv", "--plate-fiducials must be an existing"),
            ("--density 1900 --denisty 5", "Did you mean --density"),
        ],
    )
    def test_options_are_told(self, mesh, tmp_path, words, message):
        with pytest.raises(StapeskitError, match=message):
            run([mesh, "--out", tmp_path / "o", *words.split()])
        assert not (tmp_path / "o").exists()

    @pytest.mark.parametrize(
        ("words", "step"),
        [
            ("--landmarks none.csv", "Check its name and folder."),
            ("--voxel-size-sd 90", "Give it in percent, for example 0.2."),
            ("--box 0,0,0,-1,1,1", "Give the lower corner first, then the upper one."),
        ],
    )
    def test_a_fault_ends_with_what_to_do(self, mesh, tmp_path, words, step):
        with pytest.raises(StapeskitError) as told:
            run([mesh, "--density", "1900", "--out", tmp_path / "o", *words.split()])
        assert str(told.value).endswith(step)

    def test_options_are_checked_before_content(self, tmp_path):
        with pytest.raises(StapeskitError, match="at least one of --density"):
            run([tmp_path / "none.tif"])
        with pytest.raises(StapeskitError, match="--landmarks must be"):
            run([tmp_path / "none.tif", "--density", "1900", "--landmarks", tmp_path / "none.csv"])

    def test_a_missing_scan_is_told(self, tmp_path):
        with pytest.raises(StapeskitError, match="SCAN must be given, or --labels alone; got neither"):
            run(["--density", "1900"])
        with pytest.raises(StapeskitError, match="existing"):
            run([tmp_path / "none.tif", "--density", "1900"])
        with pytest.raises(StapeskitError, match="existing"):
            run([tmp_path / "none.stl", "--density", "1900"])

    def test_a_missing_spacing_ends_with_code_2_and_one_sentence(self, tmp_path):
        import tifffile

        tifffile.imwrite(
            tmp_path / "s.tif", np.random.default_rng(0).integers(0, 9, (8, 8, 8)).astype(np.uint8)
        )
        done = subprocess.run(
            [
                sys.executable,
                "-c",
                "from ct_inertia.cli import main; main()",
                tmp_path / "s.tif",
                "--density",
                "1900",
            ],
            capture_output=True,
            text=True,
            cwd=tmp_path,
        )
        assert done.returncode == 2
        assert "--spacing" in done.stderr
        assert "Traceback" not in done.stderr
        assert [path.name for path in tmp_path.iterdir()] == ["s.tif"]

    def test_an_open_mesh_is_told(self, tmp_path):
        import trimesh

        surface = stapes(0.06)
        trimesh.Trimesh(surface.vertices_mm, surface.faces[5:], process=False).export(tmp_path / "open.stl")
        with pytest.raises(CtInertiaError, match="closed and consistently oriented"):
            run([tmp_path / "open.stl", "--density", "1900"])


class TestTheCommandLine:
    def test_help_is_fast(self):
        code = "import sys; sys.argv = ['ct2mass', '--help']; from ct_inertia.cli import main; main()"
        best = 9.0
        for _ in range(3):
            start = time.perf_counter()
            done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
            best = min(best, time.perf_counter() - start)
        assert done.returncode == 0
        for option in (
            "--density",
            "--mass-mg",
            "--calibration",
            "--add-mass",
            "--labels",
            "--plate-fiducials",
        ):
            assert option in done.stdout
        assert best < 1.0

    @pytest.mark.parametrize(
        ("words", "name"),
        [
            ("a/scan.tif", "scan_mass"),
            ("a/b.nii.gz", "b_mass"),
            ("a/slices", "slices_mass"),
            ("--labels x.seg.nrrd", "x_mass"),
        ],
    )
    def test_default_output_folder(self, words, name, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "a" / "slices").mkdir(parents=True)
        for file in ("a/scan.tif", "a/b.nii.gz", "x.seg.nrrd"):
            (tmp_path / file).touch()
        assert output_folder(parser().parse([*words.split(), "--density", "1900"])).name == name

    def test_comma_lists_may_begin_with_a_minus(self, tmp_path):
        for words in (["--anterior", "-0.9,0.1,0"], ["--anterior=-0.9,0.1,0"]):
            given = parser().parse([str(tmp_path), "--density", "1900", *words])
            assert given.anterior == (-0.9, 0.1, 0.0)
