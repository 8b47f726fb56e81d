"""MATLAB files, version 4 to 7.3, as plain values: arrays, texts, lists for cells, dictionaries for structs.

Version 7.3 is HDF5 and read by h5py. A cell array and a struct array become
lists, whatever their shape, in MATLAB's order.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.containers.hdf5_file import is_hdf5, matlab_tree, read_hdf5
from legacy.kinematics.readers.containers.mat4 import is_mat4, read_mat4
from legacy.kinematics.readers.containers.mat5 import read_mat5

Tree = dict[str, Any]
# Bytes before the first element (MAT-File Format, level 5).
_HEADER = 128


def read_mat(path: Path) -> Tree:
    """Read all variables of a MATLAB file.

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
        return read_hdf5(path, "a MATLAB 7.3 file", lambda file: _variables(file, path.name))
    if head.startswith((b"# Created by Octave", b"# name:")):
        step = "Save it by save -v7 or save -hdf5 ... -v7.3"
        raise KinematicsError.of(path.name, "a MATLAB file", "Octave's text format", "", step)
    if head.startswith(b"MATLAB 7.3"):
        step = "It is truncated: copy or export it again"
        raise KinematicsError.of(path.name, "a MATLAB 7.3 file", "no HDF5 behind its header", "", step)
    if is_mat4(head):
        return read_mat4(path)
    if len(head) < _HEADER or not head.startswith(b"MATLAB 5.0"):
        step = "Save it in MATLAB by save -v7 or save -v7.3"
        raise KinematicsError.of(
            path.name, "a MATLAB file of version 4 to 7.3", "other bytes at its start", "", step
        )
    return read_mat5(path)


def _variables(file: Any, where: str) -> Tree:
    names = [name for name in file if isinstance(name, str) and not name.startswith("#")]
    return {name: matlab_tree(file[name], file, f"{where}, {name}") for name in names}


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
