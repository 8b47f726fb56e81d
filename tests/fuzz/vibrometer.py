"""Damaged vibrometer files, and the tables that are read with them."""

from __future__ import annotations

import io
import random
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from tests.fuzz.case import MEGABYTE, Case
from tests.fuzz.mutations import INTEGERS, NUMBERS, TEXTS, mutate_bytes, mutate_numbers, mutate_table
from tests.fuzz.vibrometer_files import Sound, sound

_MATRIX, _PACKED, _HEADER = 14, 15, 128
_WHOLE = 0.01  # share of cases that are also fitted


def cases(rng: random.Random) -> Iterator[Case]:
    """Yield damaged measurements without end."""
    kinds = list(_DAMAGES)
    while True:
        kind = rng.choice(kinds)
        damage = rng.choice(_DAMAGES[kind])
        yield damage(rng, kind, sound()[kind])


def prepare() -> None:
    """Make the sound files before the process is forked."""
    sound()


def _case(rng: random.Random, kind: str, how: str, made: Sound, content: bytes, declared: int = 0) -> Case:
    words = ("points2dof", *made.words, "--quiet") if rng.random() < _WHOLE else ("read_ldv", *made.words)
    return Case(f"{kind} {how}", {**made.files, made.target: content}, words, declared)


def _bytes(rng: random.Random, kind: str, made: Sound) -> Case:
    return _case(rng, kind, "bytes", made, mutate_bytes(rng, made.files[made.target], head=1024))


def _numbers(rng: random.Random, kind: str, made: Sound) -> Case:
    return _case(rng, kind, "numbers", made, mutate_numbers(rng, made.files[made.target]))


def _beside(rng: random.Random, kind: str, made: Sound) -> Case:
    """Damage a table that comes with the measurement."""
    name = rng.choice([name for name in made.files if name != made.target])
    damage = rng.choice((mutate_table, mutate_numbers, mutate_bytes))
    words = made.words if name != "points.csv" else (*made.words, "--points", "points.csv")
    files = {**made.files, name: damage(rng, made.files[name])}
    return Case(f"{kind}, {name} {damage.__name__}", files, ("read_ldv", *words))


def _table(rng: random.Random, kind: str, made: Sound) -> Case:
    return _case(rng, kind, "table", made, mutate_table(rng, made.files[made.target]))


def _lines(rng: random.Random, kind: str, made: Sound) -> Case:
    """Damage text line by line: fields, order, number, length."""
    lines = made.files[made.target].split(b"\n")
    for _ in range(rng.randint(1, 3)):
        row, other = rng.randrange(len(lines)), rng.randrange(len(lines))
        match rng.randrange(7):
            case 0 | 1:
                words = lines[row].split()
                if words:
                    odd = rng.choice((*NUMBERS, *map(str, INTEGERS), *TEXTS)).encode("utf-8", "replace")
                    place = rng.randrange(len(words))
                    lines[row] = lines[row].replace(words[place], odd.rjust(len(words[place])), 1)
            case 2:
                lines[row:row] = lines[row : other + 1]
            case 3:
                del lines[row : row + rng.choice((1, 1, 2, 10))]
            case 4 if len(lines) > other:
                lines[row], lines[other] = lines[other], lines[row]
            case 5:
                lines[row] = lines[row][: rng.randrange(len(lines[row]) + 1)]
            case _:
                lines[row] = lines[row] * rng.choice((2, 1000))
        if not lines:
            break
    return _case(rng, kind, "lines", made, b"\n".join(lines))


def _repeated(rng: random.Random, kind: str, made: Sound) -> Case:
    """Repeat the file, or a part of it, very often."""
    content = made.files[made.target]
    start, end = sorted((rng.randrange(len(content)), rng.randrange(len(content))))
    part, size = content[start : end + 1], rng.choice((20_000, 20_000, 100_000, 2_000_000))
    many = part * (size // len(part))
    return _case(rng, kind, "repeated", made, content[:start] + many + content[end:])


def _tags(data: bytes, start: int, end: int, depth: int = 0) -> Iterator[int]:
    """Yield the places of the tags of a MATLAB 5 file."""
    while start + 8 <= end:
        yield start
        kind, length = struct.unpack_from("<II", data, start)
        if kind >> 16:
            start += 8
            continue
        if kind == _MATRIX and depth < 6:
            yield from _tags(data, start + 8, min(start + 8 + length, end), depth + 1)
        start += 8 + length + (-length % 8 if depth else 0)


def _mat5(rng: random.Random, kind: str, made: Sound) -> Case:
    """Damage tags, flags and sizes of a MATLAB 5 file, within the packed variables too."""
    data = made.files[made.target]
    variables = [data[a:b] for a, b in _variables(data)]
    packed = [struct.unpack_from("<I", one)[0] == _PACKED for one in variables]
    for _ in range(rng.randint(1, 2)):
        number = rng.randrange(len(variables))
        one = variables[number]
        raw = bytearray(zlib.decompress(one[8:]) if packed[number] else one)
        place = rng.choice(list(_tags(bytes(raw), 0, len(raw))))
        place += rng.choice((0, 4, 4, 8, 9, 12))
        form = rng.choice(("<I", "<I", "<H", "<B"))
        if place + struct.calcsize(form) <= len(raw):
            value = rng.choice(INTEGERS) if rng.random() < 0.5 else rng.randrange(20)
            struct.pack_into(form, raw, place, value % (1 << (8 * struct.calcsize(form))))
        variables[number] = _pack(bytes(raw)) if packed[number] else bytes(raw)
    return _case(rng, kind, "tags", made, data[:_HEADER] + b"".join(variables))


def _variables(data: bytes) -> Iterator[tuple[int, int]]:
    start = _HEADER
    while start + 8 <= len(data):
        end = start + 8 + struct.unpack_from("<I", data, start + 4)[0]
        yield start, end
        start = end


def _pack(raw: bytes, level: int = 1) -> bytes:
    content = zlib.compress(raw, level)
    return struct.pack("<II", _PACKED, len(content)) + content


def _mat5_bomb(rng: random.Random, kind: str, made: Sound) -> Case:
    """Pack a variable that is large, or is said to be, or whose parts are nested deep."""
    data = made.files[made.target]
    size = rng.choice((16, 16, 128)) * MEGABYTE
    name = struct.pack("<IIII", 6, 8, 6, 0) + struct.pack("<IIii", 5, 8, 1, size // 8)
    name += struct.pack("<HH4s", 1, 1, b"q\0\0\0")
    honest = rng.random() < 0.3
    match rng.randrange(3):
        case 0:
            content = struct.pack("<II", 9, size)
            raw = name + content
            tag = struct.pack("<II", _MATRIX, len(raw) + size)
            packer = zlib.compressobj(6)
            parts = [packer.compress(tag + raw)]
            zeros = bytes(MEGABYTE)
            real = size // MEGABYTE if honest else rng.choice((0, 1))
            parts += [packer.compress(zeros) for _ in range(real)]
            body = b"".join([*parts, packer.flush()])
            declared = real * MEGABYTE
        case 1:
            body, declared = zlib.compress(bytes(64 * MEGABYTE)), 0
        case _:
            raw = b""
            for _ in range(rng.choice((20, 3000))):
                flags = struct.pack("<IIII", 6, 8, 1, 0) + struct.pack("<IIii", 5, 8, 1, 1)
                inner = flags + struct.pack("<II", 1, 0) + raw
                raw = struct.pack("<II", _MATRIX, len(inner)) + inner
            body, declared = zlib.compress(raw), 0
    made_of = data[:_HEADER] + struct.pack("<II", _PACKED, len(body)) + body + data[_HEADER:]
    return _case(rng, kind, "bomb", made, made_of, declared)


def _hdf5(rng: random.Random, kind: str, made: Sound) -> Case:
    """Change data sets, attributes and groups, with check sums that hold."""
    import h5py

    content = made.files[made.target]
    block = 512 if content.startswith(b"MATLAB") else 0
    stream = io.BytesIO(content[block:])
    with h5py.File(stream, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        declared = 0
        for _ in range(rng.randint(1, 2)):
            name = rng.choice(names)
            with suppress(KeyError, OSError, RuntimeError):  # what was changed before is no object any more
                if rng.random() < 0.4:
                    _change_attribute(rng, rng.choice((file, file[name])))
                else:
                    declared += _change_data(rng, file, name)
    return _case(rng, kind, "structure", made, content[:block] + stream.getvalue(), declared)


def _change_attribute(rng: random.Random, node: Any) -> None:
    names = [*node.attrs, "MATLAB_class", "MATLAB_empty", "unit", "schema", "fs"]
    name = rng.choice(names)
    if name in node.attrs and rng.random() < 0.3:
        del node.attrs[name]
        return
    texts = [text.replace("\x00", "").encode("utf-8", "replace")[:60_000] for text in TEXTS]
    kinds = ("cell", "struct", "char", "double", "logical", "function_handle")
    values = (*texts, *kinds, 0, 1, -1, 1e308, np.nan, np.inf, [1, 2], _without_content(), 1 << 40)
    node.attrs[name] = rng.choice(values)


def _without_content() -> Any:
    """Return a value without content."""
    import h5py

    return h5py.Empty("f8")


def _change_data(rng: random.Random, file: Any, name: str) -> int:
    """Change or replace an object; return the bytes that it truly holds, where they are many."""
    import h5py

    old = file[name]
    few = getattr(old, "shape", None) is not None and old.size is not None and old.size < MEGABYTE
    values = np.asarray(old[()]) if few else None
    kept = dict(old.attrs) if values is not None else {}
    del file[name]
    numeric = values is not None and values.dtype.kind in "fciu"
    match rng.randrange(10):
        case 0:
            return 0
        case 1:
            file.create_group(name)
        case 2 if values is not None and values.ndim:
            file[name] = values[: rng.randrange(len(values) + 1)]
        case 3 if numeric and values.size:
            flat = values.ravel()
            flat[rng.randrange(flat.size)] = rng.choice((np.nan, np.inf, -1.0, 0.0, 1e300)) if (
                values.dtype.kind in "fc") else 1  # fmt: skip
            file[name] = values
        case 4 if numeric:
            real = np.abs(values) if values.dtype.kind == "c" else np.nan_to_num(values)
            file[name] = real.astype(rng.choice(("f4", "i4", "c16", "S8", "f8", "f2", "bool")))
        case 5:
            shape = (1 << rng.choice((10, 31, 40)), rng.choice((1, 1 << 20)))
            file.create_dataset(name, shape=shape, dtype="f8", chunks=(1024, 1))
        case 6:
            # a few kilobytes that unpack to many megabytes, all of it there
            size = rng.choice((1, 1, 32)) * MEGABYTE
            file.create_dataset(name, data=np.ones(size // 8), chunks=(1 << 16,), compression="gzip")
            return size
        case 7:
            file[name] = h5py.SoftLink(rng.choice(("/", f"/{name}", "/nowhere")))
        case 8:
            file[name] = h5py.ExternalLink(rng.choice(("/dev/zero", "ldv.h5", "../x.h5")), "/")
        case _:
            odd = (
                3.0,
                b"text",
                [b"a", b"a"],
                np.zeros((2, 2)),
                "text",
                np.array("2001", dtype="S"),
                np.zeros(0),
            )
            file[name] = rng.choice(odd)
    if kept and rng.random() < 0.7:
        for key, value in kept.items():
            file[name].attrs[key] = value
    return 0


def _npz(rng: random.Random, kind: str, made: Sound) -> Case:
    """Change the arrays of an archive: their headers, their sizes, their names."""
    stream = io.BytesIO()
    declared = 0
    with zipfile.ZipFile(io.BytesIO(made.files[made.target])) as old, zipfile.ZipFile(stream, "w") as new:
        for info in old.infolist():
            content = old.read(info)
            match rng.randrange(8):
                case 0:
                    content = mutate_bytes(rng, content, head=128)
                case 1:
                    length = rng.choice((b"(10**9,)", b"(99999999999,)", b"(-1,)", b"(4,4,4)", b"(400.0,)"))
                    content = content.replace(b"(400,)", length)
                case 2:
                    zeros = rng.choice((16, 128)) * MEGABYTE
                    content += bytes(zeros)
                    declared += zeros
                case 3:
                    content = content.replace(b"<f8", rng.choice((b"|O ", b"|V8", b"<c8", b"|S8", b"<M8")))
            name = rng.choice((info.filename,) * 8 + ("../x.npy", "vib.npy", "a" * 300))
            new.writestr(
                name, content, rng.choice((zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED, zipfile.ZIP_LZMA))
            )
    content = stream.getvalue()
    if rng.random() < 0.3:
        content = mutate_bytes(rng, content)
    return _case(rng, kind, "archive", made, content, declared)


def _wav(rng: random.Random, kind: str, made: Sound) -> Case:
    """Change the chunks of a sound file."""
    raw = bytearray(made.files[made.target])
    for _ in range(rng.randint(1, 2)):
        place = rng.choice((4, 12, 16, 20, 22, 24, 28, 32, 34, 36, 40))
        form = rng.choice(("<I", "<H"))
        value = rng.choice(INTEGERS) % (1 << (8 * struct.calcsize(form)))
        struct.pack_into(form, raw, place, value)
    return _case(rng, kind, "chunks", made, bytes(raw))


def _mat4(rng: random.Random, kind: str, made: Sound) -> Case:
    """Change numbers at the head of a matrix of version 4."""
    raw = bytearray(made.files[made.target])
    heads = [0, *(place - 20 for place in (raw.find(b"y\0"), raw.find(b"unit\0")) if place >= 20)]
    for _ in range(rng.randint(1, 2)):
        value = rng.choice((*INTEGERS, 1000, 50, 1, 2)) % (1 << 32)
        struct.pack_into("<I", raw, rng.choice(heads) + 4 * rng.randrange(5), value)
    return _case(rng, kind, "head", made, bytes(raw))


def _empty(rng: random.Random, kind: str, made: Sound) -> Case:
    """Give a file without content, or with the first bytes of another format."""
    other = sound()[rng.choice(list(_DAMAGES))]
    content = rng.choice((b"", b"\0" * 1000, other.files[other.target]))
    return _case(rng, kind, "of another kind", made, content)


Damage = Callable[[random.Random, str, Sound], Case]
_TEXT: tuple[Damage, ...] = (_lines, _lines, _lines, _numbers, _bytes, _repeated, _empty)
_DAMAGES: dict[str, tuple[Damage, ...]] = {
    "tidy": (_table, _table, _table, _beside, _beside, _beside, *_TEXT),
    "text.uff": _TEXT,
    "binary.uff": _TEXT,
    "uneven.uff": _TEXT,
    "series.uff": _TEXT,
    "fastscan": _TEXT,
    "point.txt": _TEXT,
    "axes.txt": _TEXT,
    "v5.mat": (*(_mat5,) * 9, *(_bytes,) * 3, _mat5_bomb),
    "packed.mat": (*(_mat5,) * 9, *(_bytes,) * 3, _mat5_bomb),
    "v4.mat": (_mat4, _mat4, *(_bytes,) * 2),
    "v73.mat": (_hdf5, _hdf5, _hdf5, _bytes),
    "own.h5": (_hdf5, _hdf5, _hdf5, _bytes),
    "wide.csv": (_table, _table, _beside, *_TEXT),
    "mapped.csv": (_table, _beside, _beside, *_TEXT),
    "series.csv": (_table, _table, _beside, _beside, _numbers, _lines),
    "series.npz": (_npz, _npz, _bytes, _beside),
    "series.wav": (_wav, _wav, _bytes, _beside),
    "series.h5": (_hdf5, _bytes),
}
