"""What `ct2mass` found: the value type."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from legacy.stapeskit.warnings import Notice

if TYPE_CHECKING:
    from legacy.ct_inertia.bodies import Bodies, PlateFrame
    from legacy.ct_inertia.frames.footplate import FootplateFrame
    from legacy.ct_inertia.frames.window_gap import WindowGap
    from legacy.ct_inertia.mass.mass_estimates import MassByWay
    from legacy.ct_inertia.mass.mass_properties import MassProperties
    from legacy.ct_inertia.options import MassOptions
    from legacy.ct_inertia.surface.moments import Moments
    from legacy.ct_inertia.surface.surface import Surface
    from legacy.stapeskit.input_changes import InputStates
    from legacy.stapeskit.records.mass_record import MassMatrix


@dataclass(frozen=True)
class MassMeasurement:
    """What `ct2mass` found.

    Attributes
    ----------
    options : MassOptions
    stapes : Surface
    plate : Surface or None
    moments, mesh_moments : Moments
        The ones used, and those of the surface.
    body : MassProperties
        In scan axes.
    footplate : FootplateFrame
    plate_frame : PlateFrame or None
    matrix : MassMatrix
        About the footplate centre in footplate axes.
    plate_matrix : MassMatrix or None
        About the footplate centre in plate axes.
    mesh_matrix : MassMatrix
        As ``matrix``, from the moments of the surface: a cross-check.
    bodies : Bodies or None
        The segmentation; None for a mesh.
    notices : tuple of Notice
    ways : tuple of MassByWay
        The mass matrix by every way to a mass that was given; the leading one, which is ``matrix``, first.
    inputs : InputStates or None
        The input files as they were when they were read.
    gap : WindowGap or None
        Between the footplate's rim and the bone around it, where the scan shows it.
    """

    options: MassOptions
    stapes: Surface
    plate: Surface | None
    moments: Moments
    mesh_moments: Moments
    body: MassProperties
    footplate: FootplateFrame
    plate_frame: PlateFrame | None
    matrix: MassMatrix
    plate_matrix: MassMatrix | None
    mesh_matrix: MassMatrix
    bodies: Bodies | None = None
    notices: tuple[Notice, ...] = field(default=())
    ways: tuple[MassByWay, ...] = ()
    inputs: InputStates | None = None
    gap: WindowGap | None = None
