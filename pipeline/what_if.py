"""What a change of an ear does to the response of its stapes: fixation, loosening, an added mass.

The response is that of the footplate centre along y to a force along y there,

    G(w) = e_y^T (K + i w D - w^2 M)^-1 e_y   (paper, Eq. 8 with the base at rest),

and what is shown is the change of its size in dB. What both states share, such as one density, cancels.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fitting.draws import root_of
from fitting.entries import join, split
from fitting.laws import LAWS, DampingLaw
from fitting.unknowns import point
from pipeline.cohort.ears import Ear
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.spatial import dof_indices, matrix_from_parameters

SENTENCE = (
    "This is the piston of the stapes alone: in a whole ear, with incus, drum and cochlea, it does not hold "
    "above about 3 kHz."
)
SHOWN_HZ = (500.0, 1000.0, 2000.0, 3000.0, 4000.0)
_FORMS = "K*FACTOR, D*FACTOR, or mass+MGmg@head (or @X,Y,Z in footplate axes, mm)"
_DRAWS = 400  # from the joint covariance of K and D: limits of an interval to a tenth of its width
_HEAD_MM = 0.3  # of the height below the top that counts as the head
_POSITIVE = r"(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_NUMBER = rf"[-+]?{_POSITIVE}"


@dataclass(frozen=True)
class Change:
    """A change of an ear."""

    words: str  # as it was written
    stiffness: float = 1.0  # factor of K
    damping: float = 1.0  # factor of D
    mass_kg: float = 0.0  # a point mass that is added
    place_mm: Array | None = None  # (3,): where, in footplate axes; none: at the head


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


def change_db(ear: Ear, folder: Path, change: Change, freq_hz: ArrayLike = SHOWN_HZ) -> Array:
    """Return the change of the response of a finished ear and its 95 % interval by K and D, (3, lines), dB.

    Raises
    ------
    StapeskitError
        The piston y is none of its degrees of freedom; the head is asked for without stapes.ply.
    """
    dof = tuple(ear.kd["dof"])
    if "y" not in dof:
        raise StapeskitError.of("the degrees of freedom", "with y for --what-if", ", ".join(dof))
    mass, places = np.array(ear.kd["mass_matrix_si"], dtype=float), dof_indices(dof)
    heavier, piston = mass, dof.index("y")
    if change.mass_kg:
        place = head_of(folder, ear.mass) if change.place_mm is None else change.place_mm
        added = matrix_from_parameters(point(1e-3 * place, change.mass_kg))
        heavier = mass + added[np.ix_(places, places)]
    omega = 2.0 * np.pi * np.asarray(freq_hz, dtype=float)
    square, loss = omega[:, None, None] ** 2, _law_of(ear.kd.get("model") or {}).factor(omega)[:, None, None]

    def in_db(entries: Array) -> Array:
        stiffness, damping = split(entries, len(dof))
        before = stiffness + loss * damping - square * mass
        after = change.stiffness * stiffness + change.damping * loss * damping - square * heavier
        before, after = (np.linalg.inv(one)[:, piston, piston] for one in (before, after))
        return np.asarray(20.0 * np.log10(np.abs(after / before)))

    mean = join(np.array(ear.kd["stiffness_si"], dtype=float), np.array(ear.kd["damping_si"], dtype=float))
    normal = np.random.default_rng(1).standard_normal((_DRAWS, len(mean)))
    drawn = mean + normal @ root_of(np.array(ear.kd["covariance_si"], dtype=float)).T
    ends = np.percentile([in_db(one) for one in drawn], (2.5, 97.5), axis=0)
    return np.array([in_db(mean), *ends])


def effect_rows(ear: Ear, folder: Path, change: Change) -> list[tuple[str, str]]:
    """Return the rows that the command prints of a change."""
    found = zip(SHOWN_HZ, *change_db(ear, folder, change).tolist(), strict=True)
    return [
        (f"{ear.name}, {change.words}, at {hz:g} Hz", f"{value:+.1f} dB ({low:+.1f} to {high:+.1f})")
        for hz, value, low, high in found
    ]


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
