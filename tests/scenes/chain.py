"""Run a scene through the commands and hold what they write against the truth."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtri

from simulate import Truth, motion_of, render, simulate_study, write_labels
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.records.motion_file import read_motion, write_motion
from stapeskit.records.rigid_motion import RigidMotion
from stapeskit.spatial import dof_indices, parameters_from_matrix
from tests.scenes.scenes import Scene

COMMANDS = {"ct2mass": "ct_inertia.cli", "points2dof": "kinematics.cli", "dof2kd": "fitting.cli"}
# One scene in ten thousand that is right falls beyond this.
_LEVEL = 1e-4


@dataclass(frozen=True)
class Outcome:
    """What the commands found in a scene; None where they were not asked."""

    truth: Truth
    mass: dict[str, Any] | None = None
    motion: RigidMotion | None = None
    channels: Any = None
    kd: dict[str, Any] | None = None
    refused: str = ""

    def codes(self) -> dict[str, set[str]]:
        """Return the codes of the warnings that each command added."""
        mass = {notice["code"] for notice in (self.mass or {}).get("warnings", [])}
        motion = {notice.code for notice in self.motion.notices} if self.motion is not None else set()
        kd = {notice["code"] for notice in (self.kd or {}).get("warnings", [])}
        return {"ct2mass": mass, "points2dof": motion - mass, "dof2kd": kd - motion - mass}

    def stated(self) -> dict[str, list[float]]:
        """Return the stated standard deviations, relative to their values or scales."""
        found: dict[str, list[float]] = {}
        if self.mass is not None:
            sd = np.array(self.mass["mass_matrix"]["standard_deviation_si"])
            size = np.sqrt(np.diag(self.mass["mass_matrix"]["matrix_si"]))
            found["mass_matrix"] = (np.diag(sd) / size**2).tolist()
        if self.motion is not None:
            found["motion"] = _motion_sd(self.motion).tolist()
        if self.kd is not None:
            for name in ("stiffness", "damping"):
                value = np.abs(np.diag(self.kd[f"{name}_si"]))
                found[name] = (np.diag(np.array(self.kd[f"{name}_sd_si"], dtype=float)) / value).tolist()
        return found


def run(scene: Scene, folder: Path) -> Outcome:
    """Simulate a scene into a folder, run its commands, read what they wrote."""
    truth = simulate_study(scene.ear, scene.scan, scene.experiment, folder)
    mass = motion = channels = kd = None
    step = "ct2mass"
    try:
        if scene.scan is not None:
            study = _scan_words(scene, folder, truth)
            if scene.labels:
                study += ["--labels", str(write_labels(folder / f"labels{scene.labels}", truth.placed))]
            _command(
                "ct2mass", [*study, *scene.ct2mass.split(), "--no-report", "--out", str(folder / "mass")]
            )
            mass = json.loads((folder / "mass" / "mass.json").read_text())
        step = "points2dof"
        if scene.motion_is_given:
            assert truth.recording is not None
            registration = (0.0, 0.0) if scene.experiment and scene.experiment.exact else (1e-5, 2e-3)
            write_motion(folder, "dof", motion_of(truth.recording, registration_sd=registration))
        elif scene.experiment is not None:
            _command("points2dof", [*_measurement_words(scene, folder), "--out", str(folder / "dof.csv")])
            motion = read_motion(folder / "dof.h5")
            channels = folder / "dof.channels.csv"
        step = "dof2kd"
        if scene.fits:
            words = [str(folder / "dof.csv"), "--mass", str(_mass_file(scene, truth, folder))]
            _command("dof2kd", [*words, *scene.dof2kd.split(), "--out", str(folder / "kd.json")])
            kd = json.loads((folder / "kd.json").read_text())
    except StapeskitError as error:
        return Outcome(truth, mass, motion, channels, kd, f"{step}: {error}")
    finally:
        for path in folder.glob("scan*"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    return Outcome(truth, mass, motion, channels, kd)


def _command(name: str, words: list[str]) -> None:
    import_module(COMMANDS[name]).work([*words, "--quiet"])


def _scan_words(scene: Scene, folder: Path, truth: Truth) -> list[str]:
    """Return what the study states of its scan, beads included, as words of ct2mass."""
    import tomllib

    table = tomllib.loads((folder / "study.toml").read_text())["scan"]
    if scene.writer is not None:
        voxels = render(truth.placed, truth.scan)
        scene.writer(folder / scene.scan_file, voxels, spacing=truth.placed.voxel_mm)
    words = [str(folder / table.get("file", scene.scan_file))]
    for key, option in (("density_kg_m3", "density"), ("side", "side"), ("mirror", "mirror")):
        words += [f"--{option}", table[key]] if key in table else []
    for key, option in (("anterior", "anterior"), ("spacing_mm", "spacing")):
        words += [f"--{option}={','.join(map(str, table[key]))}"] if key in table else []
    for *place_mm, mass_kg in truth.ear.loose_masses:
        scan_mm = truth.scan_from_footplate.points(place_mm)
        words.append(
            f"--add-mass={','.join(f'{x:.6f}' for x in scan_mm)},{mass_kg * 1e6:.6f}+-{mass_kg * 4e4:.6f}"
        )
    return words


def _measurement_words(scene: Scene, folder: Path) -> list[str]:
    import tomllib

    table = tomllib.loads((folder / "study.toml").read_text())["ldv"]
    words = [str(folder / table["file"])]
    words += ["--points", str(folder / table["points"])] if "points" in table else []
    if "fiducials" in table and scene.scan is not None:
        words += [
            "--fiducials",
            str(folder / table["fiducials"]),
            "--mass",
            str(folder / "mass" / "mass.json"),
        ]
    return [*words, *scene.points2dof.split()]


def _mass_file(scene: Scene, truth: Truth, folder: Path) -> Path:
    """Return mass.json, or a plain table of the true mass matrix of all that moves."""
    if scene.scan is not None:
        return folder / "mass" / "mass.json"
    path = folder / "M.csv"
    np.savetxt(path, truth.ear.moving_mass_si(), delimiter=",", fmt="%.17g")
    return path


def _motion_sd(motion: RigidMotion) -> Array:
    """Return the median over all lines of the sd of each degree of freedom of the first body over its rms."""
    if motion.reference:
        n = len(motion.dof)
        variance = np.real(np.diagonal(motion.covariance, axis1=-2, axis2=-1))[..., :n] / 2.0
    else:
        variance = np.real(np.diagonal(motion.covariance[:, 0], axis1=-2, axis2=-1)) / 2.0
    size = np.sqrt(np.nanmean(np.abs(motion.q[:, 0]) ** 2, axis=(0, 1)))
    return np.asarray(np.nanmedian(np.sqrt(variance), axis=(0, 1)) / size)


def least_motion_sd(outcome: Outcome) -> Array:
    """Return what the true noise leaves to the motion, as `Outcome.stated` has it (Gauss-Markov).

    Where a file states no noise, an estimate of it scatters; a bar below this would ask for a sd too small.
    """
    assert outcome.truth.recording is not None
    return _motion_sd(motion_of(outcome.truth.recording))


def worst_parameter(outcome: Outcome) -> float:
    """Return the largest difference of an inertial parameter from the truth, in its standard deviation."""
    assert outcome.mass is not None
    block = outcome.mass["inertial_parameters"]
    true = parameters_from_matrix(outcome.truth.ear.moving_mass_si())
    sd = np.sqrt(np.diag(np.array(block["covariance_si"])))
    return float(np.max(np.abs(np.array(block["values_si"]) - true) / sd))


def fit_distance(outcome: Outcome) -> tuple[float, float]:
    """Return the squared Mahalanobis distance of K and D from the truth, and its limit."""
    assert outcome.kd is not None
    dof = outcome.truth.dof
    at = np.ix_(*[[dof.index(name) for name in outcome.kd["dof"]]] * 2)
    upper = np.triu_indices(len(outcome.kd["dof"]))
    difference = [
        (np.array(outcome.kd[key]) - true[at])[upper]
        for key, true in (
            ("stiffness_si", outcome.truth.stiffness_si),
            ("damping_si", outcome.truth.damping_si),
        )
    ]
    return distance_of(np.concatenate(difference), np.array(outcome.kd["covariance_si"], dtype=float))


def distance_of(difference: Array, covariance: Array) -> tuple[float, float]:
    """Return a squared Mahalanobis distance, and its limit."""
    size = np.sqrt(np.diag(covariance))
    roots, axes = np.linalg.eigh(covariance / np.outer(size, size))
    along = axes.T @ (difference / size)
    kept = roots > 1e-7
    return float(np.sum(along[kept] ** 2 / roots[kept])), float(chdtri(int(kept.sum()), _LEVEL))


def worst_motion(outcome: Outcome) -> float:
    """Return the largest difference of a motion from the truth, in standard deviations of all sources."""
    assert outcome.motion is not None
    return float(np.nanmax(np.abs(motion_errors(outcome.motion, outcome.truth))))


def motion_errors(motion: RigidMotion, truth: Truth) -> Array:
    """Return errors of real and imaginary parts over their sd of all sources, (2, run, body, freq, dof)."""
    true = np.stack([truth.motion_m[body] for body in motion.bodies], axis=1)[..., dof_indices(motion.dof)]
    if motion.reference:
        body, dof = motion.reference.split(":")
        unit = truth.motion_m[body][..., dof_indices((dof,))[0]]
        true = true / unit[:, None, :, None]
        diagonal = np.real(np.diagonal(motion.covariance, axis1=-2, axis2=-1)) / 2.0
        runs, lines, _ = diagonal.shape
        variance = diagonal.reshape(runs, lines, len(motion.bodies), -1).swapaxes(1, 2)
    else:
        variance = np.real(np.diagonal(motion.covariance, axis1=-2, axis2=-1)) / 2.0
    shared = np.zeros((2, *variance.shape))
    if motion.shared is not None:
        slopes = np.asarray(motion.shared.derivatives)
        parts = np.stack([slopes.real, slopes.imag])
        spread = motion.shared.covariance
        shared = np.einsum("kprbfd,pq,kqrbfd->krbfd", parts, spread, parts, optimize=True)
    error = motion.q - true
    floor = 1e-9 * np.sqrt(np.nanmean(np.abs(true) ** 2, axis=2, keepdims=True))
    return np.asarray(np.stack([error.real, error.imag]) / np.sqrt(variance + shared + floor**2))
