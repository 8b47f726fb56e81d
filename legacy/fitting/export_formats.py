"""The table of exports of K, D and M.

An export is a module of fitting.exports with a function ``content(fit) -> bytes`` and one line in this table;
option, help and the contract test follow from it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from legacy.fitting.errors import FittingError
from legacy.stapeskit.own_files import OutputSet


class Export(NamedTuple):
    """An entry: what the export holds, for the help, and how its file ends behind the name of the result."""

    content: str
    ending: str

    @property
    def summary(self) -> str:
        """The content and the file, for the help."""
        return f"{self.content} (X{self.ending})"


EXPORTS = {
    "mat": Export("K, D, M with covariance for MATLAB and Octave", ".mat"),
    "csv": Export("entries with sd, interval and covariance", ".entries.csv"),
    "tex": Export("matrices as LaTeX", ".tex"),
    "inp": Export("springs, dashpots and masses for CalculiX and Abaqus", ".inp"),
    "mjcf": Export("a MuJoCo model with K and D as tendons", ".xml"),
    "joint": Export("M, K, D and shared errors with their joint covariance", ".joint.json"),
    "methods": Export("a paragraph on the methods", ".methods.txt"),
}


def file_name(stem: str, name: str) -> str:
    """Return the file of an export beside ``stem``.json."""
    return f"{stem}{EXPORTS[name].ending}"


def file_names(name: str, export: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the names of a result ``name``, X.json: itself, its page X.html, and its exports."""
    page = Path(name).with_suffix(".html").name
    return (name, page, *(file_name(Path(name).stem, kind) for kind in export))


def output_set(
    folder: Path, name: str, read: Iterable[Path], force: bool, export: Sequence[str] = ()
) -> OutputSet:
    """Return the files that a run may write, and the exports that runs with other options may have left."""
    others = [kind for kind in EXPORTS if kind not in export]
    leftovers = file_names(name, others)[2:]
    return OutputSet("dof2kd", folder, file_names(name, export), tuple(read), force, leftovers)


def json_name(out: Path) -> Path:
    """Return the name of a result file.

    Raises
    ------
    FittingError
        It does not end with .json.
    """
    out = Path(out)
    if out.suffix.lower() != ".json":
        step = f"Give {{out}} {out.with_suffix('.json').name}" if out.name else "Give {out} kd.json"
        raise FittingError.of("{out}", "a file name that ends with .json", out.name or out, "", step)
    return out


def exported(fit: Any, name: str) -> bytes:
    """Return the content of an export of a fit (fitting.kd_fit.KDFit)."""
    text: bytes = import_module(f"legacy.fitting.exports.{name}").content(fit)
    return text
