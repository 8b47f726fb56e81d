"""A damaged file of any kind ends in values or in one refusal: no traceback, no crash, no hang.

Every format of scans and vibrometer files, as the contracts of the readers write them, and the records and
tables that the commands read, each damaged at random: bytes changed, zeroed, removed or put in, the end cut
off, a part written twice; half of the places lie in the first 600 bytes, where headers are. "Longest" is the
processor time of one file, the child process that reads it included.

    python -m benchmarks.damaged_files --files 4000
"""

from __future__ import annotations

import resource
import signal
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import stapeskit
from benchmarks._table import arguments, print_table
from ct_inertia.frames.fiducials import read_plate_fiducials
from ct_inertia.frames.landmarks import read_landmarks
from ct_inertia.scan.open_scan import open_scan
from ct_inertia.scan.raw import RawLayout
from ct_inertia.surface.repair import read_mesh
from fitting.mass import read_mass_csv
from kinematics.readers.formats import read_file
from kinematics.readers.points import read_points
from pipeline.study import read_study
from simulate import Ear, Experiment, Scan, Stapes, simulate_study, write_scan
from stapeskit.faults import StapeskitError
from stapeskit.records.mass_file import read_mass_json
from stapeskit.records.motion_file import read_motion
from tests.motion_files.written_files import OTHERS
from tests.motion_files.written_files import WRITERS as RECORDINGS
from tests.scan_files.scan_cases import CASES as SCANS
from tests.scan_files.scan_cases import Case
from tests.scan_files.scan_writers import SPACING, picture

Read = Callable[[Path], Any]
HANG_S = 60
"""Wall time after which a file counts as one that hangs."""
EAR = Ear(stapes=Stapes(family="analytic"), plate=False, bone=False)
LANDMARKS = "name,x_mm,y_mm,z_mm\nanterior,1,2,3\nposterior,-1,2,3\n"
PLATE_MARKS = "name,x_mm,y_mm,z_mm\nA,1,2,3\nB,-1,2,3\nC,1,-2,3\nD,1,2,-3\n"


def cases(folder: Path) -> Iterator[tuple[str, Path, Read]]:
    """Yield kinds of files: name, a file or folder that is whole, and its reader."""
    for number, (entry, (name, case)) in enumerate({one.entry: (n, one) for n, one in SCANS.items()}.items()):
        (folder / f"{number}").mkdir()
        path = case.write(folder / f"{number}" / name, picture(case.types[0]), **case.options)
        yield f"scan, {entry}", path, partial(read_scan, case=case)
    for name, write in (RECORDINGS | OTHERS).items():
        (folder / name).mkdir()
        path, facts = write(folder / name)
        yield f"vibrometer, {name}", path, partial(read_file, facts=facts)
    study = folder / "study"
    truth = simulate_study(EAR, Scan(voxel_um=60.0), Experiment(lines=20, seed=1, in_footplate=True), study)
    yield "mesh", write_scan(study, truth.placed, Scan(voxel_um=60.0, format="ply")), read_mesh
    stapeskit.ct2mass(study / "scan.tif", density="1900+-60").write(study / "mass")
    motion = stapeskit.points2dof(study / "ldv.csv", mass=study / "mass" / "mass.json", frame="footplate")
    motion.write(study / "dof")
    (study / "landmarks.csv").write_text(LANDMARKS, encoding="utf-8")
    (study / "plate.csv").write_text(PLATE_MARKS, encoding="utf-8")
    np.savetxt(study / "M.csv", truth.mass_matrix_si[1::2, 1::2], delimiter=",")
    yield "mass.json", study / "mass" / "mass.json", read_mass_json
    yield "dof.csv", next((study / "dof").glob("*dof.csv")), read_motion
    yield "dof.h5", next((study / "dof").glob("*dof.h5")), read_motion
    yield "M.csv", study / "M.csv", lambda path: read_mass_csv(path, ("y", "alpha", "gamma"))
    yield "points.csv", study / "points.csv", read_points
    yield "landmarks", study / "landmarks.csv", read_landmarks
    yield "plate fiducials", study / "plate.csv", read_plate_fiducials
    yield "study.toml", study / "study.toml", read_study


def read_scan(path: Path, case: Case) -> Any:
    """Open a scan and read all of it."""
    layout = None if case.raw is None else RawLayout((5, 6, 7), case.types[0], **case.raw)
    return open_scan(path, spacing_mm=SPACING if case.asks else None, raw=layout).read()


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """Return a file's content with one to three places damaged."""
    part = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        end = max(min(len(part), 600) if rng.random() < 0.5 else len(part), 1)
        place, length = int(rng.integers(end)), int(rng.integers(1, 17))
        behind = part[place + length :]
        noise = rng.integers(0, 256, length).astype("u1").tobytes()
        kind = rng.integers(6)
        part[place:] = [
            noise + behind, bytes(length) + behind, behind, noise + part[place:], b"",
            part[place : place + length] * 2 + behind,
        ][kind]  # fmt: skip
    return bytes(part)


def outcome(read: Read, path: Path) -> str:
    """Return what came of one file: "read", "refused", or the name of any other exception."""
    signal.alarm(HANG_S)
    try:
        read(path)
    except StapeskitError:
        return "refused"
    except Exception as error:
        return type(error).__name__
    finally:
        signal.alarm(0)
    return "read"


def spent_s() -> float:
    """Return the processor time of this process and of its children that ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def outcomes(name: str, path: Path, read: Read, count: int, first: int) -> tuple[Counter[str], float]:
    """Damage a kind of file many times; return what came of it, and the longest processor time."""
    read(path)
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    whole = {file: file.read_bytes() for file in files}
    found, longest = Counter[str](), 0.0
    for seed in range(first, first + count):
        rng = np.random.default_rng([seed, sum(map(ord, name))])
        file = files[rng.integers(len(files))]
        file.write_bytes(damaged(whole[file], rng))
        before = spent_s()
        found[outcome(read, path)] += 1
        longest = max(longest, spent_s() - before)
        file.write_bytes(whole[file])
    return found, longest


def _too_long(*_: object) -> None:
    raise TimeoutError


if __name__ == "__main__":
    given = arguments(__doc__, files=100, first=0)
    signal.signal(signal.SIGALRM, _too_long)
    with tempfile.TemporaryDirectory() as place:
        groups = dict[str, list[tuple[Counter[str], float]]]()
        for case in cases(Path(place)):
            group = case[0].split(",")[0] if "," in case[0] else "records and tables"
            groups.setdefault(group, []).append(outcomes(*case, given.files, given.first))
    rows = list[list[object]]()
    for group, parts in groups.items():
        total = sum((part for part, _ in parts), Counter[str]())
        other = [f"{n} {what}" for what, n in total.items() if what not in ("read", "refused")]
        longest = f"{max(seconds for _, seconds in parts):.2f}"
        found = (len(parts), total.total(), total["read"], total["refused"], ", ".join(other) or 0, longest)
        rows.append([group, *found])
    print_table(("files", "kinds", "damaged", "read", "refused", "anything else", "longest, s"), rows)
