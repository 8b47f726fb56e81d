"""ct2mass is right on foreign stapedes and scans that it was not developed on, or it says so.

One row a condition; each scan draws a family of stapes (simulate.foreign), sizes, pose, voxel, blur and
noise. "Right": volume within 4 stated standard deviations, or 0.05 %. "Named": wrong, with a warning of the
condition's own or of an uncertain body; "assumed": wrong, where the result states the assumption that does
not hold; "silent": wrong without a word. Then, where right, error and stated standard deviation of the volume
and the shares of volume, entries of M and components of the footplate's pose within 1.96 stated standard
deviations; conditions that are right and whose volume is off by less than 0.1 % are listed below. Last,
how often the intervals of each component of the pose and entry of M hold, and by how much the stated
deviation exceeds the errors (median; 1 is right). 0.2 drew other scans of the same families, and also bone of
another density around, incus cropped by the view, and voids.

    python -m benchmarks.population --scans 6 --start 95000
    python -m benchmarks.population --scans 2 --word window
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._masses import Measured, measure
from benchmarks._table import NOTHING, arguments, percent, print_table, root_mean_square
from simulate import Ear, Scan, Stapes

CLOSED = ("base", "asymmetric", "thick", "curved", "gutter", "focus")
OPEN = ("thin", "hollow", "perforated", "flat thin", "filled", "single")
UNCERTAIN = "stapes_uncertain"
CLOSE = 1e-3
"""Conditions whose volume errs by less are named together: a tenth of what the best density leaves."""
Draw = np.random.Generator
AIR, BONE = 8000.0, 30000.0


def grey(contrast: float) -> float:
    """Return the grey value of a contrast: 0 of air, 1 of bone."""
    return AIR + contrast * (BONE - AIR)


def steps(low: float, high: float, dtype: str = "uint8", **more: Any) -> dict[str, Any]:
    """Return a scan stored between two contrasts."""
    return {"dtype": dtype, "window": (grey(low), grey(high)), **more}


@dataclass(frozen=True)
class Condition:
    """What a condition draws of ear and scan, its families, the warnings that name it, and what is stated."""

    ear: Callable[[Draw], dict[str, Any]] = lambda _: {}
    scan: Callable[[Draw], dict[str, Any]] = lambda _: {}
    families: tuple[str, ...] = CLOSED
    codes: tuple[str, ...] = ()
    assumption: str = ""
    scale: float = 1.0
    options: dict[str, Any] = field(default_factory=dict)


def window(r: Draw) -> dict[str, Any]:
    """Draw a stapes in its window."""
    return {"bone": True, "gap_mm": float(r.uniform(0.08, 0.15))}


CONDITIONS = {
    "alone": Condition(),
    "alone, thin, hollow or open": Condition(families=OPEN),
    "over a plate": Condition(lambda r: {"plate": True, "plate_gap_mm": float(r.uniform(0.15, 0.45))}),
    "in its window": Condition(window),
    "window and incus": Condition(lambda r: {**window(r), "incus_gap_mm": float(r.uniform(0.08, 0.15))}),
    "perforated, narrow gap": Condition(
        lambda r: {"bone": True, "gap_mm": float(r.uniform(0.04, 0.08))}, families=("perforated",)
    ),
    "8 bit, wide window": Condition(scan=lambda _: steps(-0.3, 1.5)),
    "8 bit, begins above air": Condition(
        scan=lambda r: steps(r.uniform(0.01, 0.1), 1.4), codes=("air_clipped",)
    ),
    "16 bit, begins above air": Condition(
        scan=lambda r: steps(r.uniform(0.0, 0.05), 2.9, "uint16"), codes=("air_clipped",)
    ),
    "8 bit, ends below bone": Condition(
        scan=lambda r: steps(-0.3, r.uniform(0.94, 1.0)), codes=("bone_clipped",)
    ),
    "16 bit, ends at bone": Condition(
        scan=lambda r: steps(-0.4, r.uniform(0.96, 1.02), "uint16"), codes=("bone_clipped",)
    ),
    "32 or 64 steps": Condition(
        scan=lambda r: steps(-0.3, 1.5, steps=int(r.choice((32, 64))), noise=r.uniform(0.005, 0.02)),
        codes=("file_read",),
    ),
    "fluid under the footplate": Condition(
        lambda r: {**window(r), "fluid_depth_mm": float(r.uniform(0.1, 0.4))},
        lambda r: {"soft": r.uniform(0.15, 0.4)},
        codes=("soft_surroundings",),
    ),
    "fluid as bright as its plate": Condition(
        lambda r: {**window(r), "plate": True, "fluid_depth_mm": float(r.uniform(0.15, 0.3))},
        lambda _: {"soft": 0.32},
        codes=("soft_surroundings",),
    ),
    "mucosa of 35 um": Condition(
        lambda _: {"coat_mm": 0.035},
        lambda _: {"soft": 0.15},
        codes=("soft_surroundings", "coat_suspected"),
        assumption="bare_bone_assumed",
    ),
    "mucosa, stated": Condition(
        lambda _: {"coat_mm": 0.035}, lambda _: {"soft": 0.15}, options={"coat_um": (35.0, 6.0)}
    ),
    "rings": Condition(scan=lambda _: {"rings": 0.02}),
    "motion along x": Condition(scan=lambda _: {"motion_voxels": 1.6}),
    "weak motion along x": Condition(scan=lambda r: {"motion_voxels": r.uniform(0.4, 1.2)}),
    "a jump half way": Condition(scan=lambda r: {"jump_voxels": r.uniform(1.0, 3.0)}),
    "phase fringes": Condition(scan=lambda _: {"fringe": 0.6}),
    "weak phase fringes": Condition(scan=lambda r: {"fringe": r.uniform(0.1, 0.5)}),
    "exported with a gamma of 0.7": Condition(scan=lambda _: {"gamma": 0.7}, assumption="bare_bone_assumed"),
    "noise of 5 to 20 %": Condition(scan=lambda r: {"noise": r.uniform(0.05, 0.2)}),
    "large (1.3 x)": Condition(scale=1.3),
    "large in its window": Condition(lambda _: {"bone": True, "gap_mm": 0.12}, scale=1.3),
    "small (0.85 x), plate": Condition(
        lambda r: {"plate": True, "plate_gap_mm": float(r.uniform(0.2, 0.45))}, scale=0.85
    ),
}
NAMING = ("grey_values_misfit", "grey_values_missing")
"""Warnings that grey values are not those of two sharp materials."""


def scanned(name: str, number: int, folder: Path) -> Measured:
    """Measure one scan of a condition."""
    condition, own = CONDITIONS[name], sum(map(ord, name))
    rng = np.random.default_rng([number, own])
    family = condition.families[(number + own) % len(condition.families)]
    stapes = Stapes(family=f"foreign {family}", scale=condition.scale, seed=1000 + number)
    ear = Ear(
        **{"stapes": stapes, "density_kg_m3": 1900.0, "bone": False, "plate": False, **condition.ear(rng)}
    )
    usual = {
        "voxel_um": float(rng.uniform(18.0, 32.0)), "blur_voxels": float(rng.uniform(0.8, 1.6)),
        "noise": float(rng.uniform(0.01, 0.05)), "tilt_deg": 60.0, "seed": number,
    }  # fmt: skip
    return measure(ear, Scan(**{**usual, **condition.scan(rng)}), folder, **condition.options)


def is_wrong(one: Measured) -> bool:
    """Return whether the volume is off by more than 4 stated standard deviations and 0.05 %."""
    return one.record is not None and abs(one.volume_error) > max(4.0 * one.volume_sd, 5e-4)


def fate(name: str, one: Measured) -> str:
    """Return what came of a scan."""
    if one.record is None:
        return "refused"
    if not is_wrong(one):
        return "right"
    names = (*CONDITIONS[name].codes, UNCERTAIN, *NAMING)
    if any(code.startswith(names) for code in one.codes):
        return "wrong, named"
    return "assumed" if CONDITIONS[name].assumption in one.codes else "silent"


FATES = ("right", "refused", "wrong, named", "assumed", "silent")
COLUMNS = ("condition", "/".join(FATES), "volume rms, %", "stated, %", "V/M/pose held, %")


def row(name: str, found: Sequence[Measured]) -> list[object]:
    """Return one row of the table."""
    fates = [fate(name, one) for one in found]
    good = [one for one, what in zip(found, fates, strict=True) if what == "right"]
    volumes = [abs(one.volume_error) < 1.96 * one.volume_sd for one in good]
    entries = np.concatenate([one.matrix_deviations for one in good] or [np.zeros(0)])
    poses = np.array([one.frame_deviation / one.frame_sd for one in good])
    held = (volumes, np.abs(entries[np.isfinite(entries)]) < 1.96, np.abs(poses) < 1.96)
    return [
        name,
        "/".join(str(fates.count(what)) for what in FATES),
        f"{100 * volume_rms(good):.2g}",
        f"{100 * np.median([one.volume_sd for one in good]):.2g}" if good else NOTHING,
        "/".join(percent(part, 0).removesuffix(" %") for part in held),
    ]


def volume_rms(found: Sequence[Measured]) -> float:
    """Return the root mean square of the relative errors of the volume."""
    return float(root_mean_square([one.volume_error for one in found])) if found else np.nan


def is_plain(name: str, found: Sequence[Measured]) -> bool:
    """Return whether all scans of a condition are right and close."""
    return all(fate(name, one) == "right" for one in found) and volume_rms(found) < CLOSE


def coverage(right: Sequence[Measured]) -> Iterator[str]:
    """Yield how often the intervals of volume, pose and M hold, and how sharp they are."""
    volumes = [abs(one.volume_error) < 1.96 * one.volume_sd for one in right]
    yield f"volume: intervals hold in {percent(volumes)}"
    for title, every in (
        ("pose", np.array([one.frame_deviation / one.frame_sd for one in right])),
        ("M", np.array([one.matrix_deviations for one in right])),
    ):
        columns = [column[np.isfinite(column)] for column in np.abs(every).T]
        held = [100.0 * np.mean(z < 1.96) for z in columns if len(z)]
        over = [0.6745 / np.median(z) for z in columns if len(z)]
        yield (
            f"{title}: intervals hold in {min(held):.1f} to {max(held):.1f} % by component, "
            f"stated over found {min(over):.2f} to {max(over):.2f}"
        )


if __name__ == "__main__":
    given = arguments(__doc__, scans=1, start=0, word="")
    numbers = range(given.start, given.start + given.scans)
    with tempfile.TemporaryDirectory() as place:
        results = {
            name: [scanned(name, number, Path(place)) for number in numbers]
            for name in CONDITIONS
            if given.word in name
        }
    plain = [name for name, found in results.items() if is_plain(name, found)]
    print_table(COLUMNS, (row(name, found) for name, found in results.items() if name not in plain))
    if plain:
        errors = [100.0 * volume_rms(results[name]) for name in plain]
        print(
            f"All right, with a volume rms of {min(errors):.2g} to {max(errors):.2g} %: {'; '.join(plain)}.\n"
        )
    fates = [fate(name, one) for name, found in results.items() for one in found]
    print(f"* {len(fates)} scans: {'; '.join(f'{fates.count(what)} {what}' for what in FATES)}")
    right = [
        one for found in results.values() for one in found if one.record is not None and not is_wrong(one)
    ]
    for line in coverage(right):
        print(f"* {line}")
