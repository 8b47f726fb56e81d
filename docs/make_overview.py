"""Draw docs/overview.png from a finished study: python docs/make_overview.py demo"""

from __future__ import annotations

import io
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
from matplotlib.figure import Figure

from ct_inertia.bodies import PLATE
from ct_inertia.report.colours import BODY_COLOURS
from ct_inertia.report.drawn_body import Body
from ct_inertia.report.pictures import render_views
from ct_inertia.surface.surface import read_surface
from fitting.kd import fit_kd
from fitting.report.responses import responses
from stapeskit.frames import RigidTransform
from stapeskit.records.mass_record import read_mass_record
from stapeskit.records.motion_files import read_motion

HERE = Path(__file__).parent


def main() -> None:
    """Put the stapes in its frames above the measured and simulated responses."""
    folder = Path(sys.argv[1])
    mass = read_mass_record(folder / "mass.json")
    fit = fit_kd(read_motion(folder / "dof.h5"), mass.mass_matrix)
    stapes, plate = (read_surface(folder / f"{name}.ply") for name in ("stapes", "plate"))
    plate_frame = RigidTransform(np.array(mass.raw["frames"]["scan_from_plate"]), "scan", "plate")
    picture, _ = render_views(
        [
            Body(stapes.vertices_mm, stapes.faces),
            Body(plate.vertices_mm, plate.faces, BODY_COLOURS[PLATE], 0.45, "plate", smooth=False),
        ],
        mass.scan_from_footplate,
        plate_frame,
        mass.raw["frames"].get("side"),
    )
    figure = Figure(figsize=(11.0, 7.4), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(1.35, 1.0))
    axes = upper.subplots()
    axes.imshow(matplotlib.image.imread(io.BytesIO(picture)), interpolation="lanczos")
    axes.axis("off")
    shown = responses(fit)
    for place, axis in enumerate(lower.subplots(1, 3)):
        draw(axis, shown, place)
    figure.savefig(HERE / "overview.png", dpi=110)


def draw(axis, shown, place: int) -> None:
    """Draw the amplitude of one degree of freedom."""
    name = shown.dof[place]
    scale, unit = (1e9, "nm") if name in "xyz" else (1e6, "µrad")
    here = shown.run == 0
    khz = shown.freq_hz[here] * 1e-3
    measured, simulated, base = (
        np.abs(part[here, place]) * scale for part in (shown.measured, shown.simulated, shown.base)
    )
    axis.semilogy(khz, measured, ".", color="#8a94a0", ms=3.5, label="measured")
    axis.semilogy(khz, simulated, color="#0b6e99", lw=1.6, label="simulated (Eq. 8)")
    axis.semilogy(khz, base, color="#c4562a", lw=0.8, label="bone")
    axis.set_title(f"{name} of the stapes", fontsize=10)
    axis.set_xlabel("frequency (kHz)")
    axis.set_ylabel(f"amplitude ({unit})")
    axis.grid(alpha=0.3)
    if place == 0:
        axis.legend(fontsize=8, frameon=False)


if __name__ == "__main__":
    main()
