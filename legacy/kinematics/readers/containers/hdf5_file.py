"""HDF5 files as plain values: sizes checked against what the file holds before anything is allocated."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.recording import from_parts
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.guard import read_apart

Result = TypeVar("Result")
SIGNATURE = b"\x89HDF\r\n\x1a\n"
# Data above 64 MB must not be packed better than deflate can (1032 to one): else the sizes lie.
_SMALL = 64 << 20
_BEST_PACKING = 1100
# Nesting of structs; vibrometer exports have two or three.
_DEEPEST = 8
_CLASSES = {"", "double", "single", "logical", "char", "cell", "struct"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}


def is_hdf5(path: Path) -> bool:
    """Return whether the HDF5 signature is at a permitted place: at byte 0, 512, 1024, ..."""
    with Path(path).open("rb") as stream:
        for place in (0, 512, 1024, 2048, 4096):
            stream.seek(place)
            if stream.read(8) == SIGNATURE:
                return True
    return False


def read_hdf5(path: Path, wanted: str, content: Callable[[Any], Result]) -> Result:
    """Return what ``content`` makes of an open file; whatever is wrong with its bytes becomes a message.

    Raises
    ------
    KinematicsError
        The file is truncated or damaged, or holds up or crashes the HDF5 library.
    """
    return read_apart(lambda: _content(path, wanted, content), path, wanted, KinematicsError)


def _content(path: Path, wanted: str, content: Callable[[Any], Result]) -> Result:
    import h5py

    step = "It is truncated or damaged: copy or export it again"
    try:
        with h5py.File(path, "r") as file:
            return content(file)
    except StapeskitError:
        raise
    except (OSError, RuntimeError, LookupError, MemoryError, TypeError, ValueError, AttributeError) as fault:
        reason = str(fault).strip().splitlines()[0][:120] if str(fault).strip() else type(fault).__name__
        raise KinematicsError.of(wanted, "readable", reason, Path(path).name, step) from fault


def array_of(dataset: Any, where: str) -> np.ndarray[Any, Any]:
    """Read a data set.

    Raises
    ------
    KinematicsError
        It claims more than its stored bytes can unpack to.
    """
    wanted = int(dataset.size or 0) * dataset.dtype.itemsize
    stored = int(dataset.id.get_storage_size())
    if wanted > _SMALL and wanted > _BEST_PACKING * max(stored, 1):
        step = "The file is truncated or damaged: export it again"
        got = f"{wanted} bytes from {stored} stored"
        raise KinematicsError.of("a data set", "as large as the file can hold", got, where, step)
    return np.asarray(dataset[()])


def text_of(value: Any) -> str:
    """Return an attribute or scalar as text."""
    if isinstance(value, np.ndarray):
        value = value.reshape(-1)[0] if value.size else ""
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def texts_of(values: np.ndarray[Any, Any]) -> list[str]:
    """Return a data set of strings as a list, without their padding."""
    return [text_of(value).strip().strip("\0") for value in np.asarray(values).reshape(-1)]


def complex_of(values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return compound numbers with the fields real, imag or r, i as complex ones, others as they are."""
    names = values.dtype.names
    if names and len(names) == 2:
        return from_parts(values[names[0]], values[names[1]])
    return values


def matlab_tree(node: Any, file: Any, where: str, depth: int = 0) -> Any:
    """Return a variable of a MATLAB 7.3 file as an array, text, list (cell) or dictionary (struct).

    Raises
    ------
    KinematicsError
        A data set claims more than the file holds, or structs are nested deeper than 8.
    """
    import h5py

    if depth > _DEEPEST:
        raise KinematicsError.of("structs", f"nested at most {_DEEPEST} deep", "deeper", where)
    if isinstance(node, h5py.Group):
        if not all(isinstance(name, str) for name in node):
            raise KinematicsError.of("the names in the file", "text in UTF-8", "others", where)
        fields = {name: matlab_tree(node[name], file, f"{where}.{name}", depth + 1) for name in node}
        lists = [
            name for name in node if _is_references(node[name]) and "MATLAB_class" not in node[name].attrs
        ]
        if fields and len(lists) == len(fields) and len({len(fields[name]) for name in lists}) == 1:
            count = len(fields[lists[0]])
            return [{name: fields[name][k] for name in lists} for k in range(count)]
        return fields
    kind = text_of(node.attrs.get("MATLAB_class", ""))
    if node.attrs.get("MATLAB_empty", 0):
        return (
            [] if kind == "cell" else {} if kind == "struct" else "" if kind == "char" else np.empty((0, 0))
        )
    if kind not in _CLASSES:
        return {}
    values = array_of(node, where)
    if _is_references(node):
        places = values.T.reshape(-1, order="F")
        return [
            matlab_tree(file[place], file, f"{where}{{{k}}}", depth + 1) for k, place in enumerate(places, 1)
        ]
    if kind == "char":
        rows = np.atleast_2d(values.astype(np.uint16).T)
        texts = [row.tobytes().decode("utf-16-le", "replace").rstrip("\0 ") for row in rows]
        return texts[0] if len(texts) == 1 else texts
    return complex_of(values).T


def _is_references(node: Any) -> bool:
    import h5py

    return isinstance(node, h5py.Dataset) and h5py.check_ref_dtype(node.dtype) is h5py.Reference
