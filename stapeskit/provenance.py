"""What a result was made from: content hashes of files, versions of packages, the command."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

# Packages that the numbers of some result come from.
_PACKAGES = (
    *("stapeskit", "numpy", "scipy", "scikit-image", "trimesh", "vtk", "pyvista", "pymeshlab"),
    *("connected-components-3d", "h5py", "pandas", "tifffile", "SimpleITK", "nibabel", "pydicom", "zarr"),
    "pyuff",
)

# What other results take from a mass.json: all of it that moves them, and the frames alone.
_RELIED_ON = ("schema", "frames", "inertial_parameters", "mass_matrix")
_FRAMES = ("scan_from_footplate", "scan_from_plate", "z_is", "pose_covariance")


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file's content; of a folder, of the names and contents of its files."""
    path = Path(path)
    if not path.is_dir():
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    digest = hashlib.sha256()
    for file in sorted(entry for entry in path.rglob("*") if entry.is_file()):
        digest.update(os.fsencode(file.relative_to(path)) + b"\0")
        digest.update(bytes.fromhex(sha256(file)))
    return digest.hexdigest()


def input_record(path: Path) -> dict[str, Any]:
    """Describe an input: name, size, UTC time, content hash; of a mass.json its `document_hash` as well."""
    path = Path(path)
    stat = path.stat()
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
    entry: dict[str, Any] = {
        "file": path.name,
        "size_bytes": sum(file.stat().st_size for file in files),
        "modified": datetime.fromtimestamp(stat.st_mtime, UTC).isoformat(timespec="seconds"),
        "hash": f"sha256:{sha256(path)}",
    }
    if path.suffix.lower() == ".json":
        with suppress(ValueError, RecursionError):
            document = json.loads(path.read_text(encoding="utf-8"))
            if isinstance(document, Mapping) and "frames" in document:
                entry["document_hash"] = document_hash(document)
    return entry


def document_hash(document: Mapping[str, Any]) -> str:
    """Return ``sha256:hex`` of the numbers of a mass.json that move other results: not of date or command."""
    return _hash_of_json({key: document[key] for key in _RELIED_ON if key in document})


def frames_hash(document: Mapping[str, Any]) -> str:
    """Return ``sha256:hex`` of the frames of a mass.json: all that a motion takes, whatever the density."""
    frames = document.get("frames", {})
    return _hash_of_json({key: frames.get(key) for key in _FRAMES})


def _hash_of_json(content: Mapping[str, Any]) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return f"sha256:{hashlib.sha256(text.encode()).hexdigest()}"


def versions() -> dict[str, str]:
    """Return the versions of Python, of stapeskit and of the installed packages that numbers come from."""
    from importlib import metadata

    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            # Its line alone: the standard library parses descriptions as mails, a tenth of a second in all.
            text = metadata.distribution(name).read_text("METADATA") or ""
            line = re.search(r"^Version: (\S+)", text, re.MULTILINE)
            found[name] = line[1] if line else metadata.version(name)
    return found


def record(
    inputs: Mapping[str, Path | Mapping[str, Any] | None],
    parameters: Mapping[str, Any],
    command: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Write the ``provenance`` block of a result.

    Inputs are files by their role, or for what is in memory the entry itself; None is left out. The command
    is by default the running command line, the program by its name alone.
    """
    line = [Path(sys.argv[0]).name, *sys.argv[1:]] if command is None else list(command)
    return {
        "inputs": {
            role: dict(source) if isinstance(source, Mapping) else input_record(source)
            for role, source in inputs.items()
            if source is not None
        },
        "versions": versions(),
        "parameters": dict(parameters),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": " ".join(line),
    }
