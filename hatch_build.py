"""Builds the compiled kernels of every room when stapeskit is installed or packed.

    python hatch_build.py        builds them in place

The system's C compiler comes first (`CC`, cc, gcc, clang), else zig's, a wheel that is required for the
build where there is none. Where nothing compiles, stapeskit is installed without them and computes the same
numbers, more slowly, in numpy, scipy and VTK. `STAPESKIT_KERNELS=numpy` leaves them out on purpose.
"""

from __future__ import annotations

import os
import runpy
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent
FOLDERS = (
    ROOT / "legacy" / "kinematics" / "native",
    ROOT / "legacy" / "ct_inertia" / "native",
    ROOT / "legacy" / "fitting" / "native",
)
# The loader's own rules for the file name, so that what is built is what is looked for.
_LOADER = runpy.run_path(str(ROOT / "legacy" / "stapeskit" / "compiled_kernels.py"))
library_name, built_library = _LOADER["library_name"], _LOADER["built_library"]
FLAGS = ["-O3", "-std=c11", "-ffp-contract=off", "-fno-math-errno", "-fvisibility=hidden", "-shared"]
STRICT = ["-Wall", "-Wextra", "-Werror"]


def system_compiler() -> list[str] | None:
    """Return the command of the system's C compiler, if there is one."""
    given = shlex.split(os.environ.get("CC", ""))
    for command in (given, ["cc"], ["gcc"], ["clang"]):
        if command and shutil.which(command[0]):
            return command
    return None


def compiler() -> list[str] | None:
    """Return the command of a C compiler: the system's, or zig's."""
    command = system_compiler()
    if command is None:
        try:
            import ziglang  # noqa: F401
        except ImportError:
            return None
        command = [sys.executable, "-m", "ziglang", "cc"]
    return command


def build(strict: bool = False) -> list[Path]:
    """Compile the kernels beside their sources; return the libraries, fewer with a word why not."""
    if os.environ.get("STAPESKIT_KERNELS") == "numpy":
        return []
    command = compiler()
    if command is None:
        sys.stderr.write("stapeskit: no C compiler; the kernels are left out, and numpy takes their place\n")
        return [path for folder in FOLDERS if (path := built_library(folder)) is not None]
    built = [build_folder(folder, command, strict) for folder in FOLDERS]
    return [library for library in built if library is not None]


def build_folder(folder: Path, command: list[str], strict: bool) -> Path | None:
    """Compile the sources of one folder into its library."""
    present = built_library(folder)
    if present is not None and not strict:
        return Path(present)
    with tempfile.TemporaryDirectory(dir=folder) as place:
        library = Path(place) / "kernels"
        line = [*command, *FLAGS, *(STRICT if strict else []), "-o", str(library)]
        line += [str(source) for source in sorted(folder.glob("*.c"))]
        line += [] if sys.platform == "win32" else ["-fPIC", "-lm"]
        done = subprocess.run(line, capture_output=True, text=True, check=False)
        if done.returncode or not library.is_file():
            sys.stderr.write(
                f"stapeskit: the kernels could not be compiled; numpy takes their place\n{done.stderr}"
            )
            return None
        for old in folder.glob("kernels-*"):
            old.unlink()
        target = folder / library_name(folder, library.read_bytes())
        library.replace(target)
    return target


try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
except ImportError:  # built in place, without hatchling
    BuildHookInterface = object  # type: ignore[assignment, misc]


class KernelHook(BuildHookInterface):  # type: ignore[type-arg, unused-ignore]
    """Compiles the kernels before a wheel is packed or installed in place."""

    def dependencies(self) -> list[str]:
        """Return what the build needs: zig's compiler where the system has none."""
        off = os.environ.get("STAPESKIT_KERNELS") == "numpy"
        return [] if self.target_name != "wheel" or off or system_compiler() else ["ziglang"]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and tag the wheel for this platform when that worked."""
        del version  # standard or editable: both hold the library
        if self.target_name != "wheel":
            return
        libraries = build()
        if not libraries:
            return
        build_data["pure_python"] = False
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"py3-none-{platform}"
        build_data["artifacts"] += [f"/{library.relative_to(ROOT).as_posix()}" for library in libraries]


if __name__ == "__main__":
    sys.exit(0 if len(build(strict="--strict" in sys.argv)) == len(FOLDERS) else 1)
