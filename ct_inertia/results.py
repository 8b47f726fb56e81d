"""The result of `stapeskit.ct2mass`: mass properties and frames that print, draw and write themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ct_inertia.frames.anatomy import anterior_words
from ct_inertia.options import ASSUMED_DENSITY, MassOptions
from ct_inertia.surface.surface import Surface
from stapeskit.arrays import Array
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.records.mass_record import MassRecord
from stapeskit.report.quantities import FIRST_MOMENT, INERTIA, LENGTH, MASS, VOLUME, ShownUnit
from stapeskit.results import Result
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from ct_inertia.bodies import MeasuredBody, Moments
    from ct_inertia.frames.footplate import FootplateFrame
    from ct_inertia.frames.gap import WindowGap
    from ct_inertia.frames.plate_frame import PlateFrame
    from ct_inertia.mass.ways import MassByWay
    from ct_inertia.report.pictured import Pictured
    from ct_inertia.scan.scan import Scan


@dataclass(frozen=True, repr=False, eq=False)
class MassResult(Result):
    """Mass matrix, frames and surfaces of a stapes.

    Attributes
    ----------
    matrix : MassMatrix
        About the footplate centre in footplate axes, added masses included.
    plate_frame : PlateFrame or None
    stapes : Surface
        With the moments that were measured; the mesh that was given.
    plate : Surface or None
    moments : Moments
        The numbers used: partial-volume integrals, or those of the mesh or the labelled voxels.
    ways : tuple of MassByWay
        Mass by every way that was given, the one that is used first.
    gap : WindowGap or None
        Between footplate and window.
    scan : Scan or None
        The scan, or the grid of labels; None for a mesh.
    body : MeasuredBody or None
        How the stapes was found and measured; None for a mesh.
    inputs : mapping of str to mapping
        Name, size, time and hash of every input by its role.
    """

    options: MassOptions
    matrix: MassMatrix
    footplate: FootplateFrame
    plate_frame: PlateFrame | None
    stapes: Surface
    plate: Surface | None
    moments: Moments
    ways: tuple[MassByWay, ...]
    gap: WindowGap | None = None
    scan: Scan | None = None
    body: MeasuredBody | None = None
    inputs: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    notices: tuple[Notice, ...] = ()

    @property
    def title(self) -> str:
        """What this is."""
        return f"Mass matrix of {self.options.source.name}"

    @property
    def lead(self) -> MassByWay:
        """The way to the mass that is used."""
        return self.ways[0]

    @property
    def record(self) -> MassRecord:
        """What other steps use of it."""
        plate = self.plate_frame
        return MassRecord(
            self.matrix,
            self.footplate.scan_from_footplate,
            self.footplate.covariance,
            None if plate is None else plate.scan_from_plate,
            None if plate is None else plate.covariance,
            self.lead.body.density_kg_m3,
            self.lead.body.volume_m3,
            self.notices,
        )

    @property
    def grid_directions(self) -> Array | None:
        """Directions (3, 3) of the voxel array in scan coordinates, in columns; None for a mesh."""
        return None if self.scan is None else self.scan.direction

    @property
    def anterior(self) -> tuple[str, str]:
        """Where anterior was taken to be, in words, and the option to paste for the other choice."""
        frame = self.footplate
        return anterior_words(frame.scan_from_footplate, self.grid_directions, frame.anterior_from)

    def summary(self) -> Sequence[tuple[str, str]]:
        """Return mass, centre, entries of the mass matrix, footplate and frames with their uncertainty."""
        body, footplate, matrix = self.lead.body, self.footplate, self.matrix
        sd = matrix.standard_deviation
        pose = np.sqrt(np.diag(footplate.covariance))
        assumed = any(notice.code == "density_assumed" for notice in self.notices)
        centre = matrix.parameters[1:4] / matrix.parameters[0]

        def entry(row: int, column: int, unit: ShownUnit) -> str:
            value = float(matrix.matrix[row, column])
            return (
                unit.with_sd(value, float(sd[row, column])) if self.lead.stated else unit.text(value, ".5g")
            )

        size = f"{footplate.length_mm:.2f} × {footplate.width_mm:.2f} mm; height {footplate.height_mm:.2f} mm"
        rows = [
            *(
                [("density", f"ASSUMED: {ASSUMED_DENSITY} kg/m³; --density, --mass-mg, --calibration")]
                if assumed
                else []
            ),
            ("volume", f"{VOLUME.text(body.volume_m3, '.4f')} at {body.density_kg_m3:.0f} kg/m³"),
            ("mass", entry(0, 0, MASS)),
            ("centre of mass (footplate)", _vector(LENGTH.of(centre))),
            ("M(alpha)", entry(3, 3, INERTIA)),
            ("M(gamma)", entry(5, 5, INERTIA)),
            ("M(y, alpha)", entry(1, 3, FIRST_MOMENT)),
            ("M(y, gamma)", entry(1, 5, FIRST_MOMENT)),
            *([] if self.lead.stated else [("sd of mass and M", f"not known: none of the {self.lead.way}")]),
            ("footplate", size),
            ("footplate centre (scan)", _vector(footplate.scan_from_footplate.translation_mm)),
            ("anterior", self.anterior[0]),
            ("for the other choice", self.anterior[1]),
            ("sd of the frame", f"{1e6 * max(pose[:3]):.1f} µm, {np.degrees(max(pose[3:])):.2f}°"),
        ]
        if self.plate_frame is not None:
            rows.append(("plate frame (scan)", _vector(self.plate_frame.scan_from_plate.translation_mm)))
        for way in self.ways[1:]:
            change = 100.0 * (way.body.mass_kg / body.mass_kg - 1.0)
            density = f"{way.body.density_kg_m3:.0f} kg/m³"
            rows.append(
                (
                    f"by {way.way} instead",
                    f"{MASS.text(way.body.mass_kg, '.4g')} ({change:+.1f} %), {density}",
                )
            )
        return rows

    @cached_property
    def _content(self) -> dict[str, Any]:
        from ct_inertia.exports.mass_json import mass_content

        return mass_content(self)

    def content(self) -> dict[str, Any]:
        """Return the content of mass.json."""
        return self._content

    def mass_record(self) -> MassRecord:
        """Return mass, frames and surfaces for the steps after this one, without a file."""
        from ct_inertia.exports.mass_json import mass_record_of

        return mass_record_of(self)

    def to_frame(self) -> DataFrame:
        """Return the entries of the mass matrix, one a row: row, column, value_si, standard_deviation_si."""
        import pandas as pd

        from stapeskit.spatial import DOF_NAMES

        sd = self.matrix.standard_deviation
        rows = [
            {
                "row": first,
                "column": second,
                "value_si": self.matrix.matrix[i, j],
                "standard_deviation_si": sd[i, j] if self.lead.stated else np.nan,
            }
            for i, first in enumerate(DOF_NAMES)
            for j, second in enumerate(DOF_NAMES)
            if i <= j
        ]
        return pd.DataFrame(rows)

    @property
    def pictured(self) -> Pictured:
        """Surfaces and slices that the report draws."""
        from ct_inertia.report.pictured import pictured_of

        return pictured_of(self)

    def plot(self) -> Figure:
        """Draw the medial side of the stapes with its directions."""
        from ct_inertia.report.pictures import medial_view

        return medial_view(self.content(), self.pictured)

    def show(self) -> Any:
        """Show the stapes and its frames in a window that can be turned, or in a notebook (pyvista)."""
        from ct_inertia.report.window import show

        return show(self)

    def write(self, folder: Path | str, *, force: bool = False, report: bool = True) -> tuple[Path, ...]:
        """Write mass.json, surfaces, labels and, unless ``report`` is off, report.html.

        ``force`` replaces files that are not known as written by ct2mass, but never inputs.

        Raises
        ------
        StapeskitError
            An output is an input, or a file of another origin has its name.
        """
        from ct_inertia.exports.write import outputs_of

        outputs, labels_name = outputs_of(self.options, Path(folder), report=report, force=force)
        with outputs.staged() as stage:
            names = self.write_into(stage, report=report, labels_name=labels_name)
        return tuple(Path(folder) / name for name in names)

    def write_into(
        self, stage: Path, *, report: bool = True, labels_name: str = "labels.seg.nrrd", **more: Any
    ) -> tuple[str, ...]:
        """Write every file into an empty folder and return their names; ``more`` as in `write_files`."""
        from ct_inertia.exports.write import write_files

        return write_files(self, stage, report=report, labels_name=labels_name, **more)


def _vector(values: Array) -> str:
    return ", ".join(f"{value:.4f}" for value in values) + " mm"
