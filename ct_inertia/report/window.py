"""A window, or a view in a notebook, in which the stapes can be turned (pyvista)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from stapeskit.report.colours import AXIS_COLOURS, BODY_COLOURS

if TYPE_CHECKING:
    from ct_inertia.results import MassResult

_AXIS_MM = 1.4


def plotter_of(result: MassResult) -> Any:
    """Return a plotter of pyvista with the stapes, the plate and the axes of the footplate."""
    import pyvista as pv

    plotter: Any = pv.Plotter(title=result.title)
    plotter.add_mesh(result.stapes.mesh(), color=BODY_COLOURS["stapes"], smooth_shading=True, name="stapes")
    if result.plate is not None:
        plotter.add_mesh(result.plate.mesh(), color=BODY_COLOURS["plate"], opacity=0.4, name="plate")
    frame = result.footplate.scan_from_footplate
    for name, direction in zip("xyz", frame.rotation.T, strict=True):
        tip = frame.translation_mm + _AXIS_MM * direction
        arrow = pv.Arrow(start=frame.translation_mm, direction=direction, scale=_AXIS_MM)
        plotter.add_mesh(arrow, color=AXIS_COLOURS[name])
        plotter.add_point_labels(np.array([tip]), [name], text_color=AXIS_COLOURS[name], shape=None)
    plotter.view_vector(-frame.rotation[:, 1], frame.rotation[:, 2])
    return plotter


def show(result: MassResult) -> Any:
    """Show the stapes: in a window, or in the cell of a notebook."""
    return plotter_of(result).show()
