"""Commands with small inputs whose outputs show which of two runs wrote them."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Workload:
    """A command that can be run in two ways, with different content in every output.

    Attributes
    ----------
    module : str
        Of its entry point ``main``.
    words : tuple of str
        Inputs and fixed options.
    first, second : tuple of str
        The options that distinguish the runs.
    inputs, outputs : tuple of str
        Names in the working folder and in ``out``.
    out : str
        What ``--out`` names within the folder ``out``.
    every : int
        Of the moves of a command that takes long, only each so many-th is disturbed.
    """

    module: str
    words: tuple[str, ...]
    first: tuple[str, ...]
    second: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    out: str = ""
    every: int = 1

    def line(self, second: bool = False) -> list[str]:
        """Return the words of a run."""
        more = self.second if second else self.first
        return [*self.words, *more, "--out", f"out/{self.out}" if self.out else "out"]


WORKLOADS = {
    "ct2mass": Workload(
        "legacy.ct_inertia.cli",
        ("stapes.ply", "--no-report", "--quiet", "--export", "mat"),
        ("--density", "1900", "--side", "left"),
        ("--density", "2000", "--side", "right"),
        ("stapes.ply",),
        ("mass.json", "mass.mat"),
    ),
    "points2dof": Workload(
        "legacy.kinematics.cli",
        ("ldv.csv", "--points", "points.csv", "--quiet"),
        (),
        ("--robust", "huber"),
        ("ldv.csv", "points.csv"),
        ("dof.csv", "dof.h5"),
        "dof.csv",
    ),
    "dof2kd": Workload(
        "legacy.fitting.cli",
        ("dof.csv", "--mass", "M.csv", "--bands", "0", "--estimator", "pinv", "--quiet"),
        (),
        ("--band", "500,4000"),
        ("dof.csv", "dof.h5", "M.csv"),
        ("kd.json", "kd.html"),
        "kd.json",
    ),
    "scan2kd": Workload(
        "legacy.pipeline.cli",
        ("--quiet",),
        ("study.toml",),
        ("second.toml",),
        ("study.toml", "second.toml", "stapes.ply", "ldv.csv", "points.csv", "fiducials.csv"),
        ("mass.json", "kd.json", "report.html"),
        every=4,
    ),
}


def make_inputs(folder: Path) -> None:
    """Write the inputs of every workload."""
    import numpy as np

    from legacy.stapeskit.records.motion_files import write_motion
    from tests.fitting.cases import M, paper_motion
    from tests.pipeline.ears import make_ear

    study = make_ear(folder)
    text = study.read_text(encoding="utf-8").replace("[fit]", "[fit]\nestimator = 'pinv'\nbands = 0")
    study.write_text(text, encoding="utf-8")
    (folder / "second.toml").write_text(text.replace("1382.4", "1500"), encoding="utf-8")
    header, *rows = (folder / "ldv.csv").read_text(encoding="utf-8").splitlines()
    place = header.split(",").index("freq_hz")
    lines = sorted({row.split(",")[place] for row in rows}, key=float)[::10]
    few = [row for row in rows if row.split(",")[place] in lines]
    (folder / "ldv.csv").write_text("\n".join([header, *few]) + "\n", encoding="utf-8")
    motion = paper_motion(0.05, 0, lines=60)
    ones = np.ones_like(motion.chi2)
    write_motion(folder, "dof", replace(motion, chi2=42.0 * ones, n_dof=42.0 * ones))
    np.savetxt(folder / "M.csv", M, delimiter=",")


def undrawn() -> None:
    """Leave the drawing away, which takes most of the time and is no matter here."""
    from markupsafe import Markup

    from legacy import ct_inertia, kinematics, stapeskit

    ct_inertia.report.pictures.render_scenes = lambda scenes: [b"png" for _ in scenes]
    stapeskit.page.page.figure = lambda *_, **__: Markup("<figure></figure>")  # type: ignore[assignment]
    kinematics.report.sections.write_report = (  # type: ignore[assignment]
        lambda path, *_: Path(path).write_text("page", encoding="utf-8")
    )


def start(
    workload: Workload, folder: Path, second: bool = False, before: Callable[[], object] | None = None
) -> int:
    """Fork a process that runs a command as its user would; return its number.

    What it prints on standard error is in the file ``stderr`` beside ``folder``.
    """
    child = os.fork()
    if child:
        return child
    code = 71
    try:
        code = _run(workload, folder, second, before)
    finally:
        os._exit(code)  # whatever happens: nothing of the harness runs in this process


def _run(workload: Workload, folder: Path, second: bool, before: Callable[[], object] | None) -> int:
    os.chdir(folder)
    os.dup2(os.open(f"{folder}.stderr", os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666), 2)
    os.dup2(os.open(os.devnull, os.O_RDWR), 1)
    sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
    sys.argv = [workload.module.partition(".")[0], *workload.line(second)]
    os.closerange(3, 256)  # of the harness
    main = import_module(workload.module).main
    if before is not None:
        before()
    try:
        main()
    except SystemExit as left:
        with suppress(OSError):
            sys.stderr.flush()
        return left.code if isinstance(left.code, int) else 70
    except BaseException as fault:
        os.write(2, f"{type(fault).__name__}: {fault}\n".encode())
    return 71


def told(folder: Path) -> str:
    """Return what the last run printed on standard error, but for warnings."""
    text = Path(f"{folder}.stderr").read_text(encoding="utf-8", errors="replace")
    return "\n".join(line for line in text.splitlines() if not line.startswith("warning ["))
