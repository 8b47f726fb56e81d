"""What a change of an ear does to the response of its stapes: fixation, loosening, an added mass.

The response is that of the footplate centre along y to a force along y there,

    G(w) = e_y^T (K + i w D - w^2 M)^-1 e_y   (paper, Eq. 8 with the base at rest),

and what is shown is the change of its size in dB. What both states share, such as one density, cancels.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting.draws import root_of
from fitting.entries import join, split
from fitting.laws import LAWS, DampingLaw
from fitting.unknowns import point
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.report.colours import OTHER_COLOURS
from stapeskit.spatial import dof_indices, matrix_from_parameters

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from pipeline.cohort.ears import Ear
    from stapeskit.report.page import Page

LIMIT_HZ = 3000.0
SENTENCE = (
    "This is the piston of the stapes alone: in a whole ear, with incus, drum and cochlea, it does not hold "
    "above about 3 kHz."
)
_FORMS = "K*FACTOR, D*FACTOR, or mass+MGmg@head (or @X,Y,Z in footplate axes, mm)"
_DRAWS = 400  # from the joint covariance of K and D: limits of an interval to a tenth of its width
_SHOWN_HZ = (500.0, 1000.0, 2000.0, 3000.0, 4000.0)
_HEAD_MM = 0.3  # of the height below the top that counts as the head
_POSITIVE = r"(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_NUMBER = rf"[-+]?{_POSITIVE}"


@dataclass(frozen=True)
class Change:
    """A change of an ear.

    Attributes
    ----------
    words : str
        As it was written.
    stiffness, damping : float
        Factors of K and D.
    mass_kg : float
        A point mass that is added.
    place_mm : ndarray, (3,), or None
        Where, in footplate axes; None: at the head.
    """

    words: str
    stiffness: float = 1.0
    damping: float = 1.0
    mass_kg: float = 0.0
    place_mm: Array | None = None


@dataclass(frozen=True)
class Effect:
    """What a change does.

    Attributes
    ----------
    ear : str
    change : Change
    freq_hz : ndarray, (L,)
    change_db, low_db, high_db : ndarray, (L,)
        Of the response, and the 95 % interval of K and D.
    """

    ear: str
    change: Change
    freq_hz: Array
    change_db: Array
    low_db: Array
    high_db: Array

    @property
    def name(self) -> str:
        """Ear and change."""
        return f"{self.ear}, {self.change.words}"

    def rows(self) -> list[tuple[str, str]]:
        """Return the change at some frequencies."""
        curves = (self.change_db, self.low_db, self.high_db)
        inside = [freq for freq in _SHOWN_HZ if self.freq_hz[0] <= freq <= self.freq_hz[-1]]
        found = []
        for freq in inside:
            value, low, high = (float(np.interp(freq, self.freq_hz, curve)) for curve in curves)
            found.append((f"at {freq:g} Hz", f"{value:+.1f} dB ({low:+.1f} to {high:+.1f})"))
        return found


def read_change(words: str) -> Change:
    """Read a change such as ``K*10``, ``D*2`` or ``mass+5mg@head``.

    Raises
    ------
    StapeskitError
        It is none of these.
    """
    text = words.replace(" ", "")
    factor = re.fullmatch(rf"([KD])\*({_POSITIVE})", text)
    added = re.fullmatch(rf"mass\+({_POSITIVE})mg@(head|{_NUMBER},{_NUMBER},{_NUMBER})", text)
    if factor is not None and float(factor[2]) > 0.0:
        size = float(factor[2])
        return Change(words, stiffness=size) if factor[1] == "K" else Change(words, damping=size)
    if added is not None and float(added[1]) > 0.0:
        place = None if added[2] == "head" else np.array([float(v) for v in added[2].split(",")])
        return Change(words, mass_kg=1e-6 * float(added[1]), place_mm=place)
    raise StapeskitError.of("--what-if", _FORMS, words, "", "For example K*10 or mass+5mg@head")


def effect(ear: Ear, folder: Path, change: Change) -> Effect:
    """Return what a change does to the response of a finished ear.

    Raises
    ------
    StapeskitError
        The piston y is none of its degrees of freedom; the head is asked for without stapes.ply.
    """
    dof = tuple(ear.kd["dof"])
    if "y" not in dof:
        raise StapeskitError.of("the degrees of freedom", "with y for --what-if", ", ".join(dof))
    mass, places = np.array(ear.kd["mass_matrix_si"], dtype=float), dof_indices(dof)
    heavier = mass
    if change.mass_kg:
        place = head_of(folder, ear.mass) if change.place_mm is None else change.place_mm
        added = matrix_from_parameters(point(1e-3 * place, change.mass_kg))
        heavier = mass + added[np.ix_(places, places)]
    model = ear.kd.get("model") or {}
    band = model.get("band_hz") or (200.0, 5000.0)
    freq = np.geomspace(min(200.0, float(band[0])), max(5000.0, float(band[1])), 200)
    omega = 2.0 * np.pi * freq
    loss, square, piston = (
        _law_of(model).factor(omega)[:, None, None],
        omega[:, None, None] ** 2,
        dof.index("y"),
    )

    def change_db(entries: Array) -> Array:
        stiffness, damping = split(entries, len(dof))
        before = stiffness + loss * damping - square * mass
        after = change.stiffness * stiffness + change.damping * loss * damping - square * heavier
        before, after = (np.linalg.inv(one)[:, piston, piston] for one in (before, after))
        return np.asarray(20.0 * np.log10(np.abs(after / before)))

    mean = join(np.array(ear.kd["stiffness_si"], dtype=float), np.array(ear.kd["damping_si"], dtype=float))
    normal = np.random.default_rng(1).standard_normal((_DRAWS, len(mean)))
    drawn = mean + normal @ root_of(np.array(ear.kd["covariance_si"], dtype=float)).T
    low, high = np.percentile([change_db(one) for one in drawn], (2.5, 97.5), axis=0)
    return Effect(ear.name, change, freq, change_db(mean), low, high)


def _law_of(model: Mapping[str, Any]) -> DampingLaw:
    """Return the damping law of the block ``model`` of a kd.json."""
    name = str(model.get("damping_law", "viscous"))
    time_s, exponent = model.get("relaxation_time_s"), model.get("damping_exponent", 1.0)
    return DampingLaw(name, float(time_s if LAWS[name].is_time and time_s is not None else exponent))


def head_of(folder: Path, mass: Mapping[str, Any]) -> Array:
    """Return the middle of the head, mm in footplate axes: the mean of the top of the surface.

    Raises
    ------
    StapeskitError
        There is no stapes.ply.
    """
    path = Path(folder) / "stapes.ply"
    if not path.is_file():
        step = "State the place in footplate axes: mass+5mg@0.2,3.2,0.1"
        raise StapeskitError.of("--what-if", "used beside the stapes.ply of the study", folder, "", step)
    from ct_inertia.surface.repair import read_mesh

    transform = np.linalg.inv(np.array(mass["frames"]["scan_from_footplate"]))
    points = read_mesh(path).vertices_mm @ transform[:3, :3].T + transform[:3, 3]
    top = points[points[:, 1] > points[:, 1].max() - _HEAD_MM]
    return np.asarray(top.mean(axis=0))


def what_if_figure(effects: Sequence[Effect]) -> Figure:
    """Draw the change of the response over frequency, with its interval."""
    from stapeskit.report.figures import frequency_axis, panels, style

    with style():
        drawing, grid = panels(1, 1, width=6.4, height=3.2)
        axes = grid[0, 0]
        for place, one in enumerate(effects):
            colour = OTHER_COLOURS[place % len(OTHER_COLOURS)]
            axes.plot(one.freq_hz, one.change_db, color=colour, label=one.name)
            axes.fill_between(one.freq_hz, one.low_db, one.high_db, color=colour, alpha=0.2, lw=0)
            frequency_axis(axes, one.freq_hz)
        axes.axvline(LIMIT_HZ, color="#9aa7b4", lw=0.8, ls="--")
        axes.set_ylabel("change of the response (dB)")
        axes.legend(fontsize=8)
    return drawing


def what_if_page(effects: Sequence[Effect]) -> Page:
    """Return the page of changes."""
    from stapeskit.report import page

    words = "Response of the footplate centre along y to a force along y there, from K, D and M of the fit."
    made = page.Page("What if", words)
    rows = [(one.name, *(text for _, text in one.rows())) for one in effects]
    head = ("change", *(place for place, _ in effects[0].rows()))
    made.add(page.table(head, rows, "In brackets the 95 % interval of K and D.", words=True))
    caption = "Shaded: the 95 % interval. Beyond the dashed line the piston alone does not hold."
    made.add(page.figure(what_if_figure(effects), caption, "change of the response", file="what_if"))
    made.add(page.text(SENTENCE))
    return made


def what_if_table(effects: Sequence[Effect]) -> DataFrame:
    """Return the changes over frequency, the rows of what_if.csv."""
    import pandas as pd

    parts = [
        pd.DataFrame({"ear": one.ear, "change": one.change.words, "freq_hz": one.freq_hz,
                      "change_db": one.change_db, "low_95_db": one.low_db, "high_95_db": one.high_db})
        for one in effects
    ]  # fmt: skip
    return pd.concat(parts)
