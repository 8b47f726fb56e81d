"""Compare what the commands give with what was recorded: python -m tests.golden, or make golden.

    make golden                                    every scene
    make golden ARGS="--room ct -j 2"              the scenes of a room: ct, points, kd, pipeline
    make golden ARGS="--only fault_ --messages"    scenes whose names match; messages must agree too
    make golden-record ARGS="--only kd_plan"       record these anew (without ARGS: all)

Numbers agree to 1e-9 (compare.py says what counts as zero), words, codes of warnings and exit codes exactly.
Places that come anew and changed prose are reported and do not fail. After a rename of keys put a line into
renamed.toml: "old pattern" = "new name"; record anew when the step has landed. Scenes stand in scenes.py.

Standard deviations of K, D and the modes come from numerical derivatives: another order of the same sums
moves them by some 1e-8 (--rtol 1e-7 shows whether that is all). Points laid on surfaces are chosen anew
after a change of rounding (points_surfaces_calibrate, points_plate_and_fiducials). A processor without
AVX-512 has other rounding: compare with what the last commit gives there.
"""

from __future__ import annotations

import argparse
import json
import lzma
import multiprocessing
import multiprocessing.connection
import os
import re
import shutil
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
RESULTS = HERE / "results"
LIMIT_S = 240.0
PRELOADED = (
    "numpy scipy.optimize scipy.ndimage scipy.spatial scipy.stats scipy.sparse.linalg scipy.special "
    "scipy.signal scipy.interpolate h5py pandas tifffile SimpleITK matplotlib.figure "
    "matplotlib.backends.backend_svg matplotlib.backends.backend_agg trimesh jinja2 skimage.measure"
)
# One thread, plain drawing, and child processes that import this checkout.
SETTINGS = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "PYTHONHASHSEED": "0",
    "MPLBACKEND": "agg",
}
# OpenBLAS orders sums by the make of the processor: the records are those of this one, which any with AVX-512
# can run. Elsewhere 63 scenes move by 1e-9 to 1e-6.
RECORDED_ON = {"OPENBLAS_CORETYPE": "SkylakeX"}


def main() -> None:
    """Run the chosen scenes and leave with 1 when one differs."""
    _settle()
    from tests.golden.scenes import ROOMS, SCENES

    parser = argparse.ArgumentParser(
        prog="golden", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", metavar="PATTERN", help="scenes whose names hold this pattern")
    parser.add_argument("--room", action="append", choices=ROOMS)
    parser.add_argument("-j", type=int, default=1, metavar="N", help="processes")
    parser.add_argument("--record", action="store_true", help="record instead of comparing")
    parser.add_argument("--messages", action="store_true", help="let changed prose fail too")
    parser.add_argument("--rtol", type=float, default=1e-9)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="leave the scenes' folders here")
    parser.add_argument("--list", action="store_true")
    given = parser.parse_args()
    chosen = [
        scene.name
        for scene in SCENES
        if re.search(given.only, scene.name) and (not given.room or scene.room in given.room)
    ]
    if given.list or not chosen:
        print("\n".join(chosen) or "no scene of that name; --list shows them")
        raise SystemExit(int(not chosen))
    raise SystemExit(_all(chosen, given))


def _settle() -> None:
    """Set the environment, and start anew where that must be done before Python starts."""
    paths = [str(ROOT), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    wanted = SETTINGS | {"PYTHONPATH": os.pathsep.join(dict.fromkeys(paths))}
    flags = Path("/proc/cpuinfo")
    if flags.exists() and "avx512vl" in flags.read_text(encoding="ascii", errors="replace"):
        wanted |= RECORDED_ON
    if any(os.environ.get(name) != value for name, value in wanted.items()):
        os.environ.update(wanted)
        os.execv(sys.executable, [sys.executable, "-m", "tests.golden", *sys.argv[1:]])


def _all(chosen: list[str], given: argparse.Namespace) -> int:
    from tests.golden.inputs import unpack

    started = time.perf_counter()
    for folder in sorted({path.parent for path in ROOT.glob("[!.]*/**/*.c")}):
        if not list(folder.glob("kernels-*")):
            print(
                f"{folder.relative_to(ROOT)}: not compiled; numpy's numbers differ by up to 1e-6 (make setup)"
            )
    _preload()
    with tempfile.TemporaryDirectory(prefix="golden") as temporary:
        base = Path(temporary) if given.keep is None else given.keep.resolve()
        inputs = unpack(Path(temporary) / "inputs")
        failed = 0
        for name, ran in _results(chosen, base, inputs, given.j):
            failed += _record(name, ran) if given.record else _judge(name, ran, given)
            sys.stdout.flush()
    if given.record:
        _summarise()
    seconds = time.perf_counter() - started
    if failed:
        print(f"GOLDEN: {failed} of {len(chosen)} scenes differ ({seconds:.0f} s)")
    else:
        print(f"GOLDEN: {len(chosen)} scenes {'recorded' if given.record else 'agree'} ({seconds:.0f} s)")
    return int(failed > 0)


def _preload() -> None:
    """Import what the commands use, once for all scenes; a scene runs in a fork of this process."""
    import importlib

    for name in PRELOADED.split():
        importlib.import_module(name)


def _results(names: list[str], base: Path, inputs: Path, processes: int) -> Any:
    """Yield the name and the result of every scene in their order, ``processes`` at a time."""
    fork = multiprocessing.get_context("fork")
    waiting, running, done = list(names), {}, {}
    for name in names:
        while name not in done:
            while waiting and len(running) < max(1, processes):
                new = waiting.pop(0)
                ours, theirs = fork.Pipe(duplex=False)
                child = fork.Process(target=_child, args=(new, base / new, inputs, theirs))
                child.start()
                theirs.close()
                running[new] = child, ours, time.perf_counter()
            ready = multiprocessing.connection.wait([one[1] for one in running.values()], 1.0)
            for key, (child, pipe, since) in list(running.items()):
                late = time.perf_counter() - since > LIMIT_S
                if pipe not in ready and not late:
                    continue
                try:
                    done[key] = {"table": {}, "s": LIMIT_S, "fault": "too slow"} if late else pipe.recv()
                except EOFError:
                    done[key] = {"table": {}, "s": 0.0, "fault": "the process died"}
                if late:
                    child.kill()
                child.join()
                del running[key]
        yield name, done.pop(name)


def _child(name: str, folder: Path, inputs: Path, pipe: Any) -> None:
    import traceback

    started = time.perf_counter()
    try:
        result = {"table": _scene(name, folder, inputs), "fault": ""}
    except BaseException:
        result = {"table": {}, "fault": traceback.format_exc()}
    pipe.send(result | {"s": time.perf_counter() - started})
    pipe.close()


def _scene(name: str, folder: Path, inputs: Path) -> dict[str, Any]:
    """Run a scene in its folder and return its table."""
    from tests.golden import collect
    from tests.golden.commands import run, terminal_codes
    from tests.golden.scenes import SCENES

    scene = next(one for one in SCENES if one.name == name)
    if folder.exists():
        shutil.rmtree(folder)
    shutil.copytree(inputs, folder / "in", copy_function=os.link)
    (folder / "sample").symlink_to(ROOT / "sample_volumes")
    os.chdir(folder)
    told = scene.prepare(folder) if scene.prepare else []
    table: dict[str, Any] = {}
    for number, step in enumerate(scene.steps, 1):
        command, *arguments = step.format(*told).split()
        of_page = command.startswith("page:")
        if of_page:
            Path("out").mkdir()
        ran = run(command, arguments if of_page else [*arguments, "--json"])
        start = f"step {number} {command.removeprefix('page:')}"
        table[f"{start} exit code"] = ran.code
        table[f"{start} terminal codes"] = terminal_codes(ran.err)
        if ran.code:
            table[f"{start} message"] = {"prose": [ran.err.replace(str(folder), "")[-4000:]]}
        elif of_page:
            cells = collect.table_cells(Path(arguments[0]).read_text(encoding="utf-8"))
            table[f"{start} cells"] = {"cells": cells}
        else:
            table |= {f"{start} stdout:{place}": v for place, v in collect.of_json(json.loads(ran.out))}
    table |= collect.collect(folder / "out")
    if "--keep" not in sys.argv:
        os.chdir("/")
        shutil.rmtree(folder)
    return table


def _file(name: str) -> Path:
    return RESULTS / f"{name}.json.xz"


def _record(name: str, ran: dict[str, Any]) -> int:
    if ran["fault"]:
        print(f"FAILED  {name}: {ran['fault']}")
        return 1
    lines = [json.dumps({place: value}) for place, value in ran["table"].items()]
    RESULTS.mkdir(exist_ok=True)
    _file(name).write_bytes(lzma.compress("\n".join(lines).encode(), preset=9))
    print(f"recorded {name} ({ran['s']:.1f} s): {_in_words(ran['table'])}")
    return 0


def _recorded(name: str) -> dict[str, Any]:
    table: dict[str, Any] = {}
    for line in lzma.decompress(_file(name).read_bytes()).decode().splitlines():
        table |= json.loads(line)
    return table


def _judge(name: str, ran: dict[str, Any], given: argparse.Namespace) -> int:
    """Print one line about a scene, and its differences; return 1 when it fails."""
    from tests.golden.compare import differences

    if ran["fault"] or not _file(name).is_file():
        print(f"FAILED  {name}: {ran['fault'] or 'not recorded'}")
        return 1
    renamed = tomllib.loads((HERE / "renamed.toml").read_text(encoding="utf-8"))
    table = json.loads(json.dumps(ran["table"]))
    found = differences(_recorded(name), table, renamed, given.rtol)
    soft = ("added",) if given.messages else ("added", "message")
    bad = _once([one for one in found if one.kind not in soft])
    codes = [one for one in bad if "code" in one.place]
    noted = [one for one in found if one.kind in soft]
    notes = f", {len(noted)} notes" if noted else ""
    sizes = [one.relative for one in bad if one.kind == "number"]
    worst = f", {len(bad)} differences, numbers up to {max(sizes):.1g}" if sizes else ""
    print(f"{'DIFFERS' if bad else 'agrees '} {name} ({ran['s']:.1f} s{worst}{notes})")
    for one in [*codes, *(one for one in bad if one not in codes)][:40]:
        print(f"    {one}")
    if len(bad) > 40:
        print(f"    ... and {len(bad) - 40} more")
    for one in noted[:12]:
        print(f"    ({one})")
    return int(bool(bad))


def _once(found: list[Any]) -> list[Any]:
    """Leave out of the printed JSON what differs in a file just so."""
    in_files = {one.place.partition(":")[2] for one in found if not one.place.startswith("step")}
    return [one for one in found if not (" stdout:" in one.place and one.place.partition(":")[2] in in_files)]


def _summarise() -> None:
    """Write a line about every scene beside the results, for people and for reviews."""
    from tests.golden.scenes import SCENES

    lines = [
        f"{scene.name}: {_in_words(_recorded(scene.name))}" for scene in SCENES if _file(scene.name).is_file()
    ]
    (RESULTS / "summary.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    for path in RESULTS.glob("*.json.xz"):
        if path.name.removesuffix(".json.xz") not in {scene.name for scene in SCENES}:
            path.unlink()


def _in_words(table: dict[str, Any]) -> str:
    """Return exit codes, key results and codes of warnings of a scene."""
    exits = [str(value) for place, value in table.items() if place.endswith("exit code")]
    count = sum(len(value.get("n", ())) for value in table.values() if isinstance(value, dict))
    parts = [f"exit {', '.join(exits)}", f"{count} numbers"]
    for key, words in (("mass_kg", "mass"), ("stiffness_si", "K11"), ("modes[0].frequency_hz", "mode 1")):
        place = next((p for p in table if p.split(":")[-1] == key), None)
        if place is not None:
            parts.append(f"{words} {table[place]['n'][0]:.6g}")
    codes = [code for place, value in table.items() if place.endswith("terminal codes") for code in value]
    if exits and exits[-1] != "0":
        message = next((v["prose"][0] for p, v in table.items() if p.endswith("message")), "")
        parts.append(message.strip().splitlines()[0][:90] if message.strip() else "no message")
    return ", ".join(parts) + (f"; {' '.join(codes)}" if codes else "")


if __name__ == "__main__":
    main()
