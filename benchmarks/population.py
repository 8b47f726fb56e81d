"""Is ct2mass right on stapedes and scans that it was not developed on, and does it say so where it is not?

    python benchmarks/population.py [--scans N] [--start K] [--rows WORD ...] [--records FILE] [--verbose]

One row a condition, N scans each of drawn families, sizes, poses, voxels, blurs, noises (seeds K, K+1, ...).
"Refused" stops with a message. "Silent" is off by more than 4 stated standard deviations of the volume and
more than 0.05 %, without a warning that names the cause; "assumed" is as wrong where every result states the
assumption that does not hold, with the size of its effect (bare bone, a linear grey scale). "M" and "pose"
are the shares of entries of the mass matrix and of components of the footplate's pose within 1.96 stated
standard deviations, where right. A second table gives every entry, and by how much the stated deviation
exceeds the errors (median; 1 is right), a third one what a factor of the pose's deviations would be that is
fitted on half of the families, and what the other half says of it.
``--records`` keeps each scan's result in a file (JSON lines); scans that are in it are not made again.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import foreign_scans as scans
from benchmarks import foreign_shapes as shapes
from benchmarks.population_rows import ROWS, Row

Array = NDArray[np.float64]
_ANY = ("stapes_uncertain",)
_USUAL = (
    "handedness_unconfirmed", "plate_axis_sign", "density_sd_not_given", "plate_not_found",
    "plate_axis_ambiguous", "axis_ambiguous", "plate_cropped", "fiducials_coplanar",
)  # fmt: skip


@dataclass(frozen=True)
class Score:
    """What came of one scan: shares of the true volume, None where refused; errors in stated deviations.

    ``matrix`` (21,) upper triangle row by row, NaN where the truth is exact; ``pose`` (6,).
    """

    text: str
    error: float | None = None
    sd: float = 0.0
    named: bool = False
    assumed: bool = False
    codes: tuple[str, ...] = ()
    matrix: Array | None = None
    pose: Array | None = None
    pose_sd: Array | None = None
    seconds: float = 0.0

    @property
    def wrong(self) -> bool:
        """Whether the volume is off by more than 4 stated standard deviations."""
        return self.error is not None and abs(self.error) > max(4.0 * self.sd, 5e-4)

    @property
    def silent(self) -> bool:
        """Whether it is wrong, no warning names the cause, and no stated assumption is it."""
        return self.wrong and not self.named and not self.assumed


def row_named(name: str) -> Row:
    """Return a row of the table."""
    return next(row for row in ROWS if row.name == name)


def family_of(row: Row, number: int) -> str:
    """Return the family of a scan."""
    return row.families[(number + sum(map(ord, row.name))) % len(row.families)]


def score(row: Row, number: int, folder: Path, frames: bool = True, **fixed: Any) -> Score:
    """Make one scan of a row, some of it fixed, and compare what ct2mass says of it with the truth.

    Without ``frames`` neither pose nor mass matrix, which needs the true frame, are compared.
    """
    from dataclasses import replace

    from legacy.ct_inertia.ct2mass import MassOptions, ct2mass
    from legacy.ct_inertia.errors import CtInertiaError

    own = sum(map(ord, row.name))
    shape_rng = np.random.default_rng([1000 + number, own])
    family = family_of(row, number)
    anatomy = shapes.draw(family, shape_rng)
    anatomy = replace(anatomy, scale=anatomy.scale * row.size)
    rng = np.random.default_rng([number, own])
    scene = scans.draw_scene(rng, **row.ask(rng), **fixed)
    file = folder / "scan.tif"
    truth = scans.make(anatomy, scene, rng, file)
    density = 1900.0
    seed = truth.centroid_mm + 0.0
    if row.seeded:
        seed = (truth.scan_from_footplate @ np.array([0.0, 0.1, 0.0, 1.0]))[:3]
    options = MassOptions(
        file,
        density=(density, None),
        spacing_mm=(scene.voxel_um * 1e-3,),
        anterior=tuple(float(v) for v in truth.scan_from_body[:3, 0]),
        seed_mm=tuple(float(v) for v in seed) if row.seeded else None,
        **row.options,
    )
    start = time.process_time()
    about = f"{number} {family} {scene.voxel_um:.0f} um, blur {scene.blur:.1f}, noise {scene.noise:.3f}"
    try:
        result = ct2mass(options)
    except Exception as refusal:  # anything but a message to the user counts as a crash
        kind = "" if isinstance(refusal, CtInertiaError) else "CRASH "
        return Score(f"{about}: {kind}refused: {str(refusal)[:150]}", seconds=time.process_time() - start)
    seconds = time.process_time() - start
    moments = result.moments
    volume_sd = float(np.sqrt(sum(c[0, 0] for c in moments.contributions.values()))) / truth.volume_mm3
    error = moments.volume_mm3 / truth.volume_mm3 - 1.0
    codes = [n.code for n in result.notices if n.code not in _USUAL]
    named = bool(set(codes) & {*row.codes, *_ANY})
    assumed = row.assumption in codes
    where = np.linalg.norm(moments.centroid_mm - truth.centroid_mm) * 1e3
    text = f"{about}: V {100 * error:+.3f} +- {100 * volume_sd:.3f} %, centre {where:.1f} um"
    if not frames:
        return Score(text, error, volume_sd, named, assumed, tuple(codes), seconds=seconds)
    true = _mass_matrix(truth, density)
    stated = result.matrix.standard_deviation
    upper = np.triu_indices(6)
    off, stated = (result.matrix.matrix - true)[upper], stated[upper]
    matrix = np.divide(off, stated, out=np.full(off.shape, np.nan), where=stated > 0.0)
    pose = _pose_scores(result.footplate, truth.scan_from_footplate)
    pose_sd = np.sqrt(np.diag(result.footplate.covariance))
    text += f", pose z {' '.join(f'{v:+.1f}' for v in pose)}, {', '.join(codes)}"
    return Score(text, error, volume_sd, named, assumed, tuple(codes), matrix, pose, pose_sd, seconds)


def _mass_matrix(truth: scans.Truth, density: float) -> Array:
    """Return M (6, 6) about the footplate centre in footplate axes, SI."""
    frame, mass = truth.scan_from_footplate, density * truth.volume_mm3 * 1e-9
    arm = frame[:3, :3].T @ (truth.centroid_mm - frame[:3, 3]) * 1e-3
    second = frame[:3, :3].T @ truth.second_mm5 @ frame[:3, :3] * density * 1e-15 + mass * np.outer(arm, arm)
    x, y, z = arm
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    inertia = np.trace(second) * np.eye(3) - second
    return np.block([[mass * np.eye(3), -mass * cross], [mass * cross, inertia]])


def _pose_scores(footplate: Any, true: Array) -> Array:
    """Return the errors of the pose (6,) in stated standard deviations: x, y, z, alpha, beta, gamma."""
    from scipy.spatial.transform import Rotation

    moved = np.linalg.inv(true) @ footplate.scan_from_footplate.matrix
    step = np.concatenate([moved[:3, 3] * 1e-3, Rotation.from_matrix(moved[:3, :3]).as_rotvec()])
    return np.asarray(step / np.sqrt(np.diag(footplate.covariance)))


def line(row: Row, scores: list[Score]) -> str:
    """Return a row of the table."""
    there = [s for s in scores if s.error is not None]
    wrong = [s for s in there if s.wrong]
    silent = [s for s in wrong if s.silent]
    named = sum(s.named for s in wrong)
    right = [s for s in there if s not in wrong]
    crashed = sum("CRASH" in s.text for s in scores)
    errors = np.array([s.error for s in right] or [np.nan], dtype=float)
    z = np.array([abs(s.error or 0.0) / s.sd for s in right if s.sd > 0.0] or [np.nan])
    inside = np.concatenate([s.matrix for s in right if s.matrix is not None] or [np.full(1, np.nan)])
    poses = np.array([s.pose for s in right]) if right else np.full((1, 6), np.nan)
    held = " ".join(f"{100 * np.mean(np.abs(poses[:, k]) < 1.96):.0f}" for k in range(6))
    refused = f"{len(scores) - len(there)}" + (f" ({crashed} crashed)" if crashed else "")
    cells = (
        row.name,
        len(scores),
        len(right),
        refused,
        named,
        len(wrong) - named - len(silent),
        len(silent),
        f"{100 * np.sqrt(np.mean(errors**2)):.3f} %",
        f"{100 * np.median([s.sd for s in right] or [np.nan]):.3f} %",
        f"{100 * np.mean(z < 1.96):.0f} %",
        f"{100 * np.mean(np.abs(inside[np.isfinite(inside)]) < 1.96):.0f} %",
        held,
        f"{np.median([s.seconds for s in scores]):.2f} s",
    )
    return f"| {' | '.join(map(str, cells))} |"


def entries(scores: list[Score]) -> str:
    """Return the table of single entries over all scans that are right: held, stated over found."""
    right = [s for s in scores if s.error is not None and not s.wrong and s.matrix is not None]
    names = ["x", "y", "z", "alpha", "beta", "gamma"]
    names += [f"M{i + 1}{j + 1}" for i, j in zip(*np.triu_indices(6), strict=True)]
    lines = ["| entry | held | stated over found |", "|-|-|-|"]
    every = np.array([np.concatenate([np.asarray(s.pose), np.asarray(s.matrix)]) for s in right])
    for name, column in zip(names, np.abs(every).T, strict=True):
        z = column[np.isfinite(column)]
        if len(z):
            lines.append(f"| {name} | {100 * np.mean(z < 1.96):.1f} % | {0.6745 / np.median(z):.2f} |")
    return "\n".join(lines)


def folds(scores: Mapping[tuple[str, int], Score]) -> str:
    """Return a table of the pose by halves of the families: a factor from one half, checked on the other.

    The factor is the root mean square of errors in stated deviations, none counted above 3.
    """
    halves: tuple[list[Array], list[Array]] = ([], [])
    for (name, number), one in scores.items():
        if one.error is not None and not one.wrong and one.pose is not None:
            place = shapes.FAMILIES.index(family_of(row_named(name), number))
            halves[place % 2].append(one.pose)
    if min(map(len, halves)) < 2:
        return ""
    lines = [
        f"| pose | factor: {len(halves[0])} scans; the other {len(halves[1])} | held, as stated | "
        "held with the factor of the other half |",
        "|-|-|-|-|",
    ]
    names = ("x", "y", "z", "alpha", "beta", "gamma")
    for name, one, other in zip(names, *(np.abs(half).T for half in halves), strict=True):
        factors = [float(np.sqrt(np.mean(np.minimum(z, 3.0) ** 2))) for z in (one, other)]
        held = [100 * np.mean(z < 1.96) for z in (one, other)]
        with_it = [
            100 * np.mean(z < 1.96 * factor) for z, factor in zip((one, other), factors[::-1], strict=True)
        ]
        cells = (
            name,
            f"{factors[0]:.2f}; {factors[1]:.2f}",
            *(f"{a:.0f}; {b:.0f} %" for a, b in (held, with_it)),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def total(scores: list[Score]) -> str:
    """Return a sentence of all conditions."""
    refused = sum(s.error is None for s in scores)
    silent = sum(s.silent for s in scores)
    wrong = sum(s.wrong for s in scores)
    named = sum(s.wrong and s.named for s in scores)
    right = len(scores) - refused - wrong
    share = 100 * (right + refused) / max(1, len(scores))
    return (
        f"{len(scores)} scans: {right} right, {refused} refused ({share:.1f} % together), "
        f"{named} wrong and named, {wrong - named - silent} with a stated assumption that does not hold, "
        f"{silent} silent"
    )


def _read_recorded(file: Path | None) -> dict[tuple[str, int], Score]:
    """Return the scores that a file of records holds, by row and number."""
    scores = {}
    for text in file.read_text().splitlines() if file is not None and file.exists() else ():
        record = json.loads(text)
        key = record.pop("row"), record.pop("number")
        for name in ("matrix", "pose", "pose_sd"):
            record[name] = None if record[name] is None else np.array(record[name], dtype=float)
        scores[key] = Score(**record)
    return scores


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scans", type=int, default=8)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--rows", nargs="*", default=[])
    parser.add_argument("--records", type=Path)
    parser.add_argument("--verbose", action="store_true")
    given = parser.parse_args()
    rows = [row for row in ROWS if not given.rows or any(word in row.name for word in given.rows)]
    scores = _read_recorded(given.records)
    with tempfile.TemporaryDirectory() as place:
        for number, row in ((k, r) for k in range(given.start, given.start + given.scans) for r in rows):
            if (row.name, number) in scores:
                continue
            scored = scores[row.name, number] = score(row, number, Path(place))
            if given.verbose:
                print(scored.text, flush=True)
            if given.records is not None:
                with given.records.open("a") as file:
                    record = {"row": row.name, "number": number, **asdict(scored)}
                    file.write(json.dumps(record, default=lambda array: array.tolist()) + "\n")
    heads = (
        "condition", "n", "right", "refused", "wrong, named", "assumed", "silent", "volume rms", "stated",
        "V held", "M held", "pose held, %: x y z alpha beta gamma", "time",
    )  # fmt: skip
    print(f"| {' | '.join(heads)} |\n|{'-|' * len(heads)}")
    for row in rows:
        print(line(row, [s for (name, _), s in scores.items() if name == row.name]))
    print(f"\n{total(list(scores.values()))}\n\n{entries(list(scores.values()))}\n\n{folds(scores)}")


if __name__ == "__main__":
    main()
