"""Bad scans from outside: exit code 2, one sentence, nothing left behind."""

from __future__ import annotations

import re
import sys
from functools import lru_cache

import numpy as np
import pytest

from legacy.ct_inertia.cli import work
from legacy.stapeskit.process import run
from tests.ct_inertia.ears import ear


@lru_cache(maxsize=1)
def scans():
    """Name, voxels, options, what must be told."""
    rng = np.random.default_rng(0)
    grey = ear(h=0.05, seed=3).volume.array
    noise = 700.0 * rng.standard_normal((60, 60, 60))
    places = np.indices((80, 80, 80)) - 40
    ball = np.where((places**2).sum(axis=0) < 25**2, 20000.0, 2000.0) + 700.0 * rng.standard_normal(
        (80, 80, 80)
    )
    holed = grey.astype(np.float32)
    holed[3, 4, 5] = np.nan
    return {
        "ten times too coarse": (grey, "0.5", "3 to 4 mm high; got a body of its shape 34 mm high"),
        "in micrometres": (grey, "50", "--spacing must be the voxel size in mm, 0.0001 to 3; got 50"),
        "inverted": (60000 - grey.astype(np.int32), "0.05", "brighter in bone than in air"),
        "two stapedes": (np.concatenate([grey, grey[::-1]]), "0.05", "got 2: .* Name one with --seed"),
        "noise alone": (np.clip(2000 + noise, 0, 65535), "0.05", "picture of bone in air"),
        "a ball": (ball, "0.05", "a body that can be a stapes"),
        "constant": (np.full((40, 40, 40), 500), "0.05", "differing grey values; got 500"),
        "not finite": (holed, "0.05", "must be finite; got 1 voxels of NaN"),
        "astronomical": (grey.astype(np.float32) * np.float32(1e30), "0.05", r"smaller than 1e\+15; got 2"),
        "two-dimensional": (grey[10], "0.05", "three-dimensional"),
        "coloured": (rng.integers(0, 255, (20, 30, 40, 3)), "0.05", "got a colour"),
        "without spacing": (grey, None, "--spacing"),
        "half a stapes": (grey[: len(grey) // 2], "0.05", "touches the border of the scan"),
    }


NAMES = (
    "ten times too coarse",
    "in micrometres",
    "inverted",
    "two stapedes",
    "noise alone",
    "a ball",
    "constant",
    "not finite",
    "astronomical",
    "two-dimensional",
    "coloured",
    "without spacing",
    "half a stapes",
)


@pytest.mark.parametrize("name", NAMES)
def test_a_bad_scan_is_told_in_one_sentence(name, tmp_path, monkeypatch, capsys):
    import tifffile

    voxels, spacing, told = scans()[name]
    if voxels.dtype.kind != "f":
        voxels = voxels.astype(np.uint8 if name == "coloured" else np.uint16)
    elif name not in ("not finite", "astronomical"):
        voxels = voxels.astype(np.uint16)
    tifffile.imwrite(tmp_path / "s.tif", voxels, photometric="rgb" if name == "coloured" else "minisblack")
    words = ["ct2mass", str(tmp_path / "s.tif"), "--density", "1900", "--out", str(tmp_path / "deep" / "out")]
    monkeypatch.setattr(sys, "argv", words + ([] if spacing is None else ["--spacing", spacing]))
    monkeypatch.setattr("legacy.stapeskit.process.listen", lambda _prog: None)
    with pytest.raises(SystemExit) as ended:
        run("ct2mass", work)
    printed = capsys.readouterr()
    assert ended.value.code == 2
    assert printed.out == ""
    assert "Traceback" not in printed.err
    assert len(printed.err.strip().splitlines()) == 1
    assert printed.err.rstrip().endswith(".")
    monkeypatch.undo()
    assert re.search(told, printed.err)
    assert [path.name for path in tmp_path.iterdir()] == ["s.tif"]
