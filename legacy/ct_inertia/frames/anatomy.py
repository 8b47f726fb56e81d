"""What a person knows about the ear: side, anterior direction, landmarks; it orients the found axes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from legacy.ct_inertia.errors import CtInertiaError
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

LANDMARK_NAMES = ("anterior", "posterior", "superior", "inferior", "head", "footplate_centre")
# Angle of a given direction to the long axis, degrees: refused above the first, for its sign is then within
# the error of a direction read off a viewer; reported as weak above the second. Chosen by judgement.
_SQUARE_DEG = 87.0
_WEAK_DEG = 70.0
# Distance of a landmark from the footplate centre below which its side is in doubt, mm. Chosen by judgement:
# points set by hand scatter by some hundredths of a millimetre.
_LEAST_OFFSET_MM = 0.1


@dataclass(frozen=True)
class AnatomyHints:
    """Directions and points that a person gave, in scan coordinates.

    Attributes
    ----------
    anterior : ndarray, (3,), or None
        Direction towards anterior; only its sign against the long axis of the footplate is used.
    landmarks : mapping of str to ndarray, (3,)
        Points in mm by name; the names of LANDMARK_NAMES are understood, others are ignored.
    side : str or None
        ``left`` or ``right``; defines superior and inferior, never changes geometry by itself.

    Raises
    ------
    CtInertiaError
        A zero direction, an unknown side, a landmark that is no point, or superior/inferior landmarks
        without a side when nothing else tells where anterior is.
    """

    anterior: Array | None = None
    landmarks: Mapping[str, Array] = field(default_factory=dict)
    side: str | None = None

    def __post_init__(self) -> None:
        if self.anterior is not None:
            direction = np.asarray(self.anterior, dtype=float)
            if direction.shape != (3,) or not np.all(np.isfinite(direction)) or not np.any(direction):
                raise CtInertiaError.of(
                    "{anterior}",
                    "a non-zero direction X,Y,Z in scan axes",
                    direction.tolist(),
                    next_step="Give the direction from posterior to anterior",
                )
            direction = direction / np.max(np.abs(direction))  # its square may be no number
            object.__setattr__(self, "anterior", direction / np.linalg.norm(direction))
        if self.side not in (None, "left", "right"):
            raise CtInertiaError.of(
                "{side}", "left or right", self.side, next_step="Give {side} left or {side} right"
            )
        points = {name: np.asarray(point, dtype=float) for name, point in self.landmarks.items()}
        for name, point in points.items():
            if point.shape != (3,) or not np.all(np.isfinite(point)):
                raise CtInertiaError.of(
                    f"landmark {name}",
                    "three finite numbers in mm",
                    point.tolist(),
                    next_step="Set the point again in the program it was placed in",
                )
        object.__setattr__(self, "landmarks", points)
        sideways = {"superior", "inferior"} & points.keys()
        lengthways = self.anterior is not None or bool({"anterior", "posterior"} & points.keys())
        if sideways and self.side is None and not lengthways:
            raise CtInertiaError.of(
                f"landmark {min(sideways)}",
                "given together with the side of the ear",
                "no side",
                next_step="Add {side} left or {side} right, or an anterior landmark",
            )


@dataclass(frozen=True)
class Orientation:
    """The sign of the long axis.

    Attributes
    ----------
    sign : float
        +1 when the given axis points anterior, -1 when it points posterior.
    evidence : str
        What decided.
    notices : tuple of Notice
    """

    sign: float
    evidence: str
    notices: tuple[Notice, ...] = ()


def orient_long_axis(hints: AnatomyHints, origin_mm: Array, x_axis: Array, y_axis: Array) -> Orientation:
    """Choose the sign of the long axis that points anterior.

    Parameters
    ----------
    hints : AnatomyHints
    origin_mm : ndarray, (3,)
        Footplate centre, scan coordinates.
    x_axis, y_axis : ndarray, (3,)
        Long axis of either sign, and the piston direction (lateral), unit vectors in scan axes.

    Raises
    ------
    CtInertiaError
        Hints contradict each other, or the only hint is nearly square to the long axis.

    Notes
    -----
    Without any hint +x is the sense with the positive component along scan x (ties: y, then z).
    x anterior, y lateral: z = x cross y is superior in a left ear and inferior in a right ear.
    """
    votes, notices = _votes(hints, origin_mm, x_axis, np.cross(x_axis, y_axis))
    if not votes:
        if any(notice.code == "landmark_unused" for notice in notices):
            raise CtInertiaError(
                "\n".join(notice.text for notice in notices if notice.code == "landmark_unused")
            )
        sign = _scan_sign(x_axis)
        text = (
            "Nothing says where anterior is: +x of the footplate frame is the sense of its long axis with "
            f"the positive component along scan x (ties: y, z). Give {named('anterior')} or an anterior "
            "landmark."
        )
        return Orientation(sign, "no hint: scan x", (*notices, Notice("anterior_not_given", text)))
    signs = {sign for sign, _ in votes}
    if len(signs) > 1:
        statements = "; ".join(f"{name} says {'+' if sign > 0 else '-'}" for sign, name in votes)
        raise CtInertiaError.of(
            "the anatomical hints",
            "of one mind about which end of the footplate is anterior",
            statements,
            next_step="Correct the wrong one; a wrong {side} or a mirrored scan ({mirror}) does this to "
            "superior and inferior",
        )
    return Orientation(votes[0][0], ", ".join(name for _, name in votes), tuple(notices))


def _scan_sign(axis: Array) -> float:
    for component in axis:
        if abs(component) > 1e-9:
            return 1.0 if component > 0.0 else -1.0
    return 1.0


def _votes(
    hints: AnatomyHints, origin_mm: Array, x_axis: Array, z_axis: Array
) -> tuple[list[tuple[float, str]], list[Notice]]:
    """Return (sign of the long axis, source) of every usable hint, and what could not be used."""
    votes: list[tuple[float, str]] = []
    notices: list[Notice] = []
    if hints.anterior is not None:
        angle = float(np.degrees(np.arccos(np.clip(abs(hints.anterior @ x_axis), 0.0, 1.0))))
        if angle > _SQUARE_DEG:
            raise CtInertiaError.of(
                "{anterior}",
                f"within {_SQUARE_DEG:.0f} degrees of the long axis of the footplate",
                f"{angle:.0f} degrees (long axis {_format_vector(x_axis)} in scan axes)",
                next_step="Give the direction from the posterior to the anterior end of the footplate",
            )
        if angle > _WEAK_DEG:
            text = (
                f"{named('anterior')} is {angle:.0f} degrees off the long axis of the footplate; "
                "its sign is weak."
            )
            notices.append(Notice("anterior_weak", text))
        votes.append((float(np.sign(hints.anterior @ x_axis)), named("anterior")))
    z_of_superior = {"left": 1.0, "right": -1.0}.get(hints.side or "")
    for name, axis, sense in (
        ("anterior", x_axis, 1.0),
        ("posterior", x_axis, -1.0),
        ("superior", z_axis, z_of_superior),
        ("inferior", z_axis, None if z_of_superior is None else -z_of_superior),
    ):
        point = hints.landmarks.get(name)
        if point is None:
            continue
        if sense is None:
            text = f"Landmark {name} is not used: it needs {named('side')} left or {named('side')} right."
            notices.append(Notice("side_not_given", text))
            continue
        offset = float((point - origin_mm) @ axis)
        if abs(offset) < _LEAST_OFFSET_MM:
            text = (
                f"landmark {name} must be at least {_LEAST_OFFSET_MM} mm off the footplate centre along the "
                f"axis it tells of; got {offset:+.3f} mm. Place it at the rim of the footplate."
            )
            notices.append(Notice("landmark_unused", text))
            continue
        votes.append((float(np.sign(offset)) * sense, f"landmark {name}"))
    return votes, notices


def _format_vector(vector: Array) -> str:
    return ", ".join(f"{value:.3f}" for value in vector)
