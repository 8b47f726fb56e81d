"""Gather every number and word of a scene's outputs into one flat table: ``file:place`` -> value.

A value is a number array (list of numbers with its shape), a word, or prose. Left out by key are dates,
durations, paths, versions and check sums, and of provenance everything but its keys. Pages and pictures are
not read.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

LEFT_OUT = re.compile(
    r"(^|_)(date|time|seconds|path|files?|folder|out|version|versions|hash|sha256|xxh\w*|size_bytes|modified"
    r"|command|reason|csv_hash|content_hash|mass_hash)$"
)
KEYS_ONLY = re.compile(r"^(provenance|records?)$")
PROSE_KEYS = re.compile(r"^(text|notes?|said|inputs_say|summary|method|words?|why|meaning|message)$")
NOT_READ = {".html", ".png", ".svg", ".glb", ".txt", ".mtl"}
TIME = re.compile(r"\d+\.\d+ s\b|\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d\S*")
LARGEST = 2500

Table = dict[str, Any]


def collect(folder: Path) -> Table:
    """Return the table of all files below a folder; hidden folders (records of stages) are left out."""
    table: Table = {}
    names = [
        path
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    ]
    table["files"] = [path.relative_to(folder).as_posix() for path in names]
    for path in names:
        name = path.relative_to(folder).as_posix()
        if path.suffix in NOT_READ:
            continue
        for place, value in _read(path):
            table[f"{name}:{place}"] = value
    return table


def _read(path: Path) -> Iterator[tuple[str, Any]]:
    ending = path.suffix.lower()
    if ending == ".json":
        yield from of_json(json.loads(path.read_text(encoding="utf-8")))
    elif ending == ".csv":
        yield from _of_csv(path.read_text(encoding="utf-8"))
    elif ending == ".h5":
        yield from _of_hdf5(path)
    elif ending == ".nrrd":
        yield from _of_nrrd(path)
    elif ending in (".ply", ".stl", ".obj"):
        yield from _of_mesh(path)
    elif ending == ".mat":
        yield from _of_mat(path)
    else:
        text = path.read_text(encoding="utf-8", errors="replace")
        yield from _of_text(TIME.sub("", text) if ending == ".log" else text)


def of_json(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Flatten what JSON holds; of warnings the codes are words in order, their texts prose."""
    if isinstance(value, dict):
        for key, entry in value.items():
            here = f"{place}.{key}" if place else key
            if KEYS_ONLY.match(key) and isinstance(entry, dict):
                yield f"{here} keys", sorted(entry)
            elif key == "warnings" and isinstance(entry, list):
                yield f"{here} codes", [one.get("code", "") for one in entry if isinstance(one, dict)]
                yield f"{here} texts", {"prose": [str(one.get("text", "")) for one in entry]}
            elif LEFT_OUT.search(key):
                continue
            elif PROSE_KEYS.match(key) and not isinstance(entry, dict):
                yield here, {"prose": [str(entry)]}
            else:
                yield from of_json(entry, here)
    elif isinstance(value, list):
        numbers = _as_numbers(value)
        if numbers is not None:
            yield place, numbers
        elif value and all(isinstance(entry, str | None) for entry in value):
            yield place, value if all(_is_word(v) for v in value if v) else {"prose": [str(v) for v in value]}
        else:
            yield f"{place} length", packed(np.array(float(len(value))))
            for number, entry in enumerate(value):
                yield from of_json(entry, f"{place}[{number}]")
    elif isinstance(value, bool) or value is None:
        yield place, str(value)
    elif isinstance(value, int | float):
        yield place, packed(np.array(float(value)))
    else:
        yield place, value if _is_word(value) else {"prose": [value]}


def _is_word(text: str) -> bool:
    return bool(re.fullmatch(r"[^\s]{0,60}", text)) and "/" not in text.strip("/")[:-3]


def _as_numbers(value: list[Any]) -> Table | None:
    if not value:
        return packed(np.zeros(0))
    flat = json.dumps(value)
    if re.search(r'["{]|true|false', flat):
        return None
    try:
        array = np.array(value, dtype=float)
    except (ValueError, TypeError):
        return None
    return packed(array)


def packed(array: np.ndarray) -> Table:
    """Return numbers with 12 digits; of arrays above LARGEST every k-th, and sums of magnitudes over blocks.

    Every entry counts in a sum, with a weight that depends on its place and its sign.
    """
    if np.iscomplexobj(array):
        array = np.stack([array.real, array.imag])
    array = np.asarray(array, dtype=float)
    flat = array.ravel()
    made: Table = {"shape": list(array.shape)}
    if flat.size <= LARGEST:
        made["n"] = _rounded(flat)
        made["scale"] = _scale_of(array)
        return made
    step = flat.size // (LARGEST // 2) + 1
    made["n"] = _rounded(flat[::step])
    made["scale"] = "all"
    made["largest"] = _rounded(np.array([np.nanmax(np.abs(flat), initial=0.0)]))[0]
    made["missing"] = int(np.sum(~np.isfinite(flat)))
    weight = (1.0 + np.arange(flat.size) * 0.6180339887 % 1.0) * (1.0 + 0.5 * np.sign(flat))
    pieces = np.array_split(np.where(np.isfinite(flat), weight * np.abs(flat), 0.0), LARGEST // 10)
    made["sums"] = _rounded(np.array([np.sum(piece) for piece in pieces]))
    return made


def _scale_of(array: np.ndarray) -> str:
    """Return how entries are scaled: by their diagonal (matrices of mixed units), by column, or all alike."""
    if array.ndim >= 2 and array.shape[-1] == array.shape[-2] > 1:
        diagonal = np.einsum("...ii->...i", array)
        bound = np.sqrt(np.abs(diagonal[..., :, None] * diagonal[..., None, :]))
        if np.all(diagonal > 0.0) and np.all(np.abs(array) <= 2.0 * bound):
            return "diagonal"
    return "column" if array.ndim >= 2 else "all"


def _rounded(values: np.ndarray) -> list[Any]:
    return [float(f"{v:.12g}") if np.isfinite(v) else str(v) for v in values.tolist()]


def _of_csv(text: str) -> Iterator[tuple[str, Any]]:
    rows = [row for row in csv.reader(io.StringIO(text)) if row and not row[0].startswith("#")]
    if not rows:
        return
    head, body = rows[0], rows[1:]
    if _number(head[0]) is not None:
        head, body = [str(k) for k in range(len(head))], rows
    yield "columns", head
    for place, name in enumerate(head):
        cells = [row[place] if place < len(row) else "" for row in body]
        numbers = [_number(cell) for cell in cells]
        if any(v is None for v in numbers):
            if LEFT_OUT.search(name):
                continue
            yield name, cells if all(map(_is_word, cells)) else {"prose": cells}
        else:
            yield name, packed(np.array(numbers, dtype=float))


def _number(text: str) -> float | None:
    try:
        return float(text) if text.strip() else float("nan")
    except ValueError:
        return None


def _of_hdf5(path: Path) -> Iterator[tuple[str, Any]]:
    import h5py

    found: list[tuple[str, Any]] = []

    def visit(name: str, node: Any) -> None:
        found.extend((f"{name}@{key}", value) for key, value in node.attrs.items())
        if isinstance(node, h5py.Dataset):
            found.append((name, node[()]))

    with h5py.File(path, "r") as file:
        visit("", file)
        file.visititems(visit)
    for name, value in found:
        key = re.split(r"[/@]", name)[-1]
        if LEFT_OUT.search(key) or KEYS_ONLY.match(key):
            continue
        array = np.asarray(value)
        if array.dtype.kind in "iufcb":
            yield name, packed(array)
        elif array.dtype.names:
            for field in array.dtype.names:
                if array[field].dtype.kind in "iufc":
                    yield f"{name}.{field}", packed(array[field])
        else:
            texts = [t.decode() if isinstance(t, bytes) else str(t) for t in array.ravel().tolist()]
            yield from _of_texts(name, texts)


def _of_texts(name: str, texts: list[str]) -> Iterator[tuple[str, Any]]:
    if len(texts) == 1 and texts[0][:1] in "{[":
        try:
            yield from of_json({name: json.loads(texts[0])})
            return
        except ValueError:
            pass
    yield name, texts if all(map(_is_word, texts)) else {"prose": texts}


def _of_nrrd(path: Path) -> Iterator[tuple[str, Any]]:
    import SimpleITK as sitk

    image = sitk.ReadImage(str(path))
    array = sitk.GetArrayFromImage(image)
    yield "array", hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:40]
    yield "size", packed(np.array(array.shape, dtype=float))
    yield "counts", packed(np.bincount(array.ravel().astype(np.int64) % 65536)[:64].astype(float))
    for name, value in (
        ("spacing", image.GetSpacing()),
        ("origin", image.GetOrigin()),
        ("direction", image.GetDirection()),
    ):
        yield name, packed(np.array(value))


def _of_mesh(path: Path) -> Iterator[tuple[str, Any]]:
    import trimesh

    mesh = trimesh.load(path, process=False, force="mesh")
    yield "vertices, faces", packed(np.array([len(mesh.vertices), len(mesh.faces)], dtype=float))
    yield "volume, area", packed(np.array([mesh.volume, mesh.area]))
    yield "centre", packed(np.array(mesh.center_mass))
    yield "bounds", packed(np.array(mesh.bounds))
    yield "inertia", packed(np.array(mesh.moment_inertia))
    yield "mean vertex", packed(np.array(mesh.vertices).mean(axis=0))
    yield "vertices squared", packed((np.array(mesh.vertices) ** 2).sum(axis=0))


def _of_mat(path: Path) -> Iterator[tuple[str, Any]]:
    from scipy.io import loadmat

    for name, value in sorted(loadmat(path, simplify_cells=True).items()):
        if not name.startswith("__"):
            yield from of_json({name: _plain(value)})


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _of_text(text: str) -> Iterator[tuple[str, Any]]:
    """Numbers of a text file (URDF, MJCF, Abaqus) in their order; of a page those of its tables."""
    numbers = re.findall(r"(?<![\w.])[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?(?![\w.])", text)
    yield "numbers", packed(np.array([float(v) for v in numbers]))


def table_cells(page: str) -> list[str]:
    """Return the cells of the tables of a page that hold a digit, as plain text."""
    cells = re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", page, re.DOTALL)
    plain = (re.sub(r"<[^>]+>", "", cell).strip() for cell in cells)
    return [cell for cell in plain if re.search(r"\d", cell)]
