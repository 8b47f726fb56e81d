"""The table of exports of K, D and M.

An export is a module of fitting.exports with a function ``content(fit) -> bytes`` and one line in this table;
option, help and the contract test follow from it.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from fitting.errors import FittingError

EXPORTS: dict[str, str] = {
    "mat": "K, D, M with covariance for MATLAB and Octave (X.mat)",
    "csv": "entries with sd, interval and covariance (X.entries.csv)",
    "tex": "matrices as LaTeX (X.tex)",
    "inp": "springs, dashpots and masses for CalculiX and Abaqus (X.inp)",
    "mjcf": "a MuJoCo model with K and D as tendons (X.xml)",
    "joint": "M, K, D and shared errors with their joint covariance (X.joint.json)",
    "methods": "a paragraph on the methods (X.methods.txt)",
}
_ENDINGS = {"csv": ".entries.csv", "mjcf": ".xml", "joint": ".joint.json", "methods": ".methods.txt"}


def file_name(stem: str, name: str) -> str:
    """Return the file of an export beside ``stem``.json."""
    return f"{stem}{_ENDINGS.get(name, f'.{name}')}"


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
    text: bytes = import_module(f"fitting.exports.{name}").content(fit)
    return text
