"""Draw docs/overview.png from a finished study: python tools/draw_overview.py demo"""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
from matplotlib.figure import Figure
from scipy.signal import savgol_filter

from legacy.ct_inertia.report.drawn_body import Body
from legacy.ct_inertia.report.pictures import Scene, render_scenes
from legacy.ct_inertia.surface.surface import read_surface
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.report.responses import responses
from legacy.stapeskit.frames import RigidTransform
from legacy.stapeskit.page.quantities import MASS, diagonal_unit
from legacy.stapeskit.records.mass_record import read_mass_record
from legacy.stapeskit.records.motion_files import read_motion
from legacy.stapeskit.spatial import DOF_NAMES

TARGET = Path(__file__).resolve().parents[1] / "docs" / "overview.png"
NAMES = {"y": "y, piston", "alpha": "alpha, about x", "gamma": "gamma, about z"}


def main() -> None:
    """Put the stapes and its results above the measured and fitted responses."""
    folder = Path(sys.argv[1])
    mass = read_mass_record(folder / "mass.json")
    fit = fit_kd(read_motion(folder / "dof.h5"), mass.mass_matrix)
    kd = json.loads((folder / "kd.json").read_text(encoding="utf-8"))
    figure = Figure(figsize=(11.0, 6.4), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(1.25, 1.0))
    picture, words = upper.subplots(1, 2, width_ratios=(1.9, 1.0))
    picture.imshow(matplotlib.image.imread(io.BytesIO(_stapes(folder, mass))), interpolation="lanczos")
    for axes in (picture, words):
        axes.axis("off")
    words.text(0.0, 0.94, "What comes out", fontsize=13, weight="bold", va="top")
    words.text(0.0, 0.80, "\n".join(_results(mass.raw, kd)), fontsize=12, va="top", linespacing=1.55)
    shown = responses(fit)
    curve = _smooth_response(shown, fit, mass.mass_matrix)
    for place, axes in enumerate(lower.subplots(1, 3)):
        _draw(axes, shown, curve, place)
    figure.savefig(TARGET, dpi=110)


def _stapes(folder: Path, mass) -> bytes:
    """Return a picture of the stapes and the plate in their frames; the view from the side is cut off."""
    stapes, plate = (read_surface(folder / f"{name}.ply") for name in ("stapes", "plate"))
    plate_frame = RigidTransform(np.array(mass.raw["frames"]["scan_from_plate"]), "scan", "plate")
    bodies = [
        Body(stapes.vertices_mm, stapes.faces),
        Body(plate.vertices_mm, plate.faces, "#9fb8c8", 0.45, "plate", smooth=False),
    ]
    scene = Scene(bodies, mass.scan_from_footplate, plate_frame, mass.raw["frames"].get("side"))
    (picture,) = render_scenes([scene])
    pixels = matplotlib.image.imread(io.BytesIO(picture))
    stream = io.BytesIO()
    matplotlib.image.imsave(stream, pixels[: pixels.shape[0] * 15 // 16, : pixels.shape[1] * 2 // 3])
    return stream.getvalue()


def _results(mass, kd) -> list[str]:
    sd = mass["mass_matrix"]["standard_deviation_si"][1][1]
    rows = [f"mass  {MASS.with_sd(mass['mass_kg'], sd)}"]
    for place, dof in enumerate(("y", "alpha", "gamma")):
        value, spread = (kd[f"stiffness{end}"][place][place] for end in ("_si", "_sd_si"))
        rows.append(f"K({dof})  {diagonal_unit('K', dof).with_sd(value, spread)}")
    modes = ", ".join(f"{mode['frequency_hz']:.0f}" for mode in kd["modes"])
    return [
        *rows,
        f"modes  {modes} Hz",
        "",
        f"simulated sample: K(y) is 1722 N/m, mass {MASS.text(3.2e-6, '.3f')}",
    ]


def _smooth_response(shown, fit, mass):
    """Return the fitted response to the motion of the bone without the noise of that motion."""
    omega = 2.0 * np.pi * shown.freq_hz[:, None, None]
    rows = np.array([DOF_NAMES.index(name) for name in shown.dof])
    restoring = fit.stiffness + 1j * omega * fit.damping
    transfer = np.linalg.solve(restoring - omega**2 * mass.matrix[np.ix_(rows, rows)], restoring)
    base = np.linalg.solve(transfer, shown.simulated[..., None])[..., 0]
    smooth = savgol_filter(base.real, 61, 2, axis=0) + 1j * savgol_filter(base.imag, 61, 2, axis=0)
    return (transfer @ smooth[..., None])[..., 0]


def _draw(axes, shown, curve, place: int) -> None:
    """Draw the amplitude of one degree of freedom: dots measured, the smooth line fitted."""
    name = shown.dof[place]
    scale, unit = (1e9, "nm") if name in "xyz" else (1e6, "µrad")
    here = shown.run == 0
    khz = shown.freq_hz[here] * 1e-3
    axes.semilogy(khz, np.abs(shown.measured[here, place]) * scale, ".", color="#6d7985", ms=4, zorder=1)
    smooth = curve[here, place]
    axes.semilogy(khz, np.abs(smooth) * scale, color="#0b6e99", lw=2.0, zorder=2)
    axes.set_title(NAMES.get(name, name), fontsize=11)
    axes.set_xlabel("frequency (kHz)")
    axes.set_ylabel(f"amplitude ({unit})")
    axes.grid(alpha=0.3)
    if place == 1:
        axes.text(0.97, 0.05, "dots: measured\nline: fitted", transform=axes.transAxes, ha="right")


if __name__ == "__main__":
    main()
