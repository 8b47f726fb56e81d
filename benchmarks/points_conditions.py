"""Are faults found and named where values are missing, positions are wrong, or two things are wrong at once?

    python benchmarks/points_conditions.py missing --share 0.2 --scenes 60 --clean 200
    python benchmarks/points_conditions.py band --scenes 60
    python benchmarks/points_conditions.py two --scenes 60
    python benchmarks/points_conditions.py unstated --position-um 20 --scenes 60

Scenes are those of ``fault_scenes``. ``missing``: single values of all channels at random; ``band``: one
channel over half of the lines; ``two``: two faults at different points; ``unstated``: position errors that no
``sd_mm`` states, and the verdicts that follow.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.fault_scenes import (
    FAULTS,
    GEOMETRIES,
    Scene,
    measured,
    possible,
    scene,
    two_faults,
    with_gaps,
)
from benchmarks.points_faults import judged
from legacy.stapeskit.faults import StapeskitError

PAIRS = (("sign", "gain 5 %"), ("sign", "sign"), ("gain 5 %", "direction 4 deg"), ("sign", "noise x4"),
         ("position 200 um", "sign"), ("drift 6 %", "gain 5 %"))  # fmt: skip


def verdicts(case: Scene, value: np.ndarray, stated: bool = True) -> dict[int, str]:
    """Return the verdict on each channel that is not ok; ``refused`` on every channel of a refused file."""
    try:
        result = judged(case, 0, stated, value=value)
    except StapeskitError:
        return dict.fromkeys(range(len(case.points)), "refused")
    return {c: v.verdict for c, v in enumerate(result.channels) if v.verdict != "ok"}


def drawn(arguments: argparse.Namespace, seed: int, geometry: str, fault: str) -> tuple[Scene, np.ndarray]:
    """Draw a scene and its readings with gaps."""
    case = scene(seed, geometry, fault, noise=arguments.noise, lines=arguments.lines)
    gone = arguments.share if arguments.what == "missing" else 0.0
    return case, with_gaps(measured(case, seed), seed, gone, arguments.what == "band")


def gaps(arguments: argparse.Namespace) -> Iterator[str]:
    """Yield the table of faults beside missing values, and of files without fault."""
    yield "| geometry | fault | found | culprit named | right kind |\n|-|-|-|-|-|"
    for geometry in GEOMETRIES:
        if arguments.geometry not in geometry:
            continue
        for fault in FAULTS if arguments.scenes else ():
            if not possible(fault, geometry) or (arguments.fault and fault not in arguments.fault):
                continue
            detected = named = right = 0
            for number in range(arguments.scenes):
                case, value = drawn(arguments, 1000 * arguments.seed + number, geometry, fault)
                named_as = verdicts(case, value, not arguments.no_sd)
                detected += bool(named_as)
                named += set(named_as) == set(case.culprits)
                right += named_as == dict.fromkeys(case.culprits, case.verdict)
                if arguments.show and named_as != dict.fromkeys(case.culprits, case.verdict):
                    print(geometry, fault, 1000 * arguments.seed + number, case.culprits[:4], named_as)
            n = arguments.scenes
            yield f"| {geometry} | {fault} | {detected / n:.3f} | {named / n:.3f} | {right / n:.3f} |"
        alarms = sum(
            bool(verdicts(*drawn(arguments, 500_000 + number, geometry, ""), not arguments.no_sd))
            for number in range(arguments.clean)
        )
        if arguments.clean:
            yield f"| {geometry} | none | {alarms / arguments.clean:.4f} | | |"


def two(arguments: argparse.Namespace) -> Iterator[str]:
    """Yield the table of two faults at once."""
    yield "| geometry | faults | first named | second named | both, and nothing else |\n|-|-|-|-|-|"
    for geometry in GEOMETRIES:
        if arguments.geometry not in geometry or len(GEOMETRIES[geometry][1]) == 1:
            continue
        for pair in PAIRS:
            single = other = both = 0
            for number in range(arguments.scenes):
                seed = 1000 * arguments.seed + number
                case = two_faults(seed, geometry, pair, noise=arguments.noise, lines=arguments.lines)
                named_as = verdicts(case, measured(case, seed), not arguments.no_sd)
                named = set(named_as) if len(named_as) < len(case.points) else set()
                single += set(case.culprits[:-1]) <= named
                other += case.culprits[-1] in named
                both += named == set(case.culprits)
                if arguments.show and named != set(case.culprits):
                    print(geometry, pair, seed, case.culprits, named_as)
            n = arguments.scenes
            shares = " | ".join(f"{count / n:.3f}" for count in (single, other, both))
            yield f"| {geometry} | {' and '.join(pair)} | {shares} |"


def unstated(arguments: argparse.Namespace) -> Iterator[str]:
    """Yield the verdicts on files without fault whose positions are off by more than is stated."""
    yield "| geometry | what is said, of how many files |\n|-|-|"
    for geometry in GEOMETRIES:
        if arguments.geometry not in geometry:
            continue
        counts: Counter[str] = Counter()
        for number in range(arguments.scenes):
            seed = 1000 * arguments.seed + number
            case = scene(
                seed, geometry, noise=arguments.noise, lines=arguments.lines,
                position_sd_mm=1e-3 * arguments.position_um,
            )  # fmt: skip
            named_as = verdicts(case, measured(case, seed), not arguments.no_sd)
            whole = "all channels: " if len(named_as) == len(case.points) else "some channels: "
            counts[whole + ", ".join(sorted(set(named_as.values()))) if named_as else "nothing"] += 1
        yield f"| {geometry} | {'; '.join(f'{what} {n}' for what, n in counts.most_common())} |"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("missing", "band", "two", "unstated"))
    parser.add_argument("--scenes", type=int, default=60, help="scenes per fault")
    parser.add_argument("--clean", type=int, default=0, help="files without fault per geometry")
    parser.add_argument("--share", type=float, default=0.2, help="share of the values that is missing")
    parser.add_argument("--position-um", type=float, default=20.0, help="position errors, per axis")
    parser.add_argument("--noise", type=float, default=0.01, help="noise over the rms of the signal")
    parser.add_argument("--lines", type=int, default=120)
    parser.add_argument("--geometry", default="", help="only geometries whose name holds this")
    parser.add_argument("--fault", nargs="*", help="only these faults")
    parser.add_argument("--no-sd", action="store_true", help="do not state the noise")
    parser.add_argument("--show", action="store_true", help="tell every scene that went wrong")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    make = {"missing": gaps, "band": gaps, "two": two, "unstated": unstated}[arguments.what]
    for line in make(arguments):
        print(line, flush=True)


if __name__ == "__main__":
    main()
