"""The conditions of the population of scans: what each draws, and which warnings name its cause."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

_CLOSED = ("base", "asymmetric", "thick", "curved", "mirrored", "gutter", "focus")


@dataclass(frozen=True)
class Row:
    """A condition: its name, what it draws, its families, and the warnings that name its cause.

    ``assumption`` is the warning that states the cause and the size of its effect in every result.
    """

    name: str
    ask: Callable[[np.random.Generator], dict[str, Any]]
    families: tuple[str, ...] = _CLOSED
    codes: tuple[str, ...] = ()
    assumption: str = ""
    size: float = 1.0
    seeded: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)


_THIN_OR_OPEN = ("thin", "hollow", "perforated", "flat thin", "filled", "single")
_SOFT, _VOID = ("soft_surroundings",), ("void_filled", "void_filling_unknown")
_LOW, _HIGH = ("air_clipped",), ("bone_clipped",)


def _gap(r: np.random.Generator) -> float:
    return float(r.uniform(0.08, 0.15))


ROWS = (
    Row("alone", lambda _: {}),
    Row("alone, thin, hollow or open", lambda _: {}, _THIN_OR_OPEN),
    Row("over a plate", lambda r: {"plate": r.uniform(0.15, 0.45)}),
    Row("in its window", lambda r: {"gap_mm": _gap(r), "plate": r.choice((None, 0.3))}),
    Row("window and incus", lambda r: {"gap_mm": _gap(r), "incus_mm": _gap(r)}),
    Row("perforated, narrow gap", lambda r: {"gap_mm": float(r.uniform(0.04, 0.08))}, ("perforated",)),
    Row("darker bone around", lambda r: {"gap_mm": _gap(r), "neighbour": r.uniform(0.75, 0.92)}),
    Row(
        "darker bone and incus",
        lambda r: {"gap_mm": _gap(r), "incus_mm": 0.1, "neighbour": r.uniform(0.75, 0.92)},
    ),
    Row(
        "darker bone, noise 0.5 %",
        lambda r: {"gap_mm": _gap(r), "neighbour": r.uniform(0.92, 0.98), "noise": 0.005},
    ),
    Row("brighter bone around", lambda r: {"gap_mm": _gap(r), "neighbour": r.uniform(1.08, 1.4)}),
    Row("8 bit, wide window", lambda _: {"steps": 256, "window": (-0.3, 1.5)}),
    Row(
        "8 bit, begins above air", lambda r: {"steps": 256, "window": (r.uniform(0.01, 0.1), 1.4)}, codes=_LOW
    ),
    Row("16 bit, begins above air", lambda r: {"window": (r.uniform(0.0, 0.05), 2.9)}, codes=_LOW),
    Row(
        "8 bit, ends below bone",
        lambda r: {"steps": 256, "window": (-0.3, r.uniform(0.94, 1.0))},
        codes=_HIGH,
    ),
    Row("16 bit, ends at bone", lambda r: {"window": (-0.4, r.uniform(0.96, 1.02))}, codes=_HIGH),
    Row(
        "32 or 64 steps",
        lambda r: {"steps": int(r.choice((32, 64))), "window": (-0.3, 1.5), "noise": r.uniform(0.005, 0.02)},
        codes=("grey_steps_coarse",),
    ),
    Row(
        "fluid under the footplate", lambda r: {"gap_mm": _gap(r), "fluid": r.uniform(0.15, 0.4)}, codes=_SOFT
    ),
    Row("fluid, no window", lambda r: {"fluid": r.uniform(0.15, 0.4)}, codes=_SOFT),
    Row(
        "incus cropped",
        lambda r: {"incus_mm": r.uniform(0.08, 0.12), "cropped_mm": r.uniform(0.04, 0.15)},
        codes=("touches_border",),
    ),
    Row(
        "incus cropped and close",
        lambda r: {"incus_mm": r.uniform(0.0, 0.06), "cropped_mm": r.uniform(0.08, 0.4)},
        codes=("incus_cropped", "separation_weak"),
    ),
    Row(
        "incus grown on and cropped",
        lambda r: {"incus_mm": -r.uniform(0.02, 0.06), "cropped_mm": r.uniform(0.08, 0.4)},
        codes=("incus_cropped", "separation_weak"),
    ),
    Row(
        "mucosa of 35 um",
        lambda _: {"coat": 0.15},
        codes=(*_SOFT, "coat_suspected"),
        assumption="bare_bone_assumed",
    ),
    Row("mucosa, stated", lambda _: {"coat": 0.15}, options={"coat_um": "35+-6", "coat_grey": "0.15+-0.03"}),
    Row("fluid in voids", lambda r: {"void": r.uniform(0.15, 0.35)}, ("hollow",), codes=_VOID),
    Row("dry voids", lambda _: {}, ("hollow",)),
    Row("rings", lambda _: {"rings": 0.02}, codes=("ring_artefacts",)),
    Row("motion along x", lambda _: {"motion": 1.6}, codes=("blur_uneven",)),
    Row("weak motion along x", lambda r: {"motion": r.uniform(0.4, 1.2)}, codes=("blur_uneven",)),
    Row("a jump half way", lambda r: {"jump": r.uniform(1.0, 3.0)}, codes=("blur_uneven",)),
    Row("phase fringes", lambda _: {"fringe": 0.6}, codes=("phase_fringes",)),
    Row("weak phase fringes", lambda r: {"fringe": r.uniform(0.1, 0.5)}, codes=("phase_fringes",)),
    Row(
        "exported with a gamma of 0.7",
        lambda _: {"gamma": 0.7},
        codes=("grey_scale_bent",),
        assumption="bare_bone_assumed",
    ),
    Row("noise of 5 to 20 %", lambda r: {"noise": r.uniform(0.05, 0.2), "window": (-1.2, 2.6)}),
    Row("large (1.3 x)", lambda _: {}, size=1.3),
    Row("large in its window", lambda _: {"gap_mm": 0.12}, size=1.3),
    Row("small (0.85 x), plate", lambda r: {"plate": r.uniform(0.2, 0.45)}, size=0.85),
    Row("with --seed", lambda r: {"gap_mm": _gap(r), "incus_mm": 0.1}, seeded=True),
)
