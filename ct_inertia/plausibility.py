"""Whether what was measured can be a human stapes, by sizes far wider than those of real ones."""

from __future__ import annotations

from collections.abc import Sequence

from ct_inertia.errors import CtInertiaError
from ct_inertia.footplate import FootplateFrame
from kinematics.errors import sentence
from kinematics.notices import Notice

# Real ones: 2.9 to 3.9 mm high, footplate 2.4 to 3.4 by 1.1 to 1.7 mm, 0.9 to 2.6 mm3.
HEIGHT_MM = (2.4, 5.0)
FOOTPLATE_LENGTH_MM = (1.8, 4.0)
FOOTPLATE_WIDTH_MM = (0.7, 2.2)
VOLUME_MM3 = (0.3, 6.0)


def implausible(footplate: FootplateFrame, volume_mm3: float) -> list[str]:
    """Return every size that no human stapes has, with what it could be; empty when all can be.

    Parameters
    ----------
    footplate : FootplateFrame
    volume_mm3 : float
    """
    sizes = (
        ("a height", footplate.height_mm, HEIGHT_MM, "mm"),
        ("a footplate length", footplate.length_mm, FOOTPLATE_LENGTH_MM, "mm"),
        ("a footplate width", footplate.width_mm, FOOTPLATE_WIDTH_MM, "mm"),
        ("a volume", volume_mm3, VOLUME_MM3, "mm3"),
    )
    return [
        f"{name} of {value:.3g} {unit} ({low:g} to {high:g} is possible)"
        for name, value, (low, high), unit in sizes
        if not low <= value <= high
    ]


def unsuitable(found: Sequence[str], notices: Sequence[Notice]) -> CtInertiaError:
    """Return the refusal of a body that nobody named, with what the notices tell of the scan's border."""
    border = " ".join(notice.text for notice in notices if notice.code == "touches_border")
    step = (
        "Name the stapes with --seed X,Y,Z (a point inside it, scan mm) or --labels, leave other bone out "
        "with --box or --threshold, and check the voxel spacing"
    )
    fault = sentence(
        "the scan",
        "one with a body that can be a stapes",
        f"no object that can be a stapes: the likeliest has {', '.join(found)}",
        next_step=step,
    )
    return CtInertiaError(f"{fault} {border}".strip())


def size_notice(found: Sequence[str]) -> Notice:
    """Return the warning for a body that somebody named."""
    text = (
        f"The body has {', '.join(found)}: it cannot be a whole human stapes. Check what was measured in the "
        f"report, the voxel spacing, and the unit of a mesh."
    )
    return Notice("size_implausible", text)
