"""Can "believe" be believed? Whole studies, right ones and wrong ones, the verdict of each against the truth.

    python benchmarks/verdicts.py [EARS] [--first SEED] [--records FILE]

Each ear draws a stapes, a pose, a voxel size, a noise, and one condition of its scan; its measurement is then
made several times, each time with another condition of the measurement. A study is wrong when the mass, or
an entry on the diagonal of K or D, lies more than 4 stated standard deviations from the truth; it is of no
use when a stated standard deviation or a true error of such a number is above 30 % of the truth. Printed: how
many studies of each verdict are so, for each condition, and for each warning. ``--records`` keeps every
study in a file (JSON lines); ears that are in it are not made again.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from sample_volumes.faults import Fault, faulty
from sample_volumes.phantom import Ear
from sample_volumes.vibrometer import Recording, Vibrometry

Draw = np.random.Generator
# A number is wrong beyond this many of its sd: of 30 numbers of each of 144 studies, 0.3 pass it by chance
# (6e-5 each).
MOST_SD = 4.0
# Beyond this share of the truth a standard deviation or an error leaves a number of no use. Chosen by
# judgement: two ears that differ by less could not be told apart.
MOST_SHARE = 0.3
# What is true of every ear here, and says nothing about errors: its only measured stapes is larger than most.
_OF_ALL = ("outside_published_sizes",)
REFUSED = "refused"
LEVELS = ("believe", "check", "do not use", REFUSED)


def _near_one(rng: Draw, low: float, high: float) -> str:
    """Draw a factor that is off by ``low`` to ``high`` to either side."""
    return f"{1.0 + rng.choice([-1, 1]) * rng.uniform(low, high):.4f}"


# What a scan is like: changes of the ear, and of the [scan] table.
SCANS: dict[str, Callable[[Draw], tuple[dict[str, Any], dict[str, str]]]] = {
    "good": lambda _: ({}, {}),
    "noise 8 to 12 %": lambda r: ({"noise": float(r.uniform(0.08, 0.12))}, {}),
    "gap 30 to 60 µm": lambda r: ({"gap_mm": float(r.uniform(0.03, 0.06))}, {}),
    "bony bridges": lambda r: (
        {"gap_mm": 0.08, "bridges": 2, "bridge_radius_mm": float(r.uniform(0.05, 0.12))}, {},
    ),
    "incus grown on": lambda r: ({"incus_gap_mm": -float(r.uniform(0.02, 0.08))}, {}),
    "cupping 4 to 10 %": lambda r: ({"cupping": float(r.uniform(0.04, 0.1))}, {}),
    "slices mirrored": lambda _: ({"mirror": "z"}, {"mirror": ""}),
    "voxel size off by 2 to 5 %": lambda r: ({}, {"off": _near_one(r, 0.02, 0.05)}),
    "density off by 5 to 10 %": lambda r: ({}, {"density": _near_one(r, 0.05, 0.1)}),
    "anterior reversed": lambda _: ({}, {"anterior": "-"}),
}  # fmt: skip
# What the reader of a page cannot see: the user states something wrong that the files do not contradict.
STATEMENTS = (
    "voxel size off by 2 to 5 %",
    "density off by 5 to 10 %",
    "anterior reversed",
    "slices mirrored",
)


def _one(kind: str, low: float, high: float) -> Callable[[Recording, Draw], Recording]:
    def change(recording: Recording, rng: Draw) -> Recording:
        body = str(rng.choice(["stapes", "base"]))
        point, other = (str(n) for n in rng.choice(np.arange(1, 10), 2, replace=False))
        size = float(rng.uniform(low, high)) * (
            float(rng.choice([-1, 1])) if kind in ("gain", "drift") else 1.0
        )
        fault = Fault(kind, body, point, int(rng.integers(3)), size, other)
        return faulty(recording, fault, int(rng.integers(1 << 30)))

    return change


def _laser(recording: Recording, rng: Draw) -> Recording:
    """Give one laser a wrong gain."""
    velocity = recording.velocity_m_s.copy()
    velocity[:, int(rng.integers(3)) :: 3] *= 1.0 + rng.choice([-1, 1]) * rng.uniform(0.03, 0.1)
    return replace(recording, velocity_m_s=velocity)


def _all_louder(recording: Recording, _rng: Draw) -> Recording:
    """State rms values as peak values: a common factor, which K and D do not depend on."""
    return replace(recording, velocity_m_s=recording.velocity_m_s / np.sqrt(2.0))


def _one_louder(recording: Recording, rng: Draw) -> Recording:
    """Change the level between the two bodies."""
    velocity, factor = recording.velocity_m_s.copy(), 1.0 + rng.choice([-1, 1]) * rng.uniform(0.03, 0.2)
    velocity[:, [body == "stapes" for body in recording.body]] *= factor
    return replace(recording, velocity_m_s=velocity)


def _fiducial(recording: Recording, rng: Draw) -> Recording:
    marks = list(recording.fiducials)
    place = int(rng.integers(len(marks)))
    name, seen, known = marks[place]
    shift = rng.standard_normal(3)
    marks[place] = (name, seen + rng.uniform(0.05, 0.5) * shift / np.linalg.norm(shift), known)
    return replace(recording, fiducials=tuple(marks))


def _exchange(recording: Recording, rng: Draw) -> Recording:
    marks = list(recording.fiducials)
    a, b = rng.choice(len(marks), 2, replace=False)
    marks[a], marks[b] = (marks[a][0], marks[b][1], marks[a][2]), (marks[b][0], marks[a][1], marks[b][2])
    return replace(recording, fiducials=tuple(marks))


def _move(recording: Recording, rng: Draw) -> Recording:
    """Move the plate against the bone between scan and measurement."""
    shift = rng.standard_normal(3)
    shift *= rng.uniform(0.05, 0.3) / np.linalg.norm(shift)
    marks = tuple((name, seen + shift, known) for name, seen, known in recording.fiducials)
    return replace(recording, fiducials=marks)


def _bends(recording: Recording, rng: Draw) -> Recording:
    """Let the footplate bend: a part of the motion along the beams grows with the square of the distance."""
    velocity = recording.velocity_m_s.copy()
    own = np.array([body == "stapes" for body in recording.body])
    away = np.linalg.norm(recording.position_mm[own] - recording.position_mm[own].mean(axis=0), axis=1)
    grows = (away / away.max()) ** 2 - np.mean((away / away.max()) ** 2)
    velocity[:, own] += rng.uniform(0.02, 0.1) * grows[:, None] * velocity[:, own].mean(axis=1, keepdims=True)
    return replace(recording, velocity_m_s=velocity)


def _noise_stated_low(recording: Recording, rng: Draw) -> Recording:
    return replace(recording, sd_m_s=recording.sd_m_s / rng.uniform(1.5, 3.0))


RECORDINGS: dict[str, Callable[[Recording, Draw], Recording] | None] = {
    "right": None,
    "right again": None,
    "gain of a beam, 3 to 20 %": _one("gain", 0.03, 0.2),
    "sign of a beam": _one("sign", 0.0, 0.0),
    "direction of a beam, 2 to 10°": _one("direction", 2.0, 10.0),
    "position of a point, 50 to 500 µm": _one("position", 0.05, 0.5),
    "two names exchanged": _one("label_swap", 0.0, 0.0),
    "noise of a beam, 2 to 6 times": _one("noise", 2.0, 6.0),
    "drift of a beam, 3 to 20 %": _one("drift", 0.03, 0.2),
    "all conjugated": _one("conjugate", 0.0, 0.0),
    "gain of a laser, 3 to 10 %": _laser,
    "all readings rms": _all_louder,
    "stapes at another level, 3 to 20 %": _one_louder,
    "a fiducial off, 50 to 500 µm": _fiducial,
    "two fiducials exchanged": _exchange,
    "plate moved since the scan, 50 to 300 µm": _move,
    "footplate bends by 2 to 10 %": _bends,
    "noise stated 1.5 to 3 times too small": _noise_stated_low,
    "K 5 to 30 % higher at the end of the band": None,
}
_GROWS = "K 5 to 30 % higher at the end of the band"
_RIGHT = ("right", "right again", "all readings rms")


def one_ear(seed: int, variants: int = 9) -> list[dict[str, Any]]:
    """Make an ear, measure its scan once and its motion several times; return one row a study."""
    import SimpleITK as sitk

    from legacy.ct_inertia.results import mass_of
    from legacy.pipeline.study import read_study
    from legacy.stapeskit.faults import StapeskitError
    from sample_volumes.old_study import make_study

    rng = np.random.default_rng([seed, 41])
    scan_name = "good" if rng.uniform() < 0.6 else str(rng.choice(list(SCANS)[1:]))
    changes, stated = SCANS[scan_name](rng)
    others = rng.choice(list(RECORDINGS)[2:], variants - 2, replace=False)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ear = replace(
            Ear(pose_seed=seed, noise_seed=seed, stapes=small_stapes(folder, rng)),
            **{
                "voxel_mm": (float(rng.uniform(0.027, 0.035)),) * 3,
                "gap_mm": float(rng.uniform(0.08, 0.25)),
                "noise": float(rng.uniform(0.02, 0.05)),
                **changes,
            },
        )
        truth = make_study(folder, ear, Vibrometry(seed=seed), f"ear {seed}", ("scan", "ldv"))
        image = sitk.ReadImage(str(folder / "scan.tif"))
        image.SetSpacing([size * float(stated.get("off", 1.0)) for size in ear.voxel_mm])
        sitk.WriteImage(image, str(folder / "scan.nrrd"))
        _write_study(folder, stated)
        try:
            mass = mass_of(read_study(folder / "study.toml").scan)
        except StapeskitError as refusal:
            return [_row(seed, scan_name, "right", REFUSED, [str(refusal)[:160]])]
        names = ("right", "right again", *map(str, others))
        return [_study(folder, ear, truth, mass, seed, scan_name, other) for other in names]


def small_stapes(folder: Path, rng: Draw) -> Path:
    """Write the real stapes, stretched along each axis into the range of published sizes."""
    import trimesh

    from sample_volumes.bodies import OPENEAR_STAPES

    mesh = trimesh.load_mesh(OPENEAR_STAPES)
    low, high = np.array([1.02, 0.80, 0.93]), np.array([1.08, 0.85, 0.98])
    mesh.apply_transform(np.diag([*rng.uniform(low, high), 1.0]))
    mesh.export(folder / "stapes_of_the_ear.ply")
    return folder / "stapes_of_the_ear.ply"


def _write_study(folder: Path, stated: Mapping[str, str]) -> None:
    lines = (folder / "study.toml").read_text(encoding="utf-8").splitlines()
    written = []
    for line in lines:
        key = line.split(" = ")[0]
        if key == "file" and "scan.tif" in line:
            written += ['file = "scan.nrrd"', "coat_um = 0"]
        elif key == "density_kg_m3" and "density" in stated:
            value, sd = line.split('"')[1].split("+-")
            written.append(f'{key} = "{float(value) * float(stated["density"]):.1f}+-{sd}"')
        elif key == "anterior" and "anterior" in stated:
            parts = [-float(part) for part in line.split("[")[1][:-1].split(",")]
            written.append(f"{key} = {parts}")
        elif key != "mirror" and key != "truth":
            written.append(line)
    (folder / "study.toml").write_text("\n".join(written) + "\n", encoding="utf-8")


def _study(
    folder: Path, ear: Ear, truth: Mapping[str, Any], mass: Any, seed: int, scan: str, what: str
) -> dict[str, Any]:
    from legacy.fitting.recorded_fit import kd_of
    from legacy.kinematics.fit_options import fit_options
    from legacy.kinematics.measure_motion import motion_inputs, motion_of, read_inputs
    from legacy.pipeline.study import read_study
    from legacy.pipeline.verdict import verdict
    from legacy.stapeskit.faults import StapeskitError
    from legacy.stapeskit.warnings import unique
    from sample_volumes.old_study import write_recording

    rng = np.random.default_rng([seed, list(RECORDINGS).index(what), 43])
    how = Vibrometry(seed=seed + (100_000 if what == "right again" else 0))
    write_recording(folder, _recording(ear, truth, how, what, rng), how)
    study = read_study(folder / "study.toml")
    measured = mass.measured_mass()
    try:
        inputs = motion_inputs(study.ldv)
        motion = motion_of(inputs, read_inputs(inputs), fit_options(study.ldv), measured)
        fit = kd_of(motion.motion, measured.record.mass_matrix, study.fit, measured.record)
    except StapeskitError as refusal:
        return _row(seed, scan, what, REFUSED, [fault.thing for fault in refusal.faults][:2])
    notices = unique((*mass.notices, *motion.notices, *fit.notices))
    reached = verdict(fit.content(), [notice for notice in notices if notice.code not in _OF_ALL])
    true = truth["mass_kg"]
    errors = {"mass": [mass.matrix.matrix[0, 0] - true, mass.matrix.standard_deviation[0, 0], true]}
    for letter, key, value, sd in (
        ("K", "stiffness_si", fit.stiffness, fit.content()["stiffness_sd_si"]),
        ("D", "damping_si", fit.damping, fit.content()["damping_sd_si"]),
    ):
        for k in range(3):
            true = truth[key][k][k]
            errors[f"{letter}{k + 1}{k + 1}"] = [value[k, k] - true, sd[k][k], true]
    codes = [reason.code or reason.text.split(":")[0] for reason in reached.reasons]
    stated = {name: [float(value) for value in row] for name, row in errors.items()}
    return _row(seed, scan, what, reached.level, codes, stated)


def _recording(ear: Ear, truth: Mapping[str, Any], how: Vibrometry, what: str, rng: Draw) -> Recording:
    from legacy.fitting.examples.paper import PAPER_STIFFNESS
    from legacy.stapeskit.frames import RigidTransform
    from sample_volumes import bodies
    from sample_volumes.vibrometer import record

    plate = RigidTransform(np.array(truth["plate_from_footplate"]), "plate", "footplate").inverse()
    marks = [(name, np.array(place)) for name, place in truth["fiducials_in_plate_mm"].items()]
    mass, stapes = np.array(truth["mass_matrix_si"]), bodies.stapes_in_footplate(ear.stapes)
    recording = record(mass, plate, how, marks, stapes=stapes)
    if what == _GROWS:
        stiffer = (1.0 + rng.uniform(0.05, 0.3)) * PAPER_STIFFNESS
        higher = record(mass, plate, how, marks, stiffer, stapes=stapes)
        share = np.linspace(0.0, 1.0, len(recording.freq_hz))
        velocity = (1.0 - share) * recording.velocity_m_s + share * higher.velocity_m_s
        return replace(recording, velocity_m_s=velocity)
    change = RECORDINGS[what]
    return recording if change is None else change(recording, rng)


def _row(
    seed: int, scan: str, what: str, level: str, codes: Sequence[str], errors: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    row = {"seed": seed, "scan": scan, "measurement": what, "level": level}
    return {**row, "codes": list(codes), "errors": errors or {}}


def wrong(row: Mapping[str, Any]) -> bool:
    """Tell whether a number of a study lies too far from the truth."""
    return any(abs(error) > MOST_SD * sd for error, sd, _ in row["errors"].values())


def of_no_use(row: Mapping[str, Any]) -> bool:
    """Tell whether a number of a study is too uncertain, or too far off, to be used for anything."""
    return any(max(abs(error), sd) > MOST_SHARE * abs(true) for error, sd, true in row["errors"].values())


def main() -> None:
    """Make the studies and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("ears", type=int, nargs="?", default=20)
    parser.add_argument("--first", type=int, default=5000)
    parser.add_argument("--records", type=Path)
    chosen = parser.parse_args()
    rows: list[dict[str, Any]] = []
    if chosen.records is not None and chosen.records.is_file():
        rows = [json.loads(line) for line in chosen.records.read_text(encoding="utf-8").splitlines()]
    wanted = range(chosen.first, chosen.first + chosen.ears)
    for seed in sorted(set(wanted) - {row["seed"] for row in rows}):
        ear = one_ear(seed)
        rows += ear
        if chosen.records is not None:
            with chosen.records.open("a", encoding="utf-8") as stream:
                stream.writelines(json.dumps(row) + "\n" for row in ear)
    tables([row for row in rows if row["seed"] in wanted])


def tables(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print how often each verdict is wrong, over all, by condition and by warning."""
    print(f"{len(rows)} studies on {len({row['seed'] for row in rows})} ears\n")
    seen = [row for row in rows if row["scan"] not in STATEMENTS]
    print("| studies | " + " | ".join(LEVELS) + " |\n|" + "-|" * (len(LEVELS) + 1))
    for title, group in (
        (
            "scan and measurement right",
            [r for r in seen if r["scan"] == "good" and r["measurement"] in _RIGHT],
        ),
        ("a difficult scan", [r for r in seen if r["scan"] != "good" and r["measurement"] in _RIGHT]),
        ("an error in the measurement", [r for r in seen if r["measurement"] not in _RIGHT]),
        ("a wrong statement about the scan", [r for r in rows if r["scan"] in STATEMENTS]),
    ):
        print(f"| {title} | " + " | ".join(_share(group, level) for level in LEVELS) + " |")
    for key in ("scan", "measurement"):
        print(f"\n| {key} | " + " | ".join(LEVELS) + " |\n|" + "-|" * (len(LEVELS) + 1))
        for name in dict.fromkeys([*(SCANS if key == "scan" else RECORDINGS)]):
            group = [row for row in (rows if key == "scan" else seen) if row[key] == name]
            print(f"| {name} | " + " | ".join(_share(group, level) for level in LEVELS) + " |")
    by_code: dict[str, Counter[bool]] = defaultdict(Counter)
    for row in seen:
        for code in row["codes"] if row["level"] != REFUSED else ():
            by_code[code][wrong(row)] += 1
    print("\n| reason of a verdict | studies | of these wrong |\n|-|-|-|")
    for code, count in sorted(by_code.items(), key=lambda pair: -pair[1].total()):
        print(f"| {code} | {count.total()} | {100 * count[True] / count.total():.0f} % |")


def _share(group: Sequence[Mapping[str, Any]], level: str) -> str:
    """Return how many studies of a group have a verdict, how many are wrong, and how many else of no use."""
    own = [row for row in group if row["level"] == level]
    if not own:
        return ""
    if level == REFUSED:
        return f"{len(own)}"
    useless = sum(of_no_use(row) and not wrong(row) for row in own)
    return f"{len(own)}, {sum(map(wrong, own))} wrong" + (f", {useless} of no use" if useless else "")


if __name__ == "__main__":
    main()
