"""The scenes: what is run on which inputs. Every scene works in a new folder of its own.

``in/`` there are the recorded inputs, ``sample/`` is sample_volumes; outputs go to ``out``.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

ROOMS = ("ct", "points", "kd", "pipeline")
SPACED = "--spacing 0.07"
CT = "ct2mass {} --density 1900+-60 --no-report --out out"
FIDUCIALS = "--fiducials in/faults/none/fiducials.csv"


@dataclass(frozen=True)
class Scene:
    """One scene.

    Attributes
    ----------
    name : str
    room : str
        One of ROOMS.
    steps : tuple of str
        Command lines, split at blanks.
    prepare : callable, optional
        Writes further inputs into the scene's folder; returns arguments for each ``{}`` of the steps.
    """

    name: str
    room: str
    steps: tuple[str, ...]
    prepare: Callable[[Path], list[str]] | None = None


def write(files: dict[str, str]) -> Callable[[Path], list[str]]:
    """Return a preparation that writes small text files."""

    def prepare(folder: Path) -> list[str]:
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")
        return []

    return prepare


def known(ear: str) -> Callable[[Path], list[str]]:
    """Return a preparation that gives the true anterior direction and a point in the footplate."""

    def prepare(folder: Path) -> list[str]:
        told = json.loads((folder / "in" / ear / "known.json").read_text())
        return [",".join(f"{v:.3f}" for v in told[key]) for key in ("anterior", "in_the_footplate_mm")]

    return prepare


def shape(folder: Path) -> list[str]:
    """Return the size of the scan of the formats."""
    return [(folder / "in" / "formats" / "shape.txt").read_text()]


def spoiled(source: str, name: str, old: str, new: str) -> Callable[[Path], list[str]]:
    """Return a preparation that copies a text file with one change."""

    def prepare(folder: Path) -> list[str]:
        text = (folder / source).read_text(encoding="utf-8")
        if old not in text:
            raise ValueError(f"{source} must hold {old}")
        (folder / name).write_text(text.replace(old, new, 1), encoding="utf-8")
        return []

    return prepare


def bad_images(folder: Path) -> list[str]:
    """Write images that are no scans."""
    import numpy as np
    import tifffile

    grey = np.arange(30 * 32 * 34, dtype=np.uint16).reshape(30, 32, 34)
    tifffile.imwrite(folder / "flat.tif", grey[0])
    tifffile.imwrite(folder / "constant.tif", np.full((40, 40, 40), 500, np.uint16), photometric="minisblack")
    tifffile.imwrite(folder / "colour.tif", np.zeros((4, 30, 30, 3), np.uint8), photometric="rgb")
    whole = (folder / "in" / "formats" / "itk.nrrd").read_bytes()
    (folder / "short.nrrd").write_bytes(whole[: len(whole) // 2])
    return []


def _ct() -> list[Scene]:
    def ct(name: str, scan: str, more: str = "", prepare: Callable[[Path], list[str]] | None = None) -> Scene:
        return Scene(name, "ct", (f"{CT.format(scan)} {more}",), prepare)

    def one(name: str, line: str, prepare: Callable[[Path], list[str]] | None = None) -> Scene:
        return Scene(name, "ct", (f"ct2mass {line} --no-report --out out",), prepare)

    formats = {
        "tiff_imagej": "imagej.tif",
        "tiff_ome": "ome.ome.tif",
        "nrrd": "itk.nrrd",
        "nrrd_packed": "packed.nrrd",
        "mha": "itk.mha",
        "mhd": "itk.mhd",
        "nifti": "scan.nii",
        "dicom": "dicom",
        "isq": "scan.isq",
        "aim": "scan.aim",
        "aim30": "scan30.aim",
        "vgi": "scan.vgi",
        "amira": "scan.am",
        "zarr5": "scan.zarr",
        "zarr4": "scan2.zarr",
        "skyscan": "skyscan",
    }
    calibration = "points = [[8000, 0], [30000, 1382.4]]\nsd_kg_m3 = 20\n"
    hydroxyapatite = (
        "points_mg_ha_cm3 = [[8000, 0], [15000, 500], [30000, 1600]]\nkg_m3_at_zero = 1000\n"
        "kg_m3_per_mg_ha_cm3 = 0.6\n"
    )
    return [
        *(ct(f"ct_format_{name}", f"in/formats/{file}") for name, file in formats.items()),
        ct("ct_format_slices", "in/formats/slices", SPACED),
        ct(
            "ct_format_raw",
            "in/formats/scan.raw",
            f"{SPACED} --shape {{}} --dtype int16 --byte-order little --header-bytes 77",
            shape,
        ),
        ct("ct_labels", "in/formats/itk.nrrd", "--labels in/formats/labels.nrrd"),
        one("ct_labels_alone", "--labels in/formats/labels.nrrd --density 1900+-60"),
        ct("ct_whole", "in/whole/scan.tif", "--anterior {} --side left", known("whole")),
        ct("ct_no_hints", "in/whole/scan.tif"),
        ct(
            "ct_threshold_seed_box",
            "in/whole/scan.tif",
            "--threshold 19000 --side right --anterior {} --seed {} --box 0.5,0.5,0.5,5.9,5.2,7",
            known("whole"),
        ),
        ct("ct_landmarks", "in/whole/scan.tif", "--landmarks in/whole/landmarks.csv --side left"),
        ct("ct_plate_fiducials", "in/whole/scan.tif", "--plate-fiducials in/whole/plate_fiducials.csv"),
        one(
            "ct_mass_and_calibration",
            "in/whole/scan.tif --mass-mg 3.2+-0.05 --calibration c.toml --density 1382+-14 "
            "--add-mass 3,3,3,0.1+-0.01",
            write({"c.toml": calibration}),
        ),
        one(
            "ct_calibration_graded",
            "in/graded/scan.tif --calibration c.toml --voxel-size-sd 0.2",
            write({"c.toml": hydroxyapatite}),
        ),
        ct("ct_unequal_voxels", "in/unequal/scan.tif", "--anterior {}", known("unequal")),
        ct("ct_spacing_given", "in/unequal/scan.tif", "--spacing 0.051,0.0459,0.0612"),
        ct("ct_mirror", "in/mirrored/scan.tif", "--mirror z"),
        ct("ct_gap_60_um", "in/gap/scan.tif"),
        ct("ct_bridges", "in/bridges/scan.tif"),
        ct("ct_incus", "in/incus/scan.tif"),
        ct("ct_border_dust", "in/border/scan.tif"),
        ct("ct_plate_cropped", "in/plate_cropped/scan.tif"),
        ct("ct_cupping", "in/cupping/scan.tif"),
        ct("ct_mesh_stl", "in/ear1/stapes.stl", "--anterior 1,0,0"),
        ct("ct_mesh_obj", "in/ear1/stapes.obj"),
        ct("ct_exports", "in/ear1/stapes.ply", "--export all --smooth 3 --faces 2000"),
        Scene("ct_report", "ct", ("ct2mass in/gap/scan.tif --density 1900 --out out",)),
    ]


def _ct_refusals() -> list[Scene]:
    def refused(name: str, line: str, prepare: Callable[[Path], list[str]] | None = None) -> Scene:
        return Scene(f"ct_refuses_{name}", "ct", (f"ct2mass {line} --no-report --out out",), prepare)

    return [
        refused("no_spacing", "in/formats/slices --density 1900"),
        refused("flat_image", "flat.tif --density 1900 --spacing 0.05", bad_images),
        refused("constant", "constant.tif --density 1900 --spacing 0.05", bad_images),
        refused("colour", "colour.tif --density 1900 --spacing 0.05", bad_images),
        refused("short_file", "short.nrrd --density 1900", bad_images),
        refused("open_mesh", "in/ear1/open.stl --density 1900"),
        refused("mirror_of_a_mesh", "in/ear1/stapes.obj --density 1900 --mirror x"),
        refused("no_density", "in/gap/scan.tif"),
        refused("missing_file", "nowhere.tif --density 1900"),
        refused("unknown_option", "in/gap/scan.tif --densty 1900 --sead 1,2,3"),
        refused("bad_value", "in/gap/scan.tif --density -5"),
        refused("coarse", "in/formats/itk.nrrd --density 1900 --spacing 0.7"),
        refused(
            "hints_contradict",
            "in/whole/scan.tif --density 1900 --landmarks in/whole/landmarks.csv --side left --anterior={}",
            _backwards,
        ),
    ]


def _backwards(folder: Path) -> list[str]:
    told = json.loads((folder / "in" / "whole" / "known.json").read_text())
    return [",".join(f"{-v:.3f}" for v in told["anterior"])]


def _points() -> list[Scene]:
    def points(name: str, line: str, prepare: Callable[[Path], list[str]] | None = None) -> Scene:
        return Scene(f"points_{name}", "points", (f"points2dof {line} --out out/dof.csv",), prepare)

    def at(kind: str) -> str:
        return f"in/faults/{kind}/ldv.csv --points in/faults/{kind}/points.csv {FIDUCIALS}"

    faults = ("gain", "sign", "direction", "position", "label_swap", "noise", "drift", "zeros", "conjugate")
    exports = "--points in/exports/points.csv"
    bodies = "--body stapes=1-8 --body base=9-14"
    places = "--points in/exports/places.csv --fiducials in/exports/fiducials.csv"
    surfaces = "in/surfaces/ldv.csv --points in/surfaces/points.csv --mass in/surfaces/mass.json"
    channels = "--channels in/series/channels.csv"
    turned = "--plate-points in/surfaces/plate.csv --bone-points in/surfaces/bone.csv"
    return [
        points("plain", at("none")),
        *(points(f"fault_{kind}", at(kind)) for kind in faults),
        points("huber", f"{at('noise')} --robust huber"),
        points("t4", f"{at('gain')} --robust t4"),
        points("reference", f"{at('none')} --reference base:y --reference-noise 0.01"),
        points("dof_subset", f"{at('none')} --dof y,alpha,gamma"),
        points("two_runs", "in/two_runs/ldv.csv --points in/two_runs/points.csv"),
        points("unit_nm", f"in/exports/re_nm.csv {places}"),
        points("unit_m_s2", f"in/exports/re_m_s2.csv {places}"),
        points("unit_rms_coherence", f"in/exports/amp_rms_mm_s.csv {places}"),
        points("uff_58b", f"in/exports/xyz.uff {exports}"),
        points("uff_text_15", f"in/exports/text15.uff {bodies} --n-avg 20"),
        points("uff_58b_2411", f"in/exports/binary2411.uff {bodies} --n-avg 20"),
        points("psv_fastscan", f"in/exports/xyz {bodies} --length-unit m"),
        points("psv_points", f"in/exports/points_text {bodies} --amplitude rms"),
        points("mat5", f"in/exports/scan.mat {bodies}"),
        points("mat73", f"in/exports/scan73.mat {bodies}"),
        points("hdf5", "in/exports/scan.h5"),
        points("series_periodic", f"in/series/periodic.npz {channels} --period 0.0625"),
        points("series_random", f"in/series/random.npz {channels} --averages 12 --frf-band 450-4800"),
        points("series_lpm", f"in/series/random.npz {channels} --frf lpm --frf-band 450-4800"),
        points("series_stepped", f"in/series/stepped.npz {channels} --steps in/series/steps.csv"),
        points("repeats_steady", "in/repeats/steady.csv"),
        points("repeats_creep", "in/repeats/creep.csv"),
        points("repeats_separate", "in/repeats/steady.csv --repeats separate"),
        points("levels", "in/repeats/level1.csv in/repeats/level2.csv"),
        points("fiducials_plate", f"{surfaces} --fiducials in/surfaces/fiducials.csv"),
        points(
            "surfaces_calibrate",
            f"{surfaces} {turned} --calibrate --axes-sd 0.5 --beam-sd 0.2 --gain-sd 0.5",
        ),
        points(
            "plate_and_fiducials",
            f"{surfaces} --plate-points in/surfaces/plate.csv --fiducials in/surfaces/fiducials.csv",
        ),
        points("frame_scan", f"{surfaces} --frame scan"),
        points(
            "mirror",
            "in/mirrored_ldv/ldv.csv --points in/mirrored_ldv/points.csv "
            "--fiducials in/mirrored_ldv/fiducials.csv --mirror z",
        ),
    ]


def _points_refusals() -> list[Scene]:
    def refused(name: str, line: str, prepare: Callable[[Path], list[str]] | None = None) -> Scene:
        return Scene(f"points_refuses_{name}", "points", (f"points2dof {line} --out out/dof.csv",), prepare)

    plain = "in/faults/none/ldv.csv"
    points = "--points in/faults/none/points.csv"
    return [
        refused("bad_number", f"bad.csv {points}", spoiled(plain, "bad.csv", ",400,", ",4oo,")),
        refused("no_column", f"bad.csv {points}", spoiled(plain, "bad.csv", "im_m_s", "imag")),
        refused("no_positions", plain),
        refused("mirrored", f"{plain} {points} {FIDUCIALS} --mirror z"),
        refused("frame_without_mass", f"{plain} {points} --frame scan"),
        refused("frame_and_fiducials", f"{plain} {points} {FIDUCIALS} --frame footplate"),
        refused("bad_choice", f"{plain} {points} --robust hubert"),
        refused("unknown_option", f"{plain} {points} --fiducial x.csv --robst t4"),
        refused(
            "bad_mass",
            f"{plain} {points} --mass bad.json",
            spoiled("in/motions/mass.json", "bad.json", '"stapeskit.mass/1"', '"other/1"'),
        ),
    ]


def _kd() -> list[Scene]:
    def kd(name: str, line: str, prepare: Callable[[Path], list[str]] | None = None) -> Scene:
        return Scene(f"kd_{name}", "kd", (f"dof2kd {line} --out out/kd.json",), prepare)

    paper = "in/motions/paper.csv --mass in/motions/M.csv"
    chain = "in/motions/dof.h5 --mass in/motions/mass.json"
    plan = (
        'dof = ["y", "alpha", "gamma"]\ndirections = ["y"]\nband_hz = [400, 5000]\nlines = 60\n'
        "noise_m_s = 2e-6\nbase_velocity_m_s = 6e-4\nrocking = 0.05\n"
    )
    places = (
        "structure_points_mm = [[1.2, 0.15, 0], [-1.2, 0.15, 0], [0.5, 0.15, 0.5], [0.1, 3.2, 0.2]]\n"
        "base_points_mm = [[2.5, 0.3, 0], [-2.5, 0.3, 0], [0, 0.3, 2], [0, 0.3, -2]]\n"
    )
    return [
        *(kd(f"{name}", f"{paper} --estimator {name}") for name in ("ml", "irls", "pinv", "constrained")),
        *(kd(f"chain_{name}", f"{chain} --estimator {name}") for name in ("ml", "irls", "pinv")),
        kd("constrained_psd",
           f"{paper} --estimator constrained --constraint psd --lower K11=100 --upper D11=1"),
        kd("constrained_chain", f"{chain} --estimator constrained"),
        kd("t4", f"{chain} --robust t4"),
        kd("hysteretic", "in/motions/hysteretic.csv --mass in/motions/M.csv --damping hysteretic"),
        kd("fractional", f"{paper} --damping fractional"),
        kd("compare", "in/motions/hysteretic.csv --mass in/motions/M.csv --damping compare"),
        kd("inplane_load", f"{chain} --inplane load"),
        kd("inplane_ignore", f"{chain} --inplane ignore"),
        kd("band_exclude", f"{chain} --band 500,4500 --exclude 1000-1200 --exclude 2000-2300 --bands 3"),
        kd("monte_carlo", f"{paper} --monte-carlo 200"),
        kd("exact", "in/motions/exact.csv --mass in/motions/M.csv"),
        kd("six_dof", "in/motions/six.h5 --mass in/motions/M6.csv --dof all"),
        kd("csv_alone", "dof.csv --mass in/motions/mass.json",
           spoiled("in/motions/dof.csv", "dof.csv", "", "")),
        kd("plan", "--plan plan.toml", write({"plan.toml": plan})),
        kd("plan_points", "--plan plan.toml", write({"plan.toml": plan + places})),
        kd("refuses_other_columns", "dof.csv --mass in/motions/mass.json",
           spoiled("in/motions/dof.csv", "dof.csv", "alpha_re_rad", "alpha_rad")),
        kd("refuses_other_axes", "in/motions/dof.csv --mass mass.json",
           spoiled("in/motions/mass.json", "mass.json", '"axes": "footplate"', '"axes": "plate"')),
        kd("refuses_no_mass", "in/motions/dof.csv"),
        kd("refuses_other_body", f"{chain} --structure incus"),
        kd("refuses_wrong_size", "in/motions/paper.csv --mass in/motions/M.csv --dof y,alpha"),
        kd("refuses_empty_band", f"{chain} --band 6000,7000"),
        kd("refuses_plan_key", "--plan plan.toml", write({"plan.toml": plan + "lnes = 3\n"})),
        Scene("kd_page_of_the_paper", "kd", ("page:paper_page out/paper.html",)),
        Scene("kd_page_of_the_beam", "kd", ("page:beam_page out/beam.html 2",)),
    ]  # fmt: skip


def _pipeline() -> list[Scene]:
    def study(name: str, line: str, prepare: Callable[[Path], list[str]] | None = None) -> Scene:
        return Scene(f"study_{name}", "pipeline", (f"scan2kd {line} --out out",), prepare)

    return [
        study("sample", "sample/study.toml"),
        study("small", "in/whole/study.toml"),
        Scene("study_twice", "pipeline", ("scan2kd in/ear1/study.toml --out out",) * 2),
        study("cohort", "in/ear1/study.toml in/ear2/study.toml"),
        Scene(
            "study_by_hand",
            "pipeline",
            (
                f"{CT.format('in/whole/scan.tif')} --anterior {{}} --side left",
                "points2dof in/whole/ldv.csv --points in/whole/points.csv --fiducials in/whole/fiducials.csv "
                "--mass out/mass.json --out out/dof.csv",
                "dof2kd out/dof.h5 --mass out/mass.json --out out/kd.json",
            ),
            known("whole"),
        ),
        study("refuses_key", "in/ear1/bad.toml", _bad_study("[fit]", "[fit]\nestimater = 'ml'")),
        study("refuses_missing_file", "in/ear1/bad.toml", _bad_study('"ldv.csv"', '"nowhere.csv"')),
        study("refuses_value", "in/ear1/bad.toml", _bad_study("[fit]", "[fit]\nestimator = 'best'")),
        study("refuses_nothing", ""),
    ]


def _bad_study(old: str, new: str) -> Callable[[Path], list[str]]:
    return spoiled("in/ear1/study.toml", "in/ear1/bad.toml", old, new)


SCENES = (*_ct(), *_ct_refusals(), *_points(), *_points_refusals(), *_kd(), *_pipeline())
