"""MATLAB files, version 5 to 7.3, as plain values: arrays, texts, lists for cells, dictionaries for structs.

Versions 6 and 7 are read by scipy, 7.3 (which is HDF5) by h5py. A cell array and a struct array become
lists, whatever their shape, in MATLAB's order.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from kinematics.errors import KinematicsError, sentence
from kinematics.readers.hdf5_tree import is_hdf5, matlab_tree, opened

Tree = dict[str, Any]
_HEADER = 128
_COMPRESSED, _MATRIX = 15, 14


def read_mat(path: Path) -> Tree:
    """Read all variables of a MATLAB file.

    Parameters
    ----------
    path : Path

    Returns
    -------
    dict
        Arrays in MATLAB's shape (2-D at least, complex where they are), str, list, dict.

    Raises
    ------
    KinematicsError
        The file is no MATLAB file, is Octave's text format, or is truncated or damaged.
    """
    path = Path(path)
    with path.open("rb") as stream:
        head = stream.read(_HEADER)
    if is_hdf5(path):
        with opened(path, "a MATLAB 7.3 file") as file:
            names = [name for name in file if not name.startswith("#")]
            return {name: matlab_tree(file[name], file, f"{path.name}, {name}") for name in names}
    if head.startswith((b"# Created by Octave", b"# name:")):
        step = "Save it by save -v7 or save -hdf5 ... -v7.3"
        raise KinematicsError(sentence(path.name, "a MATLAB file", "Octave's text format", "", step))
    if head.startswith(b"MATLAB 7.3"):
        step = "It is truncated: copy or export it again"
        raise KinematicsError(sentence(path.name, "a MATLAB 7.3 file", "no HDF5 behind its header", "", step))
    if len(head) < _HEADER or not head.startswith(b"MATLAB 5.0"):
        step = "Save it in MATLAB by save -v7 or save -v7.3"
        raise KinematicsError(
            sentence(path.name, "a MATLAB file of version 5 to 7.3", "other bytes at its start", "", step)
        )
    _check_elements(path, head)
    return _scipy_tree(path)


def _check_elements(path: Path, head: bytes) -> None:
    """Refuse a version 5 file whose elements reach beyond its end, before scipy allocates them."""
    order = "<" if head[126:128] == b"IM" else ">"
    size = path.stat().st_size
    place, count = _HEADER, 0
    with path.open("rb") as stream:
        while place + 8 <= size:
            stream.seek(place)
            kind, length = struct.unpack(order + "II", stream.read(8))
            if kind not in (_COMPRESSED, _MATRIX):
                got = f"an element of type {kind} at byte {place}"
                step = "The file is damaged: export it again"
                raise KinematicsError(sentence(path.name, "made of variables", got, "", step))
            place += 8 + length
            count += 1
    if place > size or (size > _HEADER and count == 0):
        step = "It is truncated: copy or export it again"
        got = f"{size} bytes where its variables need {place} at least"
        raise KinematicsError(sentence(path.name, "a whole MATLAB file", got, "", step))


def _scipy_tree(path: Path) -> Tree:
    from scipy.io import loadmat

    try:
        found = loadmat(path, struct_as_record=False, squeeze_me=False, appendmat=False)
        return {name: _plain(value) for name, value in found.items() if not name.startswith("__")}
    except Exception as fault:  # the parser meets damaged bytes with errors of many kinds
        reason = str(fault).strip().splitlines()[0][:120] if str(fault).strip() else type(fault).__name__
        step = "It is damaged: export it again"
        raise KinematicsError(sentence(path.name, "a readable MATLAB file", reason, "", step)) from fault


def _plain(value: Any, depth: int = 0) -> Any:
    """Turn what scipy returns into arrays, texts, lists and dictionaries."""
    if depth > 8:
        raise ValueError("structs nested deeper than 8")
    if hasattr(value, "_fieldnames"):
        return {name: _plain(getattr(value, name), depth + 1) for name in value._fieldnames}
    if not isinstance(value, np.ndarray):
        return value
    if value.dtype.kind in "US":
        texts = [str(text).rstrip("\0 ") for text in value.reshape(-1)]
        return texts[0] if len(texts) == 1 else texts or ""
    if value.dtype.kind == "O":
        items = list(value.reshape(-1, order="F"))
        single = len(items) == 1 and hasattr(items[0], "_fieldnames")
        return _plain(items[0], depth + 1) if single else [_plain(item, depth + 1) for item in items]
    if value.dtype.names:
        return {}
    return value


def describe(tree: Tree, most: int = 12) -> str:
    """List variables with their shapes, for messages."""
    texts = []
    for name, value in list(tree.items())[:most]:
        if isinstance(value, np.ndarray):
            kind = (
                "complex" if value.dtype.kind == "c" else "numbers" if value.dtype.kind in "fiub" else "other"
            )
            texts.append(f"{name} ({' x '.join(map(str, value.shape))} {kind})")
        elif isinstance(value, dict):
            texts.append(f"{name} (struct of {', '.join(list(value)[:8])})")
        elif isinstance(value, list):
            kind = "struct" if value and isinstance(value[0], dict) else "cell"
            texts.append(f"{name} ({kind} array of {len(value)})")
        else:
            texts.append(f"{name} (text)")
    if len(tree) > most:
        texts.append(f"{len(tree) - most} more")
    return ", ".join(texts) or "no variable"
