"""The result of `stapeskit.points2dof`: a motion that prints, draws and writes itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from legacy.kinematics.points2dof import Points2Dof
from legacy.stapeskit.results import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from legacy.kinematics.registration.scan_surfaces import ScanSurfaces
    from legacy.kinematics.report.stapes_surface import Scenery
    from legacy.stapeskit.records.mass_record import MassRecord


@dataclass(frozen=True, repr=False)
class MotionResult(Result, Points2Dof):
    """Motion of rigid bodies about the footplate centre, in footplate axes.

    Attributes
    ----------
    mass : MassRecord or None
        The frames that tied the measurement to the footplate.
    surfaces : ScanSurfaces or None
        The surfaces of that scan, for pictures.
    files : tuple of Path
        Every file that was read; `write` never replaces one of them.
    """

    mass: MassRecord | None = None
    surfaces: ScanSurfaces | None = None
    files: tuple[Path, ...] = field(default=())

    @property
    def scenery(self) -> Scenery | None:
        """The stapes to draw behind the points; None without a mass record."""
        from legacy.kinematics.report.stapes_surface import scenery_of_scan

        return None if self.mass is None else scenery_of_scan(self.mass, self.surfaces)

    @property
    def title(self) -> str:
        """What this is."""
        return f"Motion of {', '.join(self.motion.bodies[:6])} about the footplate centre"

    def summary(self) -> Sequence[tuple[str, str]]:
        """Return degrees of freedom, lines, fit of every body, verdicts and registration."""
        from legacy.kinematics.report.summary import summary_rows

        return summary_rows(self)

    def to_frame(self) -> DataFrame:
        """Return the rows and columns of dof.csv, one row a run, body and frequency."""
        import pandas as pd

        from legacy.stapeskit.records.motion import ROW_COLUMNS
        from legacy.stapeskit.records.motion_columns import MotionColumns
        from legacy.stapeskit.records.motion_files import standard_deviation

        motion = self.motion
        run, body, line = np.nonzero(np.isfinite(motion.q[..., 0].real))
        q, sd = motion.q[run, body, line], standard_deviation(motion)[run, body, line]
        parts = np.stack([q.real, q.imag], axis=-1).reshape(len(q), -1)
        names = MotionColumns(motion.dof, bool(motion.reference)).all
        numbers = np.hstack([motion.freq_hz[line, None], parts, sd])
        frame = pd.DataFrame(numbers, columns=names[2 : 2 + numbers.shape[1]])
        frame.insert(0, "run", np.array(motion.runs, dtype=object)[run])
        frame.insert(1, "body", np.array(motion.bodies, dtype=object)[body])
        for column in ROW_COLUMNS:
            frame[column.name] = column.of(motion)[run, body, line]
        return frame

    def plot(self) -> Figure:
        """Draw amplitude and phase of every degree of freedom over frequency."""
        from legacy.kinematics.report.draw_spectra import spectra_figure

        return spectra_figure(self.motion)

    def write(
        self, folder: Path | str, *, force: bool = False, name: str = "dof.csv", report: bool = True
    ) -> tuple[Path, ...]:
        """Write dof.csv, dof.h5, dof.channels.csv and, unless ``report`` is off, dof.html."""
        from legacy.kinematics.motion_outputs import output_set, write_outputs

        outputs = output_set(Path(folder) / name, self.files, None, force)
        outputs.check()
        with outputs.staged() as stage:
            names = write_outputs(stage, Path(name).stem, self, self.scenery, report)
        return tuple(outputs.folder / name for name in names)
