"""Can "believe" be believed? Whole studies, right ones and wrong ones, the verdict of each against the truth.

Each ear draws a stapes of usual size, a pose, a voxel size, a noise, and one condition of its scan; its
measurement is then made several times, each time with another condition. A study is wrong when the mass, or
an entry on the diagonal of K or D, lies more than 4 stated standard deviations from the truth; it is of no
use when a stated standard deviation or a true error of such a number is above 30 % of the truth. Marks are
read off the scan: with those of a drawing nothing confirms the order of the slices.

    python -m benchmarks.verdicts --ears 16 --first 7000
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._table import arguments, before, print_table
from simulate import Ear, Experiment, MeasurementFault, Scan, Stapes, Truth, simulate_study
from simulate.files.recordings import write_recording
from simulate.study import simulate_recording
from stapeskit.faults import StapeskitError

# A number is wrong beyond this many of its sd: of 7 numbers of 144 studies .06 pass it by chance.
MOST_SD = 4.0
# Beyond this share of the truth a number is of no use: two ears that differ by less cannot be told apart.
MOST_SHARE = 0.3
REFUSED = "refused"
LEVELS = ("believe", "check", "do not use", REFUSED)
BEFORE = "verdicts_16_first_7000"
Draw = np.random.Generator


def _off_one(rng: Draw, low: float, high: float) -> float:
    """Draw a factor that is off by ``low`` to ``high`` to either side."""
    return 1.0 + float(rng.choice([-1, 1]) * rng.uniform(low, high))


@dataclass(frozen=True)
class Scanned:
    """A condition of a scan: changes of ear and scan, and of what the study states, by key."""

    ear: Callable[[Draw], dict[str, Any]] = lambda _: {}
    scan: Callable[[Draw], dict[str, Any]] = lambda _: {}
    stated: str = ""


SCANS = {
    "good": Scanned(),
    "noise 8 to 12 %": Scanned(scan=lambda r: {"noise": float(r.uniform(0.08, 0.12))}),
    "gap 30 to 60 µm": Scanned(lambda r: {"gap_mm": float(r.uniform(0.03, 0.06))}),
    "bony bridges": Scanned(
        lambda r: {"gap_mm": 0.08, "bridges": 2, "bridge_radius_mm": r.uniform(0.05, 0.12)}
    ),
    "incus grown on": Scanned(lambda r: {"incus_gap_mm": -float(r.uniform(0.02, 0.08))}),
    "cupping 4 to 10 %": Scanned(scan=lambda r: {"cupping": float(r.uniform(0.04, 0.1))}),
    "slices mirrored": Scanned(scan=lambda _: {"mirror": "z"}, stated="mirror"),
    "voxel size off by 2 to 5 %": Scanned(stated="spacing_mm"),
    "density off by 5 to 10 %": Scanned(stated="density_kg_m3"),
    "anterior reversed": Scanned(stated="anterior"),
}
_DRIFTS = "K 5 to 30 % higher at the end of the band"
MEASUREMENTS: dict[str, tuple[str, float, float]] = {
    "right": ("", 0.0, 0.0),
    "right again": ("", 0.0, 0.0),
    "gain of a beam, 3 to 20 %": ("gain", 0.03, 0.2),
    "sign of a beam": ("sign", 0.0, 0.0),
    "direction of a beam, 2 to 10°": ("direction", 2.0, 10.0),
    "position of a point, 50 to 500 µm": ("position", 0.05, 0.5),
    "two names exchanged": ("label_swap", 0.0, 0.0),
    "noise of a beam, 2 to 6 times": ("noise", 2.0, 6.0),
    "drift of a beam, 3 to 20 %": ("drift", 0.03, 0.2),
    "all conjugated": ("conjugate", 0.0, 0.0),
    "gain of a laser, 3 to 10 %": ("laser_gain", 0.03, 0.1),
    "stapes at another level, 3 to 20 %": ("body_gain", 0.03, 0.2),
    "footplate bends by 2 to 10 %": ("flexible", 0.02, 0.1),
    _DRIFTS: ("", 0.05, 0.3),
}


@dataclass(frozen=True, kw_only=True)
class Study:
    """The verdict of one study, and (error, sd, truth) of its mass and diagonal entries."""

    scan: str
    measurement: str
    level: str
    numbers: tuple[tuple[float, float, float], ...] = ()

    @property
    def wrong(self) -> bool:
        """Whether a number lies too far from the truth."""
        return any(abs(error) > MOST_SD * sd for error, sd, _ in self.numbers)

    @property
    def useless(self) -> bool:
        """Whether a number is too uncertain, or too far off, to be used for anything."""
        return any(max(abs(error), sd) > MOST_SHARE * abs(true) for error, sd, true in self.numbers)


def restate(folder: Path, key: str, rng: Draw) -> None:
    """Make the study state something wrong about its scan."""
    path = folder / "study.toml"
    text = path.read_text(encoding="utf-8")
    if key == "mirror":
        text = re.sub(r"^mirror = .*\n", "", text, flags=re.MULTILINE)
    elif key == "anterior":
        text = re.sub(
            r"(?<=anterior = )\[.*\]", lambda m: str([-float(x) for x in m[0][1:-1].split(",")]), text
        )
    elif key == "density_kg_m3":
        factor = _off_one(rng, 0.05, 0.1)
        text = re.sub(r'(?<=density_kg_m3 = ")[0-9.]+', lambda m: f"{factor * float(m[0]):.1f}", text)
    elif key == "spacing_mm":
        size = _off_one(rng, 0.02, 0.05) * float(re.findall(r"# voxel ([0-9.]+)", text)[0])
        text = re.sub(r"# voxel .*\n", f"spacing_mm = [{size}, {size}, {size}]\n", text)
    path.write_text(re.sub(r"^# voxel .*\n", "", text, flags=re.MULTILINE), encoding="utf-8")


def one_ear(seed: int, variants: int) -> list[Study]:
    """Make an ear; measure its motion several times."""
    rng = np.random.default_rng([seed, 41])
    scan_name = "good" if rng.uniform() < 0.6 else str(rng.choice(list(SCANS)[1:]))
    condition = SCANS[scan_name]
    stretch = tuple(float(size) for size in rng.uniform([1.02, 0.80, 0.93], [1.08, 0.85, 0.98]))
    ear = Ear(
        **{"stapes": Stapes(stretch=stretch), "gap_mm": float(rng.uniform(0.08, 0.25)), **condition.ear(rng)}
    )
    voxel_um = float(rng.uniform(27.0, 35.0))
    scan = Scan(
        **{"voxel_um": voxel_um, "noise": float(rng.uniform(0.02, 0.05)), "seed": seed, **condition.scan(rng)}
    )
    others = map(str, rng.choice(list(MEASUREMENTS)[2:], variants - 2, replace=False))
    studies = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        simulate_study(ear, scan, Experiment(seed=seed), folder)
        path = folder / "study.toml"
        text = path.read_text(encoding="utf-8").replace(
            "[scan]\n", f"[scan]\ncoat_um = 0\n# voxel {voxel_um / 1e3}\n"
        )
        path.write_text(re.sub(r"^truth = .*\n", "", text, flags=re.MULTILINE), encoding="utf-8")
        restate(folder, condition.stated, rng)
        for what in ("right", "right again", *others):
            studies.append(one_study(folder, ear, scan, seed, scan_name, what))
    return studies


def one_study(folder: Path, ear: Ear, scan: Scan, seed: int, scan_name: str, what: str) -> Study:
    """Measure the ear under a condition and run the study; the stage of the scan is reused."""
    from pipeline.run import scan2kd
    from simulate import simulate_truth

    number = list(MEASUREMENTS).index(what)
    rng = np.random.default_rng([seed, number, 43])
    kind, low, high = MEASUREMENTS[what]
    size = float(rng.uniform(low, high)) * float(
        rng.choice([-1, 1]) if "gain" in kind or kind == "drift" else 1
    )
    faults = (MeasurementFault(kind=kind, size=size or None),) if kind else ()
    if what == _DRIFTS:
        ear = replace(ear, ligament=replace(ear.ligament, drift=size))
    truth = simulate_truth(ear, scan)
    experiment = Experiment(
        seed=seed + 100_000 * (what == "right again"),
        faults=faults,
        marks_in_scan=SCANS[scan_name].stated != "mirror",
    )
    write_recording(folder, simulate_recording(truth, experiment), experiment.format)
    try:
        result = scan2kd(folder / "study.toml", out=folder / "out", force=True)
    except StapeskitError:
        return Study(scan=scan_name, measurement=what, level=REFUSED)
    level = result.fit.verdict.level
    return Study(scan=scan_name, measurement=what, level=level, numbers=numbers(result, truth))


def numbers(result: Any, truth: Truth) -> tuple[tuple[float, float, float], ...]:
    """Return (error, sd, truth) of mass and diagonal entries."""
    matrix = result.measured.mass_matrix
    mass, true = float(matrix.parameters[0]), float(truth.parameters_si[0])
    found = [(mass - true, float(np.sqrt(matrix.covariance[0, 0])), true)]
    deviations = result.fit.standard_deviation
    for value, sd, exact in (
        (result.fit.stiffness, deviations[0], truth.stiffness_si),
        (result.fit.damping, deviations[1], truth.damping_si),
    ):
        found += [(float(value[k, k] - exact[k, k]), float(sd[k, k]), float(exact[k, k])) for k in range(3)]
    return tuple(found)


def cell(group: Sequence[Study], level: str) -> str:
    """Return how many studies of a group have a verdict, how many are wrong, and how many of no use."""
    own = [study for study in group if study.level == level]
    if not own or level == REFUSED:
        return f"{len(own)}" if own else ""
    useless = sum(study.useless and not study.wrong for study in own)
    last = f", {useless} of no use" if useless else ""
    return f"{len(own)}, {sum(study.wrong for study in own)} wrong{last}"


def report(studies: Sequence[Study]) -> None:
    """Print how often each verdict is wrong, each figure followed by that of 0.2."""
    good = [study for study in studies if not SCANS[study.scan].stated]
    right = ("right", "right again")
    groups = {
        "scan and measurement right": [s for s in good if s.scan == "good" and s.measurement in right],
        "a difficult scan": [s for s in good if s.scan != "good" and s.measurement in right],
        "an error in the measurement": [s for s in good if s.measurement not in right],
        "a wrong statement about the scan": [s for s in studies if SCANS[s.scan].stated],
    }
    rows = []
    for title, group in groups.items():
        pairs = ((cell(group, level), before(BEFORE, level, title)) for level in LEVELS)
        rows.append([title, *(word for pair in pairs for word in pair)])
    print_table(("studies", *(word for level in LEVELS for word in (level, "0.2"))), rows)


if __name__ == "__main__":
    given = arguments(__doc__, ears=1, first=5000, variants=3)
    done = [
        study
        for seed in range(given.first, given.first + given.ears)
        for study in one_ear(seed, given.variants)
    ]
    print(f"{len(done)} studies on {given.ears} ears\n")
    report(done)
