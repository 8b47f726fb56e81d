"""Accuracy of ct2mass on difficult scans: noisy, thin-walled, touching the plate, uneven, with cupping.

    python benchmarks/ct_conditions.py [WORD ...]        only the rows whose names hold one of the words

Every scan is a file that sample_volumes/make_sample.py writes: a stapes in its oval window (gap 100 um) over
a plate, PSF 1.2 voxels, noise 4 % of the contrast between bone and air unless said; seeds are fixed. ct2mass
gets the file, the true mean density (or a calibration) and the sense of the long axis. M is compared about
the centre and in the axes that ct2mass finds. The table gives the largest error of an entry Mij as a share of
sqrt(Mii Mjj), and the largest stated standard deviation as the same share.
"Within" counts the entries off by less than 1.96 stated standard deviations.
Warnings that every such file has (handedness, signs of the plate's axes, no sd of the density) are left out.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

# Name, voxel size in um, options of make_sample, whether grey values are calibrated to density.
SCANS: tuple[tuple[str, float, tuple[str, ...], bool], ...] = (
    ("clean", 25, (), False),
    ("noise 10 %", 25, ("--noise", "0.10"), False),
    ("noise 20 %", 25, ("--noise", "0.20"), False),
    ("noise 10 %, blurred by 1 voxel", 25, ("--noise", "0.10", "--noise-correlation", "1"), False),
    ("noise 10 %", 40, ("--noise", "0.10"), False),
    ("crura as gutters, walls of 80 um", 20, ("--phantom", "gutter"), False),
    ("crura as gutters, walls of 80 um", 30, ("--phantom", "gutter"), False),
    ("crura as gutters, on the plate", 20, ("--phantom", "gutter", "--plate-gap-um", "0"), False),
    ("on the plate", 25, ("--plate-gap-um", "0"), False),
    ("on the plate", 40, ("--plate-gap-um", "0"), False),
    ("sunk 30 um into the plate", 25, ("--plate-gap-um", "-30"), False),
    ("density gradient 5 %, calibrated", 25, ("--gradient", "5"), True),
    ("density gradient 5 %, one density", 25, ("--gradient", "5"), False),
    ("cupping 5 %", 25, ("--cupping", "5"), False),
    ("cupping 3 %", 40, ("--cupping", "3"), False),
    ("cupping 5 %", 40, ("--cupping", "5"), False),
    ("cupping 10 %", 40, ("--cupping", "10"), False),
)
SEED = 7
_USUAL = ("handedness_unconfirmed", "plate_axis_sign", "density_sd_not_given", "calibration_sd_not_given")


def made(folder: Path, voxel_um: float, more: tuple[str, ...], seed: int = SEED) -> dict[str, Any]:
    """Write a scan into a folder and return the truth behind it."""
    from sample_volumes.old_study import main as make_sample

    words = ["--out", str(folder), "--only", "scan", "--gap-um", "100", "--seed", str(seed)]
    with contextlib.redirect_stdout(io.StringIO()):
        make_sample([*words, "--voxel-um", f"{voxel_um:g}", *more])
    behind: dict[str, Any] = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    return behind


def row(folder: Path, behind: dict[str, Any], calibrated: bool) -> str:
    """Return one line of the table behind name and voxel size."""
    from legacy.ct_inertia.ct2mass import ct2mass
    from legacy.ct_inertia.errors import CtInertiaError
    from legacy.ct_inertia.options import MassOptions

    calibration = folder / "calibration.toml" if calibrated else None
    long_axis = np.array(behind["scan_from_footplate"])[:3, 0]
    options = MassOptions(
        folder / "scan.tif",
        density=None if calibrated else (behind["mass_kg"] / behind["volume_m3"], None),
        calibration=calibration,
        anterior=(float(long_axis[0]), float(long_axis[1]), float(long_axis[2])),
    )
    try:
        result = ct2mass(options)
    except CtInertiaError as refusal:
        return f"refused: {str(refusal)[:90]} | | | | | | |"
    moments, exact = result.moments, behind["volume_m3"] * 1e9
    sd = np.sqrt(np.diag(sum(moments.contributions.values(), np.zeros((10, 10)))))
    body = sum(result.body.contributions.values(), np.zeros((10, 10)))
    sd_centre = np.sqrt(np.trace(body[1:4, 1:4])) / result.body.mass_kg * 1e6
    true = np.array(behind["mass_matrix_si"])
    root = np.sqrt(np.outer(np.diag(true), np.diag(true)))
    error, stated = result.matrix.matrix - true, result.matrix.standard_deviation
    upper = np.triu_indices(6)
    known = stated[upper] > 0.0
    within = np.count_nonzero(np.abs(error[upper][known]) < 1.96 * stated[upper][known])
    centre = np.linalg.norm(result.body.com_mm - np.array(behind["center_of_mass_in_scan_mm"])) * 1e3
    codes = ", ".join(notice.code for notice in result.notices if notice.code not in _USUAL) or "none"
    return (
        f"{100 * (moments.volume_mm3 / exact - 1):+.3f} % | {100 * sd[0] / exact:.3f} % | {centre:.2f} um | "
        f"{sd_centre:.2f} um | {100 * np.abs(error / root).max():.2f} % | "
        f"{100 * np.abs(stated / root).max():.2f} % | {within} of {np.count_nonzero(known)} | {codes} |"
    )


def main() -> None:
    """Print the table."""
    words = sys.argv[1:]
    heads = ("scan", "voxel", "volume", "sd", "centre", "sd", "M, worst", "stated sd", "within", "warnings")
    print(f"| {' | '.join(heads)} |")
    print("|-|-|-|-|-|-|-|-|-|-|")
    for name, voxel_um, more, calibrated in SCANS:
        if words and not any(word in name for word in words):
            continue
        with tempfile.TemporaryDirectory() as place:
            behind = made(Path(place), voxel_um, more)
            print(f"| {name} | {voxel_um:g} um | {row(Path(place), behind, calibrated)}", flush=True)


if __name__ == "__main__":
    main()
