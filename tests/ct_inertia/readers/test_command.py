"""Formats and bad files through the command `ct2mass`, as a user meets them."""

import json
import sys

import numpy as np
import pytest
import tifffile

from legacy.ct_inertia.cli import main, parser
from legacy.ct_inertia.options import MassOptions
from legacy.stapeskit.faults import StapeskitError
from tests.ct_inertia.ears import ear
from tests.ct_inertia.readers import scanner_writers as scanners
from tests.ct_inertia.readers import writers as f

pytestmark = pytest.mark.usefixtures("undrawn")

RAW = ["--dtype", "uint16", "--byte-order", "big", "--header-bytes", "77"]


def through_the_command(monkeypatch, capsys, *arguments):
    """Run the command and return its exit code, what it printed, and what it complained of."""
    monkeypatch.setattr(sys, "argv", ["ct2mass", *map(str, arguments)])
    monkeypatch.setattr("legacy.stapeskit.process.listen", lambda _prog: None)
    with pytest.raises(SystemExit) as left:
        main()
    told = capsys.readouterr()
    return left.value.code, told.out, told.err


def test_one_scan_in_many_formats_gives_one_mass_matrix(tmp_path, monkeypatch, capsys):
    volume = ear(h=0.05).volume
    array = np.clip(volume.array, 0, 65535).astype(np.uint16)
    monkeypatch.setattr(f, "SPACING", np.array([0.05] * 3))
    shape = ",".join(map(str, array.shape[::-1]))
    given = {
        f.imagej(tmp_path / "a.tif", array): [],
        f.pages(tmp_path / "lzw.tif", array, compression="lzw", byteorder=">"): ["--spacing", "0.05"],
        f.raw(tmp_path / "a.raw", array, big=True, header=77): ["--spacing", "0.05", "--shape", shape, *RAW],
        f.slices(tmp_path / "folder", array): ["--spacing", "0.05"],
        f.ome_zarr(tmp_path / "a.zarr", array, "0.5", chunk=32): [],
    }
    matrices = []
    for path, options in given.items():
        out = tmp_path / "out"
        code, _, told = through_the_command(
            monkeypatch, capsys, path, "--density", "1900+-60", "--no-report", "--out", out, *options
        )
        assert code == 0, told
        content = json.loads((out / "mass.json").read_text())
        matrices.append(content["mass_matrix"]["matrix_si"])
    assert all(np.allclose(matrix, matrices[0], rtol=1e-6, atol=0.0) for matrix in matrices)


def test_the_layout_of_raw_voxels_is_checked_before_any_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a.raw", "a.tif"):
        (tmp_path / name).touch()
    given = parser().parse(["a.raw", "--density", "1900", "--shape", "4,5,6", *RAW])
    layout = given.make(MassOptions).raw
    assert (layout.shape, layout.stored_type, layout.header_bytes) == ((4, 5, 6), np.dtype(">u2"), 77)
    assert parser().parse(["a.tif", "--density", "1900"]).make(MassOptions).raw is None
    with pytest.raises(StapeskitError, match="--dtype must be given with the other options of raw voxels"):
        parser().parse(["a.raw", "--density", "1900", "--shape", "4,5,6"]).make(MassOptions)
    with pytest.raises(StapeskitError, match="--dtype must be one of uint8"):
        parser().parse(["a.raw", "--density", "1900", "--shape", "4,5,6", "--dtype", "int"]).make(MassOptions)


NOISE = np.random.default_rng(0)


def bad_files(folder):
    """Files that are no scans, each with a word of the one sentence that it must be told by."""

    def flat(name, array, **options):
        tifffile.imwrite(folder / name, array, **options)
        return folder / name

    grey = NOISE.integers(0, 60000, (30, 32, 34)).astype(np.uint16)
    noise = NOISE.normal(1000.0, 50.0, (60, 60, 60)).astype(np.float32)
    holed = noise.copy()
    holed[5, 6, 7] = np.nan
    whole = f.imagej(folder / "whole.tif", grey).read_bytes()
    (folder / "short.tif").write_bytes(whole[: len(whole) // 2])
    return {
        flat("flat.tif", grey[0]): "three-dimensional",
        flat("rgb.tif", np.zeros((4, 30, 30, 3), np.uint8), photometric="rgb"): "colour",
        flat("complex.tif", grey.astype(np.complex64)): "complex",
        flat("nan.tif", holed): "finite; got 1 voxels",
        flat("constant.tif", np.full((20, 20, 20), 9, np.uint16)): "differing grey values",
        flat("noise.tif", noise): "the scan must be",
        folder / "short.tif": "opy or export it again",
        f.meta(folder / "huge.mha", grey, DimSize="90000 90000 90000"): "1.46e+03 TB",
        f.itk_turned(folder / "left.mha", grey, np.diag([1, 1, -1])): "right-handed",
        f.nrrd(folder / "none.nrrd", grey, spacings=None): "--spacing",
    }


def test_a_bad_file_is_told_in_one_sentence(tmp_path, monkeypatch, capsys):
    for path, words in bad_files(tmp_path).items():
        spacing = [] if path.name in ("none.nrrd", "short.tif") else ["--spacing", "0.02"]
        code, out, told = through_the_command(
            monkeypatch, capsys, path, "--density", "1900", "--out", tmp_path / "out", *spacing
        )
        assert (code, out) == (2, ""), path
        assert words in told, (path, told)
        assert "Traceback" not in told
        assert len(told.strip().splitlines()) == 1
        assert " must be " in told
        assert not (tmp_path / "out").exists()


def test_the_voxels_beside_a_header_are_inputs_too(tmp_path):
    array = f.picture()
    f.itk(tmp_path / "scan.mhd", array)
    scanners.vgi(tmp_path / "ear.vgi", array, parts=2)
    f.itk(tmp_path / "a.nhdr", array)
    f.itk(tmp_path / "b.img", array.astype(np.int16))
    expected = {
        "scan.mhd": ["scan.raw"],
        "scan.raw": ["scan.mhd"],
        "ear.vgi": ["ear-0.vol", "ear-1.vol"],
        "a.nhdr": ["a.raw"],
        "b.hdr": ["b.img"],
        "b.img": ["b.hdr"],
    }
    for name, others in expected.items():
        inputs = parser().parse([str(tmp_path / name), "--density", "1900"]).make(MassOptions).inputs
        told = [path.name for role, path in inputs.items() if role.startswith("scan_data")]
        assert told == others, name
    alone = f.imagej(tmp_path / "a.tif", array)
    assert "scan_data" not in parser().parse([str(alone), "--density", "1900"]).make(MassOptions).inputs
