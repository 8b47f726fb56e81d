"""The sense of the footplate axes: from hints (side, anterior, landmarks), or the choice without any."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.frames import RigidTransform
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from ct_inertia.surface.surface import Surface

LANDMARK_NAMES = ("anterior", "posterior", "superior", "inferior", "head", "footplate_centre")
Z_IS = {"left": "superior", "right": "inferior"}
"""Where z of the footplate frame points by the side of the ear: x anterior, y lateral, z = x cross y."""

NO_HINT = "no hint: scan x"

# Chosen by judgement: points set by hand scatter by some hundredths of a millimetre, directions read off a
# viewer by some degrees.
_SQUARE_DEG, _WEAK_DEG = 87.0, 70.0  # angle to the long axis: refused, reported
_LEAST_OFFSET_MM = 0.1  # of a landmark from the centre, below which it says nothing
# Most distance from the bone: the width of the head; what tells a direction lies beside the stapes.
_HEAD_MM, _BESIDE_MM = 1.0, 3.0
_LEAST_HEAD_MM = 0.3  # least height of the head above the footplate
_CENTRE_MM = 1.0  # most distance of the landmark footplate_centre: a third of the footplate, beyond any slip
_LANDMARK_STEP = "Check the landmarks, their unit and coordinate system (LPS or RAS), or --mirror"


@dataclass(frozen=True)
class AnatomyHints:
    """Directions and points that a person gave, in scan coordinates.

    Attributes
    ----------
    anterior : ndarray, (3,), or None
        Unit direction towards anterior; only its sign against the long axis of the footplate is used.
    landmarks : mapping of str to ndarray, (3,)
        Points in mm by name; those of LANDMARK_NAMES are understood, others are ignored.
    side : str or None
        ``left`` or ``right``; defines superior and inferior, never changes geometry by itself.

    Raises
    ------
    StapeskitError
        Superior or inferior landmarks without a side when nothing else says where anterior is.
    """

    anterior: Array | None = None
    landmarks: Mapping[str, Array] = field(default_factory=dict)
    side: str | None = None

    def __post_init__(self) -> None:
        if self.anterior is not None:
            direction = np.asarray(self.anterior, dtype=float)
            direction = direction / np.max(np.abs(direction))  # its square may be no number
            object.__setattr__(self, "anterior", direction / np.linalg.norm(direction))
        sideways = {"superior", "inferior"} & self.landmarks.keys()
        lengthways = self.anterior is not None or {"anterior", "posterior"} & self.landmarks.keys()
        if sideways and self.side is None and not lengthways:
            step = "Add --side left or --side right, or an anterior landmark"
            thing = f"landmark {min(sideways)}"
            raise StapeskitError.of(
                thing, "given together with the side of the ear", "no side", next_step=step
            )


def orient_long_axis(
    hints: AnatomyHints, origin_mm: Array, x_axis: Array, y_axis: Array
) -> tuple[float, str, list[Notice]]:
    """Choose the sign of the long axis that points anterior.

    ``x_axis``, of either sign, and ``y_axis``, lateral, are unit vectors (3,) in scan axes. Returns +1 when
    the given axis points anterior, what decided, and notices.

    Raises
    ------
    StapeskitError
        Hints contradict each other, or one of them is nearly square to the axis that it tells of.

    Notes
    -----
    Without any hint +x is the sense with the positive component along scan x (ties: y, then z).
    """
    votes, notices = _votes(hints, origin_mm, x_axis, np.cross(x_axis, y_axis))
    if not votes:
        text = (
            "Nothing says where anterior is: +x of the footplate frame is the sense of its long axis with "
            "the positive component along scan x (ties: y, z). Give --anterior or an anterior landmark."
        )
        return _scan_sign(x_axis), NO_HINT, [*notices, Notice("anterior_not_given", text)]
    if len({sign for sign, _ in votes}) > 1:
        statements = "; ".join(f"{name} says {'+' if sign > 0 else '-'}" for sign, name in votes)
        step = "Correct the wrong one; a wrong --side or a mirrored scan (--mirror) can do this"
        expected = "of one mind about which end of the footplate is anterior"
        raise StapeskitError.of("the anatomical hints", expected, statements, next_step=step)
    return votes[0][0], ", ".join(name for _, name in votes), notices


def _scan_sign(axis: Array) -> float:
    return float(np.sign(next((component for component in axis if abs(component) > 1e-9), 1.0)))


def _votes(
    hints: AnatomyHints, origin_mm: Array, x_axis: Array, z_axis: Array
) -> tuple[list[tuple[float, str]], list[Notice]]:
    """Return sign of the long axis and source of every hint, and notices."""
    votes: list[tuple[float, str]] = []
    notices: list[Notice] = []
    if hints.anterior is not None:
        angle = float(np.degrees(np.arccos(np.clip(abs(hints.anterior @ x_axis), 0.0, 1.0))))
        if angle > _SQUARE_DEG:
            axis = ", ".join(f"{value:.3f}" for value in x_axis)
            expected = f"within {_SQUARE_DEG:.0f} degrees of the long axis of the footplate"
            step = "Give the direction from the posterior to the anterior end of the footplate"
            got = f"{angle:.0f} degrees (long axis {axis} in scan axes)"
            raise StapeskitError.of("--anterior", expected, got, next_step=step)
        if angle > _WEAK_DEG:
            text = f"--anterior is {angle:.0f} degrees off the long axis of the footplate; its sign is weak."
            notices.append(Notice("anterior_weak", text))
        votes.append((float(np.sign(hints.anterior @ x_axis)), "--anterior"))
    up = {"left": 1.0, "right": -1.0}.get(hints.side or "")
    senses = {"anterior": 1.0, "posterior": -1.0, "superior": up, "inferior": None if up is None else -up}
    for name, sense in senses.items():
        point = hints.landmarks.get(name)
        if point is None:
            continue
        if sense is None:
            text = f"Landmark {name} is not used: it needs --side left or --side right."
            notices.append(Notice("file_read", text))
            continue
        offset = float((point - origin_mm) @ (x_axis if name in ("anterior", "posterior") else z_axis))
        if abs(offset) < _LEAST_OFFSET_MM:
            expected = f"at least {_LEAST_OFFSET_MM} mm off the footplate centre along the axis it tells of"
            step = "Place it at the rim of the footplate"
            raise StapeskitError.of(f"landmark {name}", expected, f"{offset:+.3f} mm", next_step=step)
        votes.append((float(np.sign(offset)) * sense, f"landmark {name}"))
    return votes, notices


def check_places(surface: Surface, hints: AnatomyHints) -> None:
    """Refuse landmarks that lie on or beside no bone of this body.

    Raises
    ------
    StapeskitError
        The head lies more than 1 mm off the surface, another one of LANDMARK_NAMES more than 3 mm.
    """
    faults = []
    for name in sorted(hints.landmarks.keys() & set(LANDMARK_NAMES)):
        most = _HEAD_MM if name == "head" else _BESIDE_MM
        away = float(np.min(np.linalg.norm(surface.centres_mm - hints.landmarks[name], axis=1)))
        if away > most:
            expected = f"within {most:g} mm of the surface of the stapes"
            faults.append(Fault(f"landmark {name}", expected, f"{away:.2f} mm", "", _LANDMARK_STEP))
    raise_all(faults)


def contradiction(origin_mm: Array, axes: Array, hints: AnatomyHints) -> Fault | None:
    """Return how landmarks contradict a footplate at an origin (3,) with axes (3, 3) in columns, or None."""
    head = hints.landmarks.get("head")
    height = np.inf if head is None else float((head - origin_mm) @ axes[:, 1])
    if height < _LEAST_HEAD_MM:
        expected = f"on the lateral side of the footplate, at least {_LEAST_HEAD_MM:g} mm above its centre"
        got = f"{height:.2f} mm along the found lateral direction"
        return Fault("landmark head", expected, got, "", _LANDMARK_STEP)
    centre = hints.landmarks.get("footplate_centre")
    distance = 0.0 if centre is None else float(np.linalg.norm(centre - origin_mm))
    if distance > _CENTRE_MM:
        expected = f"within {_CENTRE_MM:g} mm of the found footplate centre"
        return Fault("landmark footplate_centre", expected, f"{distance:.2f} mm", "", _LANDMARK_STEP)
    return None


def directions(side: str | None, anterior_known: bool) -> dict[str, str]:
    """Name the ends of the footplate axes, ``+x`` to ``-z``; x and z only where anterior is known."""
    names = {"+y": "lateral", "-y": "medial"}
    if anterior_known:
        names |= {"+x": "anterior", "-x": "posterior"}
        if side in Z_IS:
            up = Z_IS[side]
            names |= {"+z": up, "-z": "inferior" if up == "superior" else "superior"}
    return names


def in_array_words(direction: Array, grid: Array) -> str:
    """Say where a direction (3,) in scan axes points on the voxel array, by the axes it is nearest to.

    ``grid`` (3, 3) holds the directions of the array's x, y, z axes in scan coordinates, in columns.
    """
    along = direction @ grid
    words = ("x (columns)", "y (rows)", "z (slices)")
    strong = [k for k in np.argsort(-np.abs(along)) if abs(along[k]) > 0.35]
    return ", ".join(f"{'rising' if along[k] > 0.0 else 'falling'} {words[k]}" for k in strong)


def option_for(direction: Array) -> str:
    """Return a direction (3,) as the option ``--anterior``, to be pasted."""
    return "--anterior=" + ",".join(f"{value + 0.0:.2f}" for value in direction)


def anterior_words(frame: RigidTransform, grid: Array | None, anterior_from: str) -> tuple[str, str]:
    """Say where anterior was taken to be, and the option to paste for the other choice.

    ``frame`` is scan_from_footplate; ``grid`` (3, 3): see `in_array_words`, None for a mesh.
    """
    x_axis = frame.rotation[:, 0]
    scan = ", ".join(f"{value:+.2f}" for value in x_axis)
    words = f"along {scan} in scan axes (x, y, z)"
    if grid is not None:
        words += f": {in_array_words(x_axis, grid)} of the voxel array"
    source = "assumed, nothing says so" if anterior_from == NO_HINT else f"by {anterior_from.lstrip('-')}"
    return f"{words}; {source}", option_for(-x_axis)
