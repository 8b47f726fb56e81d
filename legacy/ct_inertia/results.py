"""The result of `stapeskit.ct2mass`: measured mass properties that print, draw and write themselves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legacy.ct_inertia.ct2mass import MassMeasurement, ct2mass
from legacy.stapeskit.progress import Tell, silent
from legacy.stapeskit.results import Result, extend_result

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from legacy.ct_inertia.bodies import Bodies
    from legacy.ct_inertia.options import MassOptions
    from legacy.stapeskit.records.measured_mass import MeasuredMass


@dataclass(frozen=True, repr=False)
class MassResult(Result, MassMeasurement):
    """Mass matrix, frames and surfaces of a stapes.

    ``matrix`` holds the mass matrix about the footplate centre in footplate axes with its uncertainty,
    ``footplate`` and ``plate_frame`` the frames, ``stapes`` and ``plate`` the surfaces.
    """

    @property
    def title(self) -> str:
        """What this is."""
        source = self.options.scan or self.options.labels
        return f"Mass matrix of {Path(str(source)).name}"

    def summary(self) -> Sequence[tuple[str, str]]:
        """Return mass, centre, entries of the mass matrix, footplate and frames with their uncertainty."""
        from legacy.ct_inertia.report.summary import measured_rows

        return measured_rows(self)

    def measured_mass(self, content: Mapping[str, Any] | None = None) -> MeasuredMass:
        """Return mass, frames and surfaces for the steps after this one, without a file.

        Parameters
        ----------
        content : mapping, optional
            Of mass.json, when it was made before.
        """
        from legacy.ct_inertia.exports.measured_mass import measured_mass

        return measured_mass(self, content)

    def to_frame(self) -> DataFrame:
        """Return the entries of the mass matrix, one a row: row, column, value_si, standard_deviation_si."""
        import pandas as pd

        from legacy.stapeskit.spatial import DOF_NAMES

        deviation = self.matrix.standard_deviation
        return pd.DataFrame(
            [
                {
                    "row": first,
                    "column": second,
                    "value_si": self.matrix.matrix[i, j],
                    "standard_deviation_si": deviation[i, j],
                }
                for i, first in enumerate(DOF_NAMES)
                for j, second in enumerate(DOF_NAMES)
                if i <= j
            ]
        )

    def plot(self) -> Figure:
        """Draw the stapes from three sides along the footplate axes."""
        from legacy.ct_inertia.report.drawn_body import Body
        from legacy.ct_inertia.report.pictures import Scene, draw_scene

        frame = self.footplate.scan_from_footplate
        body = Body(self.stapes.vertices_mm, self.stapes.faces)
        anterior_known = bool(self.footplate.anterior_from)
        return draw_scene(Scene([body], frame, None, self.options.side, anterior_known))

    def write(self, folder: Path | str, *, force: bool = False, report: bool = True) -> tuple[Path, ...]:
        """Write mass.json, surfaces, labels and, unless ``report`` is off, report.html."""
        from legacy.ct_inertia.exports.output_files import labels_name, output_set
        from legacy.ct_inertia.exports.write_result import write_result

        target = Path(folder)
        outputs = output_set(self.options, target, report=report, force=force)
        outputs.check()
        labels = labels_name(target, self.options.labels)
        with outputs.staged() as stage:
            names, _, _ = write_result(self, outputs, stage, labels_file=labels, report=report)
        return tuple(target / name for name in names)


def mass_of(
    options: MassOptions, progress: Tell = silent, found: Callable[[Bodies], None] | None = None
) -> MassResult:
    """Measure the mass properties of a stapes; see `ct_inertia.ct2mass.ct2mass`."""
    measured = ct2mass(options, progress, found)
    return extend_result(MassResult, replace(measured, options=measured.options.anchored()))
