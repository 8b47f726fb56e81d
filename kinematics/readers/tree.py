"""Read MATLAB files by scipy.io and HDF5 files, those of MATLAB 7.3 too, by h5py."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kinematics.readers.recording import from_parts
from kinematics.readers.text import CUT
from stapeskit.faults import StapeskitError

if TYPE_CHECKING:
    import h5py

OPAQUE = "a MATLAB string, table or object"
"""What a variable of a class that no library reads (string, table, object) is replaced by."""

_DEEPEST = 8  # groups in groups that are read; links may lead round


def read_tree(path: Path) -> dict[str, Any]:
    """Return variables as arrays, texts, dictionaries and lists of them, and the attributes of a file."""
    with Path(path).open("rb") as stream:
        hdf5 = b"\x89HDF\r\n\x1a\n" in stream.read(1024)
    if hdf5:
        import h5py

        with h5py.File(path, "r") as file:
            return _fields(file, file, 0)
    from scipy.io import loadmat
    from scipy.io.matlab import MatlabFunction, MatlabOpaque

    tree = loadmat(path, squeeze_me=True, simplify_cells=True)
    unread = {name for name, value in tree.items() if isinstance(value, MatlabOpaque | MatlabFunction)}
    plain = {name: value for name, value in tree.items() if not name.startswith("__") and name not in unread}
    return plain | {("a variable" if name == "None" else name): OPAQUE for name in unread}


def _text(value: Any) -> Any:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


def _fields(file: h5py.File, group: h5py.Group, depth: int) -> dict[str, Any]:
    """Return what a group holds: attributes, nodes, and the units that are attributes of nodes."""
    nodes = {name: node for key, node in group.items() if not (name := _text(key)).startswith("#")}
    fields = {_text(name): _text(value) for name, value in group.attrs.items() if name[:7] != "MATLAB_"}
    for name, node in nodes.items():
        unit = next((_text(node.attrs[key]) for key in ("unit", "units") if node and key in node.attrs), None)
        fields |= {} if unit is None else {f"{name} unit": unit}
    return fields | {name: _value(file, node, depth + 1) for name, node in nodes.items()}


def _value(file: h5py.File, node: h5py.Group | h5py.Dataset | None, depth: int) -> Any:
    """Return a node; MATLAB writes dimensions in reverse, texts as numbers, cells as references."""
    import h5py

    if node is None:
        name = Path(file.filename).name
        raise StapeskitError.of("an HDF5 file", "whole", "an object that cannot be opened", name, CUT)
    kind = _text(node.attrs.get("MATLAB_class", b""))
    kind = str(_text(kind.item()) if isinstance(kind, np.generic) else kind)
    if depth > _DEEPEST:
        return {}
    if isinstance(node, h5py.Group):
        fields = _fields(file, node, depth)
        lists = {name: value for name, value in fields.items() if isinstance(value, list)}
        lengths = {len(value) for value in lists.values()}
        if kind == "struct" and len(lists) == len(fields) and len(lengths) == 1:  # a struct array
            return [dict(zip(lists, values, strict=True)) for values in zip(*lists.values(), strict=True)]
        return fields
    if kind == "string" or "MATLAB_object_decode" in node.attrs:
        return OPAQUE
    if node.attrs.get("MATLAB_empty", 0):
        return np.empty(0)
    if h5py.check_ref_dtype(node.dtype) is h5py.Reference:
        return [_value(file, file[reference], depth + 1) for reference in np.asarray(node).T.reshape(-1)]
    if h5py.check_string_dtype(node.dtype) is not None:
        texts = [_text(text) for text in np.asarray(node).reshape(-1).tolist()]
        return texts[0] if node.shape == () else texts
    values = np.asarray(node)
    if kind == "char":
        return "".join(map(chr, values.T.reshape(-1).astype(int).tolist()))
    names = values.dtype.names or ()
    if len(names) == 2:  # a compound of real and imaginary part
        values = from_parts(values[names[0]], values[names[1]])
    return values.T.squeeze() if kind else values
