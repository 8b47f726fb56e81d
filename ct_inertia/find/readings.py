"""Possible readings of the grey levels: which level is bone, and the threshold of bone."""

from __future__ import annotations

from dataclasses import dataclass

from ct_inertia.calibrated import calibrated
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError

_ABOVE_PLASTIC = calibrated("choose.above_plastic")


@dataclass(frozen=True)
class Reading:
    """Grey levels of air, plastic (None: there is none) and bone, and the one above which a voxel is bone."""

    air: float
    plastic: float | None
    bone: float
    between: float

    @classmethod
    def of(cls, air: float, plastic: float | None, bone: float) -> Reading:
        """Choose the level between bone and what is darker: half way from air, but well above plastic."""
        middle = 0.5 * (air + bone)
        between = middle if plastic is None else max(middle, plastic + _ABOVE_PLASTIC * (bone - plastic))
        return cls(air, plastic, bone, between)

    @property
    def contrast(self) -> float:
        """Of bone over air."""
        return self.bone - self.air


def readings(levels: Array, threshold: float | None = None) -> list[Reading]:
    """Return the possible readings of the materials' levels, the brightest material as bone first.

    A material above half way from air to bone is bone of another density, or else a dense plate.

    Raises
    ------
    StapeskitError
        A threshold that lies beyond all levels.
    """
    air = float(levels[0])
    if threshold is not None:
        below, above = levels[levels < threshold], levels[levels >= threshold]
        if below.size == 0 or above.size == 0:
            raise StapeskitError.of(
                "--threshold",
                f"between the grey levels of air and bone ({levels[0]:.6g} and {levels[-1]:.6g})",
                f"{threshold:g}",
                next_step="Read the two levels off the viewer, or leave --threshold out",
            )
        plastic = float(below[-1]) if below.size > 1 else None
        return [Reading(float(below[0]), plastic, float(above[-1]), threshold)]
    tried = []
    for k in range(len(levels) - 1, 0, -1):
        bone, between = float(levels[k]), levels[1:k]
        light, dense = between[between <= 0.5 * (air + bone)], between[between > 0.5 * (air + bone)]
        plastics = [float(light[-1]) if light.size else None, *map(float, dense)]
        tried += [Reading.of(air, plastic, bone) for plastic in plastics]
    return tried
