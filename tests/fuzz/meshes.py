"""Damaged surface meshes: STL, PLY, OBJ and GLB."""

from __future__ import annotations

import json
import random
import struct
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

from tests.fuzz.case import Case
from tests.fuzz.mutations import INTEGERS, NUMBERS, TEXTS, json_bytes, mutate_bytes, mutate_tree


def cases(rng: random.Random) -> Iterator[Case]:
    """Yield damaged meshes without end."""
    while True:
        case = rng.choice(_MAKERS)(rng)
        _, name = case.arguments
        beside = name.endswith("ply") and rng.random() < 0.3
        yield replace(case, arguments=("read_beside_mass", name)) if beside else case


def prepare() -> None:
    """Make the whole meshes once, before processes are forked."""
    _whole()


@cache
def _whole() -> dict[str, bytes]:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=1)
    made = {
        "a.stl": ball.export(file_type="stl"),
        "text.stl": ball.export(file_type="stl_ascii").encode(),
        "a.ply": ball.export(file_type="ply"),
        "text.ply": ball.export(file_type="ply", encoding="ascii"),
        "a.obj": ball.export(file_type="obj").encode(),
        "a.glb": ball.export(file_type="glb"),
    }
    return {name: bytes(data) for name, data in made.items()}


def _bytes(rng: random.Random) -> Case:
    """Damage bytes, most often of the header."""
    name = rng.choice(sorted(_whole()))
    return Case(f"{name}: bytes", {name: mutate_bytes(rng, _whole()[name], head=300)}, ("read_mesh", name))


def _lines(rng: random.Random) -> Case:
    """Damage lines of a mesh or header in text."""
    name = rng.choice(("text.stl", "text.ply", "a.obj", "a.ply"))
    data = _whole()[name]
    end = data.find(b"end_header") if name == "a.ply" else len(data)
    lines = data[:end].split(b"\n")
    for _ in range(rng.randint(1, 3)):
        row = rng.randrange(min(len(lines), rng.choice((12, len(lines)))))
        words = lines[row].split(b" ")
        match rng.randrange(5):
            case 0:
                place = rng.randrange(len(words))
                words[place] = rng.choice((*NUMBERS, *TEXTS)).encode("utf-8", "surrogatepass")
            case 1:
                words[-1] = str(rng.choice(INTEGERS)).encode()
            case 2:
                words = words[:-1]
            case 3:
                words = words * 2
            case _:
                lines.insert(row, lines[rng.randrange(len(lines))])
        lines[row] = b" ".join(words)
    return Case(f"{name}: lines", {name: b"\n".join(lines) + data[end:]}, ("read_mesh", name))


def _count(rng: random.Random) -> Case:
    """Change the number of triangles that a binary STL claims."""
    data = bytearray(_whole()["a.stl"])
    struct.pack_into("<I", data, 80, rng.choice(INTEGERS) & 0xFFFFFFFF)
    return Case("a.stl: count", {"a.stl": bytes(data)}, ("read_mesh", "a.stl"))


def _gltf(rng: random.Random) -> Case:
    """Change the JSON of a GLB."""
    data = _whole()["a.glb"]
    (length,) = struct.unpack_from("<I", data, 12)
    text = json_bytes(rng, mutate_tree(rng, json.loads(data[20 : 20 + length])))
    text += b" " * (-len(text) % 4)
    told = len(text) if rng.random() < 0.9 else rng.choice(INTEGERS) & 0xFFFFFFFF
    body = struct.pack("<I4s", told, b"JSON") + text + data[20 + length :]
    whole = struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body
    return Case("a.glb: JSON", {"a.glb": whole}, ("read_mesh", "a.glb"))


_MAKERS = (*(_bytes,) * 4, *(_lines,) * 4, *(_gltf,) * 4, _count)
