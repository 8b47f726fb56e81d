"""Two ears, or two states of one ear: responses over each other, differences with their p-values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.cohort.ears import Ear, Quantity, common_damping_exponent, quantities, read_ears
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.records.rigid_motion import RigidMotion
from stapeskit.report import page
from stapeskit.report.colours import OTHER_COLOURS
from stapeskit.report.quantities import plus_minus

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from stapeskit.report.page import Page

_COLOURS = OTHER_COLOURS[:2]  # of results: not those of stapes and base


@dataclass(frozen=True)
class Comparison:
    """Two finished studies."""

    ears: tuple[Ear, Ear]
    motions: tuple[RigidMotion | None, RigidMotion | None]
    quantities: tuple[Quantity, ...]  # what both have
    # (quantities, 3): second minus first, its sd, SI, and the two-sided p-value of no difference; errors that
    # both share (a density of the same statement) cancel
    differences: Array

    @property
    def remark(self) -> str:
        """What is not compared, and why; empty where everything is."""
        what = "D is not compared: the damping laws, or their exponents, differ, and with them its unit."
        return what if _laws_differ(*self.ears) else ""

    def rows(self) -> list[tuple[str, ...]]:
        """Return a row a quantity: name, first, second, difference, p."""
        rows = []
        for of, (change, sd, p) in zip(self.quantities, self.differences.tolist(), strict=True):
            pairs = (*zip(of.values.tolist(), of.sd.tolist(), strict=True), (change, sd))
            texts = (plus_minus(of.shown.of(value), of.shown.of(own)) for value, own in pairs)
            rows.append((of.title_with_unit, *texts, f"{p:.2g}"))
        return rows

    def to_frame(self) -> DataFrame:
        """Return the rows of compare.csv, SI."""
        import pandas as pd

        values, sds = ([getattr(of, name) for of in self.quantities] for name in ("values", "sd"))
        columns: dict[str, Any] = {
            "quantity": [of.name for of in self.quantities],
            "unit_si": [of.unit for of in self.quantities],
        }
        for place, name in enumerate(("first", "second")):
            columns |= {name: np.array(values)[:, place], f"{name}_sd": np.array(sds)[:, place]}
        names = ("difference", "difference_sd", "p_value")
        return pd.DataFrame(columns | dict(zip(names, self.differences.T, strict=True)))


def read_folders(folders: Sequence[Path]) -> list[Ear]:
    """Read finished studies, each named by its folder, or by its path where folders have one name.

    Raises
    ------
    StapeskitError
        A folder holds no finished study, or is given twice.
    """
    whole = [Path(folder).resolve() for folder in folders]
    if len(set(whole)) < len(whole):
        raise StapeskitError.of("the folders", "different ones", f"{folders[0]} twice")
    alike = len({folder.name for folder in whole}) < len(whole)
    return read_ears((folder, str(given) if alike else folder.name, {})
                     for folder, given in zip(whole, folders, strict=True))  # fmt: skip


def compare(first: Path, second: Path) -> Comparison:
    """Compare the results in two folders.

    Raises
    ------
    StapeskitError
        A folder holds no finished study, or the two have other degrees of freedom.
    """
    one, other = read_folders((first, second))
    if one.kd["dof"] != other.kd["dof"]:
        got = f"{', '.join(one.kd['dof'])} and {', '.join(other.kd['dof'])}"
        raise StapeskitError.of("degrees of freedom", "the same in both results", got)
    alike = not _laws_differ(one, other)
    both = tuple(
        row
        for row in quantities([one, other])
        if np.all(np.isfinite(row.values)) and (alike or not row.name.startswith("D_"))
    )
    differences = np.array([_difference(row) for row in both])
    return Comparison((one, other), (_motion(first), _motion(second)), both, differences)


def _laws_differ(one: Ear, other: Ear) -> bool:
    """Return whether the damping laws of two ears differ: then D has different units."""
    laws = {str((ear.kd.get("model") or {}).get("damping_law")) for ear in (one, other)}
    return len(laws) > 1 or common_damping_exponent([one, other]) is None


def _motion(folder: Path) -> RigidMotion | None:
    from stapeskit.records.motion_file import read_motion

    path = Path(folder) / "dof.h5"
    return read_motion(path) if path.is_file() else None


def _difference(row: Quantity) -> tuple[float, float, float]:
    from scipy.special import ndtr

    sd = float(np.hypot(*np.where(np.isfinite(row.own_sd), row.own_sd, row.sd)))
    change = float(row.values[1] - row.values[0])
    return change, sd, float(2.0 * ndtr(-abs(change) / sd)) if sd > 0.0 else float("nan")


def compare_figure(comparison: Comparison) -> Figure:
    """Draw the piston response of both over each other: amplitude in dB and phase."""
    from stapeskit.report.figures import frequency_axis, panels, style

    with style():
        drawing, grid = panels(1, 2, height=3.0)
        amplitude, phase = grid.ravel()
        for ear, motion, colour in zip(comparison.ears, comparison.motions, _COLOURS, strict=True):
            if motion is None or "y" not in motion.dof:
                continue
            model, y = ear.kd.get("model") or {}, motion.dof.index("y")
            bodies = (motion.body(model.get(role, name)) for role, name in
                      (("structure", "stapes"), ("base", "base")))  # fmt: skip
            structure, base = (motion.q[0, body, :, y] for body in bodies)
            ratio = structure / base
            amplitude.plot(motion.freq_hz, 20.0 * np.log10(np.abs(ratio)), color=colour, label=ear.name)
            phase.plot(motion.freq_hz, np.degrees(np.unwrap(np.angle(ratio))), color=colour)
            for axes in (amplitude, phase):
                frequency_axis(axes, motion.freq_hz)
        amplitude.set_ylabel("stapes over bone, y (dB)")
        phase.set_ylabel("phase (°)")
        if amplitude.lines:
            amplitude.legend(fontsize=8)
    return drawing


def compare_page(comparison: Comparison) -> Page:
    """Return the page of a comparison."""
    one, other = comparison.ears
    made = page.Page(f"{one.name} and {other.name}", "Two results side by side.")
    verdicts = [(ear.name, ear.verdict or "not stated") for ear in comparison.ears]
    made.add(page.table(("result", "verdict"), verdicts, words=True))
    head = ("quantity", one.name, other.name, "difference", "p")
    count = max(len(comparison.quantities), 1)
    words = (
        "± is one standard deviation. p of no difference, from the errors of each result alone: what both "
        f"share (one stated density) cancels. Of {count} rows one below {0.05 / count:.2g} is a finding "
        "(5 %, Bonferroni)."
    )
    made.add(page.table(head, comparison.rows()), page.text(f"{words} {comparison.remark}"))
    caption = "Piston motion of the stapes over that of the bone, as measured."
    made.add(page.figure(compare_figure(comparison), caption, "responses of both results"))
    return made


def write_comparison(found: Comparison, out: Path, inputs: Sequence[Path], force: bool = False) -> list[Path]:
    """Write compare.html and a numeric table, compare.csv.

    Raises
    ------
    StapeskitError
        A file of another origin has one of these names, unless ``force``.
    """
    from stapeskit.outputs import Outputs

    outputs = Outputs("stapeskit compare", out, ("compare.html", "compare.csv"), inputs, force)
    with outputs.staged() as stage:
        compare_page(found).write(stage / "compare.html")
        found.to_frame().to_csv(stage / "compare.csv", index=False, lineterminator="\n")
    return list(outputs.paths())
