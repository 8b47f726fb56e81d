"""Scans that nobody here made: right or refused, never silently wrong.

Two seeds of every condition; benchmarks/population.py takes many, and docs/evidence.md tells what they gave.
"""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.population import row_named, score

VOXEL_UM = 38.0
SEEDS = (20, 21)


def scores(name, folder, seeds=SEEDS, **fixed):
    return [
        score(row_named(name), seed, folder, frames=False, **{"voxel_um": VOXEL_UM, **fixed})
        for seed in seeds
    ]


def errors(found):
    return np.array([s.error for s in found if s.error is not None])


@pytest.mark.parametrize("name", ["darker bone around", "darker bone, noise 0.5 %", "brighter bone around"])
def test_bone_of_another_density_around_the_stapes_leaves_its_volume(name, tmp_path):
    found = scores(name, tmp_path)
    assert not any(s.silent for s in found)
    assert len(errors(found)) == len(found)
    assert np.abs(errors(found)).max() < 0.004


def test_fluid_under_the_footplate_is_never_a_plate_that_is_known_well(tmp_path):
    found = scores("fluid, no window", tmp_path, SEEDS[:1])
    found += scores("fluid under the footplate", tmp_path, SEEDS[1:])
    assert not any(s.silent for s in found)
    assert all(s.error is None or s.sd < 0.04 for s in found)


def test_fluid_in_voids_is_subtracted_or_said_to_be_unseen(tmp_path):
    found = scores("fluid in voids", tmp_path, SEEDS[:1], voxel_um=24.0)
    found += scores("fluid in voids", tmp_path, SEEDS[1:])
    assert not any(s.silent for s in found)
    assert np.abs(errors(found)).max() < 0.03


def test_dry_voids_are_not_called_wet(tmp_path):
    found = scores("dry voids", tmp_path, voxel_um=24.0, noise=0.02)
    assert not any({"soft_surroundings", "void_filled", "void_filling_unknown"} & set(s.codes) for s in found)
    assert np.abs(errors(found)).max() < 0.003


@pytest.mark.parametrize(
    ("name", "code", "most"),
    [
        ("8 bit, begins above air", "air_clipped", 0.01),
        ("16 bit, begins above air", "air_clipped", 0.01),
        ("8 bit, ends below bone", "bone_clipped", 0.01),
        ("16 bit, ends at bone", "bone_clipped", 0.01),
        ("32 or 64 steps", "grey_steps_coarse", 0.06),
    ],
)
def test_what_storing_did_is_corrected_and_named(name, code, most, tmp_path):
    found = scores(name, tmp_path)
    assert not any(s.wrong for s in found)
    assert all(code in s.codes for s in found if s.error is not None)
    assert np.abs(errors(found)).max() < most


def test_a_wide_window_of_8_bits_needs_no_correction(tmp_path):
    found = scores("8 bit, wide window", tmp_path, noise=0.02)
    assert not any({"air_clipped", "bone_clipped"} & set(s.codes) for s in found)
    assert np.abs(errors(found)).max() < 0.004


def test_a_perforated_footplate_that_touches_its_window_keeps_both_halves_and_is_told(tmp_path):
    found = scores("perforated, narrow gap", tmp_path, voxel_um=35.0)
    assert all("stapes_uncertain" in s.codes for s in found)
    assert np.abs(errors(found)).max() < 0.004
    assert len(errors(found)) == len(found)


def test_the_blur_of_bone_across_a_narrow_gap_is_no_coat(tmp_path):
    fixed = {"voxel_um": 35.0, "gap_mm": 0.055, "blur": 1.3, "noise": 0.012, "correlation": 0.0}
    found = scores("alone", tmp_path, (24, 38), **fixed)
    assert not any({"coat_suspected", "blur_uneven"} & set(s.codes) for s in found)
    assert all(s.sd < 0.003 for s in found)


def test_the_wall_of_a_gutter_is_not_parted_from_its_crus(tmp_path):
    fixed = {"voxel_um": 35.0, "gap_mm": 0.055, "blur": 1.3, "noise": 0.012, "correlation": 0.0}
    (found,) = scores("alone", tmp_path, (31,), **fixed)
    assert found.error is not None
    assert abs(found.error) < 0.002


def test_a_scan_exported_with_a_gamma_is_named_and_its_effect_in_the_budget(tmp_path):
    found = scores("exported with a gamma of 0.7", tmp_path, voxel_um=28.0, noise=0.015, blur=1.3)
    assert all("grey_scale_bent" in s.codes for s in found)
    assert all(abs(s.error) < 2.0 * s.sd for s in found)
