"""Are faults found and named where values are missing, positions are wrong, or two things are wrong at once?

    python benchmarks/points_conditions.py missing --share 0.2 --scenes 60 --clean 200
    python benchmarks/points_conditions.py band --scenes 60
    python benchmarks/points_conditions.py two --scenes 60
    python benchmarks/points_conditions.py unstated --position-um 20 --scenes 60

Scenes are those of ``fault_scenes``. ``missing``: single values of all channels at random; ``band``: one
channel over half of the lines; ``two``: two faults at different points; ``unstated``: position errors that no
``sd_mm`` tells of, and what is said of them.
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
from stapeskit.faults import StapeskitError

PAIRS = (("sign", "gain 5 %"), ("sign", "sign"), ("gain 5 %", "direction 4 deg"), ("sign", "noise x4"),
         ("position 200 um", "sign"), ("drift 6 %", "gain 5 %"))  # fmt: skip


def verdicts(made: Scene, value: np.ndarray, stated: bool = True) -> dict[int, str]:
    """Return what is said of each channel that is not in order; of a file that is refused, that of all."""
    try:
        result = judged(made, 0, stated, value=value)
    except StapeskitError:
        return dict.fromkeys(range(len(made.points)), "refused")
    return {c: v.verdict for c, v in enumerate(result.channels) if v.verdict != "ok"}


def drawn(arguments: argparse.Namespace, seed: int, geometry: str, fault: str) -> tuple[Scene, np.ndarray]:
    """Draw a scene and its readings with gaps."""
    made = scene(seed, geometry, fault, noise=arguments.noise, lines=arguments.lines)
    gone = arguments.share if arguments.what == "missing" else 0.0
    return made, with_gaps(measured(made, seed), seed, gone, arguments.what == "band")


def gaps(arguments: argparse.Namespace) -> Iterator[str]:
    """Yield the table of faults beside missing values, and of files without fault."""
    yield "| geometry | fault | found | culprit named | right kind |\n|-|-|-|-|-|"
    for geometry in GEOMETRIES:
        if arguments.geometry not in geometry:
            continue
        for fault in FAULTS if arguments.scenes else ():
            if not possible(fault, geometry) or (arguments.fault and fault not in arguments.fault):
                continue
            found = named = right = 0
            for number in range(arguments.scenes):
                made, value = drawn(arguments, 1000 * arguments.seed + number, geometry, fault)
                said = verdicts(made, value, not arguments.no_sd)
                found += bool(said)
                named += set(said) == set(made.culprits)
                right += said == dict.fromkeys(made.culprits, made.verdict)
                if arguments.show and said != dict.fromkeys(made.culprits, made.verdict):
                    print(geometry, fault, 1000 * arguments.seed + number, made.culprits[:4], said)
            n = arguments.scenes
            yield f"| {geometry} | {fault} | {found / n:.3f} | {named / n:.3f} | {right / n:.3f} |"
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
            one = other = both = 0
            for number in range(arguments.scenes):
                seed = 1000 * arguments.seed + number
                made = two_faults(seed, geometry, pair, noise=arguments.noise, lines=arguments.lines)
                said = verdicts(made, measured(made, seed), not arguments.no_sd)
                named = set(said) if len(said) < len(made.points) else set()
                one += set(made.culprits[:-1]) <= named
                other += made.culprits[-1] in named
                both += named == set(made.culprits)
                if arguments.show and named != set(made.culprits):
                    print(geometry, pair, seed, made.culprits, said)
            n = arguments.scenes
            yield f"| {geometry} | {' and '.join(pair)} | {one / n:.3f} | {other / n:.3f} | {both / n:.3f} |"


def unstated(arguments: argparse.Namespace) -> Iterator[str]:
    """Yield what is said of files without fault whose positions are off by more than is stated."""
    yield "| geometry | what is said, of how many files |\n|-|-|"
    for geometry in GEOMETRIES:
        if arguments.geometry not in geometry:
            continue
        told: Counter[str] = Counter()
        for number in range(arguments.scenes):
            seed = 1000 * arguments.seed + number
            made = scene(
                seed, geometry, noise=arguments.noise, lines=arguments.lines,
                position_sd_mm=1e-3 * arguments.position_um,
            )  # fmt: skip
            said = verdicts(made, measured(made, seed), not arguments.no_sd)
            whole = "all channels: " if len(said) == len(made.points) else "some channels: "
            told[whole + ", ".join(sorted(set(said.values()))) if said else "nothing"] += 1
        yield f"| {geometry} | {'; '.join(f'{what} {n}' for what, n in told.most_common())} |"


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
