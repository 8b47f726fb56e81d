"""Two ears, or two states of one ear: responses over each other, differences with their p-values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.cohort.ears import Ear, Quantity, quantities, read_ears
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import StapeskitError
from stapeskit.records.rigid_motion import RigidMotion
from stapeskit.report import page
from stapeskit.report.quantities import plus_minus

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from stapeskit.report.page import Page

FILES = ("compare.html", "compare.csv")


@dataclass(frozen=True)
class Difference:
    """A quantity of two ears.

    Attributes
    ----------
    quantity : Quantity
        With the values of the first and the second.
    difference, difference_sd : float
        Second minus first, SI; errors that both share (a density of the same statement) cancel.
    p_value : float
        Of no difference, two-sided.
    """

    quantity: Quantity
    difference: float
    difference_sd: float
    p_value: float

    def row(self) -> tuple[str, ...]:
        """Return name, first, second, difference, p."""
        of, unit = self.quantity, self.quantity.shown
        numbers = (*zip(of.values, of.sd, strict=True), (self.difference, self.difference_sd))
        texts = (plus_minus(float(unit.of(value)), float(unit.of(sd))) for value, sd in numbers)
        return (of.title_with_unit, *texts, f"{self.p_value:.2g}")

    def numbers(self) -> Mapping[str, Any]:
        """Return a row of compare.csv, SI."""
        (first, second), (first_sd, second_sd) = self.quantity.values, self.quantity.sd
        return {
            "quantity": self.quantity.name,
            "unit_si": self.quantity.unit,
            "first": first,
            "first_sd": first_sd,
            "second": second,
            "second_sd": second_sd,
            "difference": self.difference,
            "difference_sd": self.difference_sd,
            "p_value": self.p_value,
        }


@dataclass(frozen=True)
class Comparison:
    """Two finished studies."""

    ears: tuple[Ear, Ear]
    motions: tuple[RigidMotion | None, RigidMotion | None]
    differences: tuple[Difference, ...]

    def rows(self) -> list[tuple[str, ...]]:
        """Return a row a quantity: name, first, second, difference, p."""
        return [entry.row() for entry in self.differences]


def compare(first: Path, second: Path) -> Comparison:
    """Compare the results in two folders.

    Raises
    ------
    StapeskitError
        A folder holds no finished study, or the two have other degrees of freedom.
    """
    folders = Path(first), Path(second)
    one, other = read_ears((folder, folder.resolve().name, {}) for folder in folders)
    if one.kd["dof"] != other.kd["dof"]:
        got = f"{', '.join(one.kd['dof'])} and {', '.join(other.kd['dof'])}"
        raise StapeskitError.of("degrees of freedom", "the same in both results", got)
    rows = (row for row in quantities([one, other]) if np.all(np.isfinite(row.values)))
    return Comparison((one, other), (_motion(folders[0]), _motion(folders[1])), tuple(map(_difference, rows)))


def _motion(folder: Path) -> RigidMotion | None:
    from stapeskit.records.motion import read_motion

    return read_motion(folder / "dof.h5") if (folder / "dof.h5").is_file() else None


def _difference(row: Quantity) -> Difference:
    from scipy.special import ndtr

    sd = float(np.hypot(*np.where(np.isfinite(row.own_sd), row.own_sd, row.sd)))
    change = float(row.values[1] - row.values[0])
    return Difference(row, change, sd, float(2.0 * ndtr(-abs(change) / sd)) if sd > 0.0 else float("nan"))


def responses(ear: Ear, motion: RigidMotion) -> tuple[Array, ComplexArray]:
    """Return frequencies and the measured piston over the base's piston, (L,)."""
    run, y = 0, motion.dof.index("y")
    model = ear.kd.get("model") or {}
    names = model.get("structure", "stapes"), model.get("base", "base")
    structure, base = (motion.body(name) for name in names)
    return motion.freq_hz, motion.q[run, structure, :, y] / motion.q[run, base, :, y]


def compare_figure(comparison: Comparison) -> Figure:
    """Draw the piston response of both over each other: amplitude in dB and phase."""
    from stapeskit.report.figures import frequency_axis, panels, style

    with style():
        drawing, grid = panels(1, 2, height=3.0)
        amplitude, phase = grid.ravel()
        for ear, motion, colour in zip(
            comparison.ears, comparison.motions, ("#0b6e99", "#b3541e"), strict=True
        ):
            if motion is None or "y" not in motion.dof:
                continue
            freq, ratio = responses(ear, motion)
            amplitude.plot(freq, 20.0 * np.log10(np.abs(ratio)), color=colour, lw=1.4, label=ear.name)
            phase.plot(freq, np.degrees(np.unwrap(np.angle(ratio))), color=colour, lw=1.4)
            for axes in (amplitude, phase):
                frequency_axis(axes, freq)
        amplitude.set_ylabel("stapes over bone, y (dB)")
        phase.set_ylabel("phase (°)")
        if amplitude.lines:
            amplitude.legend(fontsize=8, frameon=False)
    return drawing


def compare_page(comparison: Comparison) -> Page:
    """Return the page of a comparison."""
    one, other = comparison.ears
    made = page.Page(f"{one.name} and {other.name}", "Two results side by side.")
    verdicts = [(ear.name, ear.verdict or "not stated") for ear in comparison.ears]
    made.add(page.table(("result", "verdict"), verdicts, words=True))
    head = ("quantity", one.name, other.name, "difference", "p")
    words = (
        "p of no difference, from the errors of each result alone: what both share (one stated density) "
        "cancels. No correction is made for the number of rows."
    )
    made.add(page.table(head, comparison.rows()), page.text(words))
    caption = "Piston motion of the stapes over that of the bone, as measured."
    made.add(page.figure(compare_figure(comparison), caption, "responses of both results"))
    return made


def write_comparison(
    comparison: Comparison, out: Path, inputs: Sequence[Path], force: bool = False
) -> list[Path]:
    """Write compare.html and a numeric compare.csv.

    Raises
    ------
    StapeskitError
        A file of another origin has one of these names, unless ``force``.
    """
    import pandas as pd

    from stapeskit.outputs import Outputs

    outputs = Outputs("stapeskit compare", out, FILES, inputs, force)
    with outputs.staged() as stage:
        compare_page(comparison).write(stage / FILES[0])
        rows = [entry.numbers() for entry in comparison.differences]
        pd.DataFrame(rows).to_csv(stage / FILES[1], index=False, lineterminator="\n")
    return list(outputs.paths())
