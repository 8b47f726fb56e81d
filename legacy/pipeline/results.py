"""The result of `stapeskit.scan2kd`: a finished study that prints, draws and copies itself."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.pipeline.study import Study
from legacy.stapeskit.results import Result
from legacy.stapeskit.warnings import Notice

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame


@dataclass(frozen=True)
class StageRun:
    """How a stage came about: computed or reused, why, and which files are its outputs."""

    name: str
    reused: bool
    seconds: float
    reason: str
    outputs: tuple[str, ...] = ()


@dataclass(frozen=True, repr=False)
class StudyResult(Result):
    """A finished study.

    Attributes
    ----------
    name : str
        Its name, or the stem of its file.
    mass, kd : mapping
        Content of mass.json and kd.json.
    """

    study: Study
    name: str
    out: Path
    mass: Mapping[str, Any]
    kd: Mapping[str, Any]
    stages: tuple[StageRun, ...]
    files: tuple[Path, ...]
    notices: tuple[Notice, ...]

    @property
    def title(self) -> str:
        """What this is."""
        return f"Study {self.name}"

    def summary(self) -> Sequence[tuple[str, str]]:
        """Return mass, K, D and modes with their standard deviations, and the folder of the results."""
        from legacy.pipeline.report_summary import key_results

        return [*key_results(self.mass, self.kd), ("results", str(self.out))]

    def to_frame(self) -> DataFrame:
        """Return one row a quantity: quantity, value_si, standard_deviation_si."""
        import pandas as pd

        mass_sd = self.mass["mass_matrix"]["standard_deviation_si"][1][1]
        values = [("mass", self.mass["mass_kg"], mass_sd)]
        for letter, key in (("K", "stiffness"), ("D", "damping")):
            matrix, deviation = (np.array(self.kd[f"{key}{end}"], dtype=float) for end in ("_si", "_sd_si"))
            values += [
                (f"{letter}{i + 1}{j + 1}", matrix[i, j], deviation[i, j])
                for i, j in zip(*np.triu_indices(len(matrix)), strict=True)
            ]
        return pd.DataFrame(values, columns=["quantity", "value_si", "standard_deviation_si"])

    def plot(self) -> Figure:
        """Draw every entry of K and D with its 95 % interval, relative to the diagonals of its matrix."""
        from legacy.stapeskit.page.page import new_figure

        figure = new_figure(9.0, 3.6)
        for place, (letter, key) in enumerate((("K", "stiffness"), ("D", "damping"))):
            axes = figure.add_subplot(1, 2, place + 1)
            matrix, deviation = (np.array(self.kd[f"{key}{end}"], dtype=float) for end in ("_si", "_sd_si"))
            root = np.sqrt(np.abs(np.diag(matrix)))
            upper = np.triu_indices(len(matrix))
            scale = np.outer(root, root)[upper]
            names = [f"{letter}{i + 1}{j + 1}" for i, j in zip(*upper, strict=True)]
            axes.axhline(0.0, color="#b7c0ca", linewidth=0.8)
            axes.errorbar(
                names,
                matrix[upper] / scale,
                1.96 * deviation[upper] / scale,
                fmt="o",
                capsize=3,
                color="#0b6e99",
            )
            axes.set_ylabel(f"{letter}ij / sqrt|{letter}ii {letter}jj|")
        return figure

    def write(self, folder: Path | str, *, force: bool = False) -> tuple[Path, ...]:
        """Copy the results of the study into another folder."""
        from legacy.pipeline.stages import inputs_of
        from legacy.stapeskit.own_files import OutputSet

        names = tuple(path.relative_to(self.out).as_posix() for path in self.files)
        read = (*self.files, *inputs_of(self.study))
        outputs = OutputSet("scan2kd", Path(folder), names, read, force)
        outputs.check()
        with outputs.staged() as stage:
            for name in names:
                shutil.copyfile(self.out / name, stage / name)
        return tuple(outputs.folder / name for name in names)
