"""The result of `stapeskit.points2dof`: a motion that prints, draws and writes itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from kinematics.faults.search import Diagnosis
from kinematics.faults.verdicts import ChannelVerdict, write_channels
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import Measurement
from kinematics.place.errors import ErrorEstimate
from kinematics.place.placement import Placement
from kinematics.place.points_on_bone import SurfaceCheck
from kinematics.place.surfaces import Surface
from kinematics.repeats import RepeatedRun
from stapeskit.outputs import Outputs
from stapeskit.records.mass_record import MassRecord
from stapeskit.records.motion_file import motion_table, write_motion, write_motion_mat
from stapeskit.records.rigid_motion import RigidMotion
from stapeskit.results import Result
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

ENDINGS = (".csv", ".h5", ".channels.csv", ".html")
NEXT_TO_MASS = ("stapes.ply", "plate.ply", "labels.seg.nrrd")


@dataclass(frozen=True, repr=False, kw_only=True)
class MotionResult(Result):
    """Motion of rigid bodies about the footplate centre, in footplate axes.

    Attributes
    ----------
    motion : RigidMotion
        With covariance, shared errors and all notices.
    measurement : Measurement
        In the footplate frame, as fitted.
    fits, diagnoses : mapping
        By (run, body), and by body.
    checks : tuple of SurfaceCheck
        Measured points against the surfaces of the scan.
    errors : ErrorEstimate or None
        Of lasers and positions; with ``--calibrate`` of axes and beams, too.
    files : tuple of Path
        Every file that was read; `write` never replaces one of them.
    taken : mapping of str to Path
        By role: files that were found beside the measurement.
    """

    motion: RigidMotion
    measurement: Measurement
    placement: Placement
    channels: tuple[ChannelVerdict, ...]
    fits: Mapping[tuple[int, int], LineFit]
    diagnoses: Mapping[int, Diagnosis]
    checks: tuple[SurfaceCheck, ...] = ()
    errors: ErrorEstimate | None = None
    repeats: tuple[RepeatedRun, ...] = ()
    mass: MassRecord | None = None
    surfaces: Mapping[str, Surface] = field(default_factory=dict)
    files: tuple[Path, ...] = ()
    taken: Mapping[str, Path] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """What this is."""
        return f"Motion of {', '.join(self.motion.bodies[:6])} about the footplate centre"

    @property
    def notices(self) -> tuple[Notice, ...]:
        """Every warning."""
        return self.motion.notices

    def summary(self) -> Sequence[tuple[str, str]]:
        """Return files taken, degrees of freedom, lines, fit of every body, verdicts and registration."""
        from kinematics.report.tables import summary_rows

        return summary_rows(self)

    def to_frame(self) -> DataFrame:
        """Return the rows and columns of dof.csv, one row a run, body and frequency."""
        return motion_table(self.motion)

    def plot(self) -> Figure:
        """Draw amplitude and phase of every degree of freedom over frequency."""
        from kinematics.report.figures import spectra_figure

        return spectra_figure(self.motion)

    def write(
        self,
        folder: Path | str,
        *,
        force: bool = False,
        name: str = "dof.csv",
        export: Sequence[str] = (),
    ) -> tuple[Path, ...]:
        """Write dof.csv, dof.h5, dof.channels.csv and dof.html into a folder and return their paths.

        Parameters
        ----------
        name : str
            Of the table of the motion; the others are named after it.
        export : sequence of str
            Further files, out of `kinematics.options.EXPORTS`: ``mat`` writes dof.mat.

        Raises
        ------
        StapeskitError
            An output is an input, or a file of another origin has its name.
        """
        outputs = output_set(Path(folder) / name, self.files, force, export)
        with outputs.staged() as stage:
            names = self.write_into(stage, name, export=export)
        return tuple(outputs.folder / one for one in names)

    def write_into(
        self, folder: Path, name: str = "dof.csv", report: bool = True, export: Sequence[str] = ()
    ) -> tuple[str, ...]:
        """Write the files into a folder whose outputs are handled elsewhere; return their names."""
        stem = Path(name).stem
        write_motion(folder, stem, self.motion)
        write_channels(folder / f"{stem}.channels.csv", self.channels)
        if report:
            from kinematics.report.page import motion_page

            motion_page(self).write(folder / f"{stem}.html")
        if "mat" in export:
            write_motion_mat(folder / f"{stem}.mat", self.motion)
        endings = (*(ENDINGS if report else ENDINGS[:-1]), *(f".{one}" for one in export))
        return tuple(f"{stem}{ending}" for ending in endings)


def output_set(out: Path, inputs: Sequence[Path], force: bool = False, export: Sequence[str] = ()) -> Outputs:
    """Return the files that are written for ``out``, X.csv, and those that are read.

    Surfaces and labels beside a mass.json are inputs, too.
    """
    scan = [path.parent / name for path in inputs if path.suffix == ".json" for name in NEXT_TO_MASS]
    names = [f"{out.stem}{ending}" for ending in (*ENDINGS, *(f".{one}" for one in export))]
    return Outputs("points2dof", out.parent, names, [*inputs, *scan], force)
