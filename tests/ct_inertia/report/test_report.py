"""The report of a mass matrix: what it must say, in words that an anatomist reads."""

from __future__ import annotations

import re

import numpy as np
import pytest

from legacy.ct_inertia.cli import work
from legacy.ct_inertia.report.segmentation_sections import evidence_rows
from legacy.ct_inertia.surface.surface import write_surface
from legacy.stapeskit.page.numbers import plus_minus
from legacy.stapeskit.page.quantities import MASS
from tests.ct_inertia.shapes import stapes

TOLD = {
    "levels": {
        "air": 2000.0,
        "bone": 20000.0,
        "plastic": 9000.0,
        "noise": 720.0,
        "air_sd": 1.0,
        "bone_sd": 4.0,
        "bone_from": "interior",
    },
    "psf_sigma_mm": 0.03,
    "voxel_size_mm": [0.025, 0.025, 0.025],
    "size_voxels": [200, 180, 240],
    "evidence": {
        "stapes": {"volume_mm3": 2.2, "extents_mm": [4.0, 2.6, 1.3], "holes": 1, "at_border": False},
        "other_bone": [{"volume_mm3": 3.9, "extents_mm": [4.2, 2.9, 1.4], "holes": None, "at_border": True}],
        "coarse_spacing_mm": [0.05, 0.05, 0.05],
        "material_levels": [2000.0, 9000.0, 20000.0],
        "bone_above": 14000.0,
        "separation": "connected component",
        "iso_level_share": 0.48,
        "psf_from": "edges of the stapes",
        "noise_correlation": 1.4,
        "air_clipped_share": 0.02,
    },
}


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    write_surface(folder / "s.ply", stapes(0.08))
    words = (
        f"{folder / 's.ply'} --mass-mg 3.0+-0.05 --density 1900+-60 --anterior 1,0,0 "
        f"--add-mass 0,2,0.4,0.2+-0.02 --faces 2000 --export stl,mjcf --out {folder / 'o'}"
    )
    outcome = work(words.split())[1]
    return (folder / "o" / "report.html").read_text(encoding="utf-8"), outcome.result


def cells(html, heading):
    """The table cells of one section."""
    section = html[html.index(f"<h2>{heading}</h2>") :].split("</section>")[0]
    return [re.sub(r"</?span[^>]*>", "", cell) for cell in re.findall(r"<td>(.*?)</td>", section)]


def test_sections_come_in_the_order_of_the_questions(page):
    headings = re.findall(r"<h2>(.*?)</h2>", page[0])
    assert headings == [
        "What was found",
        "Warnings",
        "Bodies and frames",
        "Mass matrix",
        "Uncertainty budget",
        "Ways to the mass",
        "Cross-check",
        "Inputs",
    ]


def test_the_ways_to_the_mass_stand_side_by_side(page):
    html, content = page
    found = cells(html, "Ways to the mass")
    (other,) = content["mass_alternatives"]
    sd = content["uncertainty"]["total"]["mass_kg"]
    assert plus_minus(MASS.of(content["mass_kg"]), MASS.of(sd)) in found
    assert f"{other['mass_change_percent']:+.2f}" in found
    assert "1900.0" in found
    matrix = np.array(other["matrix_change_percent"])
    assert f"{matrix[5, 5]:+.3f}" in found


def test_added_mass_display_surface_and_exports_are_told(page):
    html, content = page
    mass = f"{MASS.of(0.2e-6):g} ± {MASS.of(0.02e-6):g} {MASS.symbol}"
    assert f"{mass} at 0, 2, 0.4 (scan, mm)" in cells(html, "What was found")
    (step,) = content["display_mesh"]["steps"]
    told = cells(html, "Inputs")
    assert f"{step['mass_change_percent']:+.4f}" in told
    assert "mjcf" in told


def test_nothing_is_fetched_and_nothing_is_empty(page):
    assert not re.search(r"<script[^>]* src", page[0])
    assert not re.search(r'(src|href)="(?!data:|#)', page[0])
    assert "nan" not in re.sub(r"base64,[^\"]+", "", page[0]).lower().replace("nan-as-air", "")


def test_evidence_is_told_in_words():
    rows = dict(evidence_rows(TOLD))
    text = " ".join([*rows, *rows.values()])
    assert "_" not in text
    assert (
        rows["taken for the stapes (first look)"]
        == "2.20 mm³, 4.00 × 2.60 × 1.30 mm, one hole, whole within the scan"
    )
    assert "cut off by the border" in rows["other bone"]
    assert rows["blur of the scan"].startswith("30.0 µm (standard deviation, voxel included), 1.20 voxels")
    assert "4.0 % of the contrast" in rows["noise of one voxel"]
    assert rows["voxels of air cut off at the lowest value"] == "2 %"
    assert "lies air" in rows["parted from other bone"]


def test_evidence_of_a_kind_not_known_here_is_shown_all_the_same():
    told = TOLD | {
        "evidence": {**TOLD["evidence"], "necks": [{"radius_mm": 0.1}], "separation": "cut at a neck"}
    }
    rows = dict(evidence_rows(told))
    assert rows["necks 1: radius mm"] == "0.1"
    assert rows["parted from other bone"] == "Cut at a neck."
    assert evidence_rows({}) == []
