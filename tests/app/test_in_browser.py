"""The whole page by mouse: scan, cut, marks, measurement, fit, and the study that repeats it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from playwright import sync_api

from ct_inertia.scan.open_scan import open_labels
from tests.app.driven import Page, Server, Tile, command_line

pytestmark = [pytest.mark.browser, pytest.mark.filterwarnings("ignore")]
SAMPLE = Path(__file__).parents[2] / "sample_volumes"
FILES = ("scan.tif", "ldv.csv", "points.csv", "fiducials.csv")


@pytest.fixture
def folder(tmp_path):
    for name in FILES:
        shutil.copy(SAMPLE / name, tmp_path)
    return tmp_path


def test_scan_to_stiffness_by_mouse(folder):
    server = Server(folder)
    try:
        with sync_api.sync_playwright() as playwright:
            page = Page(playwright, server.address)
            _measure(page, folder)
            _draw_and_undo(page, folder)
            _set_marks(page, folder)
            _fit(page, folder)
            assert page.asked_elsewhere == []
            page.browser.close()
    finally:
        server.close()
    assert "Traceback" not in server.said


def _measure(page, folder):
    page.press("scan.tif")
    page.wait("scan.tif opened")
    page.shot("1_opened")
    page.write("density", "none")
    page.press("/^Measure$/")
    page.wait("density_kg_m3 must be")
    page.write("density", "1394.4+-13.8")
    page.press("/^Measure$/")
    page.wait("Measuring the stapes:")
    page.shot("2_measuring")
    page.wait("Measuring the stapes: done")
    page.settle(4000)
    page.shot("3_measured")
    truth = json.loads((SAMPLE / "truth.json").read_text())["mass_kg"]
    mass = json.loads((folder / "scan_app/found/mass.json").read_text())
    sd = mass["mass_matrix"]["standard_deviation_si"][0][0]
    assert abs(mass["mass_kg"] - truth) < 3.0 * sd


def _labels(path):
    labels, grid = open_labels(path)
    return labels, grid


def _draw_and_undo(page, folder):
    found, grid = _labels(folder / "scan_app/found/labels.seg.nrrd")
    stapes = np.argwhere(found == 1)[:, ::-1]
    head = grid.scan_points(stapes[stapes[:, 2] > stapes[:, 2].max() - 12].mean(axis=0))
    page.press("2 Cut")
    page.press("3 Marks")
    coronal, axial = Tile(page, (0.3, 0.2)), Tile(page, (0.3, 0.8))
    page.click(axial.place(head))
    at = page.click(coronal.place(head))
    assert np.linalg.norm(at - head) < 0.05
    page.press("other bone")
    below = head - [0.0, 0.0, 0.15]
    across = np.array([0.5, 0.0, 0.0])
    page.drag(coronal.place(below - across), coronal.place(below + across))
    page.shot("4_stroke")
    drawn, _ = _labels(folder / "scan_app/labels.seg.nrrd")
    changed = grid.scan_points(np.argwhere(drawn != found)[:, ::-1])
    assert {*np.unique(drawn[drawn != found])} == {3}
    assert np.abs(changed[:, 2].mean() - below[2]) < 0.04
    assert np.abs(changed[:, 1].mean() - at[1]) < 0.04
    page.press("Measure again")
    page.wait("Measuring the corrected cut: done")
    page.settle(3000)
    page.shot("5_measured_again")
    masses = [
        json.loads((folder / f"scan_app/{name}/mass.json").read_text())["mass_kg"]
        for name in ("found", "cut")
    ]
    assert masses[1] < masses[0] - 1e-9
    page.press("/^stapes$/")
    above = head + np.array([0.0, 0.0, 0.3])
    page.drag(coronal.place(above - across), coronal.place(above + across))
    page.press("look")
    page.press("Undo")
    page.settle(1500)
    assert np.array_equal(_labels(folder / "scan_app/labels.seg.nrrd")[0], drawn)
    page.press("Undo")
    page.settle(1500)
    assert np.array_equal(_labels(folder / "scan_app/labels.seg.nrrd")[0], found)
    assert "labels" not in (folder / "scan.toml").read_text()
    page.press("Measure again")
    page.wait("measured already")
    page.shot("6_undone")


def _set_marks(page, folder):
    mass = json.loads((folder / "scan_app/found/mass.json").read_text())
    foot = np.array(mass["frames"]["scan_from_footplate"])
    anterior = foot[:3, 3] + [1.0, -0.1, 0.2]
    coronal, axial = Tile(page, (0.3, 0.2)), Tile(page, (0.3, 0.8))
    page.click(axial.place(anterior))
    page.click(coronal.place(anterior))
    at = page.click(axial.place(anterior))
    assert np.linalg.norm(at - anterior) < 0.06
    page.tab.get_by_label("the crosshair is at").locator("visible=true").first.select_option(label="anterior")
    page.press("Set mark")
    page.settle(1500)
    lines = (folder / "scan_app/landmarks.csv").read_text().splitlines()
    assert np.allclose([float(v) for v in lines[1].split(",")[1:]], at, atol=1e-3)
    page.shot("7_mark")


def _fit(page, folder):
    page.press("4 Measurement")
    page.press("Look at it")
    page.wait("Looking at the measurement: done")
    page.press("5 Fit")
    page.press("/^Fit$/")
    page.wait("Fitting stiffness and damping: done")
    page.settle(4000)
    page.shot("8_fit")
    assert page.tab.frames[-1].title() == "scan"  # the report, in the page
    page.write("leave out, Hz", "900-1000")
    page.wait("Made before the last change")
    page.write("leave out, Hz", "")
    assert "exclude_hz" not in (folder / "scan.toml").read_text()
    done = command_line("pipeline", "scan.toml", "--out", "again", folder=folder)
    assert done.returncode == 0, done.stderr
    ours, again = (json.loads((folder / name / "kd.json").read_text()) for name in ("scan_out", "again"))
    assert {key for key in ours if ours[key] != again[key]} <= {"provenance"}
