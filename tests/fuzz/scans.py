"""Damaged scans and label volumes of every format: headers, directories, metadata and chunks."""

from __future__ import annotations

import bz2
import gzip
import json
import lzma
import random
import struct
import tempfile
import warnings
import zlib
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path

import numpy as np

from legacy.ct_inertia.readers.formats import format_of
from tests.ct_inertia.readers import writers as w
from tests.ct_inertia.readers.contract import CASES
from tests.fuzz.case import Case
from tests.fuzz.mutations import (
    INTEGERS,
    NUMBERS,
    TEXTS,
    json_bytes,
    mutate_bytes,
    mutate_numbers,
    mutate_tree,
)

Files = dict[str, bytes]
_BOMB = 64 << 20
_TEXT_HEADERS = (".nrrd", ".nhdr", ".mha", ".mhd", ".vgi", ".am")


def cases(rng: random.Random) -> Iterator[Case]:
    """Yield damaged scans without end."""
    while True:
        yield rng.choice(_MAKERS)(rng)


def prepare() -> None:
    """Write the whole scans once, before processes are forked."""
    _whole()
    _bombs()


@cache
def _whole() -> dict[str, list[tuple[str, Files]]]:
    """Return scans by format: the name to open, and the files."""
    made: dict[str, list[tuple[str, Files]]] = {}
    with tempfile.TemporaryDirectory() as place, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for number, (name, write) in enumerate(_writers()):
            folder = Path(place, str(number))
            folder.mkdir()
            path = write(folder / name)
            made.setdefault(format_of(path).module, []).append((path.name, _files(folder)))
    return made


def _any(
    rng: random.Random, wanted: Callable[[str, Files], bool] = lambda _name, _files: True
) -> tuple[str, Files]:
    """Return a scan: formats with many variants come no more often than others."""
    kinds = [[scan for scan in scans if wanted(*scan)] for scans in _whole().values()]
    return rng.choice(rng.choice([scans for scans in kinds if scans]))


def _files(folder: Path) -> Files:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def _writers() -> Iterator[tuple[str, Callable[[Path], Path]]]:
    """Yield name and writer of every scan of the contract of readers, and of a few more."""
    for name, case in CASES.items():
        # bare voxels have no header that could be damaged
        if case.raw is None:
            yield name, partial(case.write, array=w.picture(case.types[0]), **case.options)
    grey, small = w.picture(np.uint16), w.picture(np.uint8)
    yield "a.nhdr", partial(_detached_nrrd, array=grey)
    yield "a.mhd", partial(_detached_meta, array=grey)
    yield "a.seg.nrrd", partial(_segmentation, array=small)
    yield "a.nii", partial(w.nifti, array=grey, slope=2.0, inter=1.0)
    yield "skyscan", partial(w.skyscan, array=small)
    for codec in _codecs():
        yield "packed.zarr", partial(w.ome_zarr, array=grey, compressors=codec)


def _codecs():
    import numcodecs

    return [
        *(
            numcodecs.Blosc(cname=name, shuffle=how)
            for name in ("lz4", "zstd", "blosclz")
            for how in (0, 1, 2)
        ),
        numcodecs.Zstd(),
        numcodecs.LZ4(),
        numcodecs.Zlib(),
        numcodecs.GZip(),
        numcodecs.BZ2(),
        numcodecs.LZMA(),
    ]


def _detached_nrrd(path: Path, array) -> Path:
    header = (
        "NRRD0004\ntype: uint16\ndimension: 3\nsizes: 5 6 7\nencoding: raw\nendian: little\n"
        "space: left-posterior-superior\nspace directions: (0.02,0,0) (0,0.02,0) (0,0,0.02)\n"
        "space origin: (0,0,0)\nbyte skip: 0\ndata file: s%03d.raw 0 6 1\n"
    )
    for number, plane in enumerate(array):
        path.with_name(f"s{number:03}.raw").write_bytes(plane.tobytes())
    path.write_text(header)
    return path


def _detached_meta(path: Path, array) -> Path:
    for number, plane in enumerate(array):
        path.with_name(f"s{number:03}.raw").write_bytes(plane.tobytes())
    return w.meta(path, array, data="s%03d.raw 0 6 1")


def _segmentation(path: Path, array) -> Path:
    keys = "".join(
        f"Segment{n}_ID:=s{n}\nSegment{n}_Name:={name}\nSegment{n}_LabelValue:={n + 1}\nSegment{n}_Layer:=0\n"
        for n, name in enumerate(("stapes", "plate"))
    )
    header = (
        "NRRD0004\ntype: uint8\ndimension: 4\nsizes: 2 5 6 7\nencoding: gzip\n"
        "kinds: list domain domain domain\n"
        "space: left-posterior-superior\nspace directions: none (0.02,0,0) (0,0.02,0) (0,0,0.02)\n"
        f"space origin: (0,0,0)\n{keys}\n"
    )
    packed = gzip.compress(np.repeat(array[..., None], 2, axis=-1).tobytes())
    path.write_bytes(header.encode() + packed)
    return path


def _case(rng: random.Random, what: str, name: str, files: Files, declared: int = 0) -> Case:
    target = "read_labels" if name.endswith("seg.nrrd") or rng.random() < 0.1 else "read_scan"
    return Case(f"{name}: {what}", files, (target, name), declared)


def _damaged_bytes(rng: random.Random) -> Case:
    """Damage one of the files of a scan, most often where its header is."""
    name, files = _any(rng)
    chosen = rng.choice(sorted(files))
    changed = mutate_bytes(rng, files[chosen], head=600)
    return _case(rng, f"bytes of {chosen}", name, {**files, chosen: changed})


def _damaged_header(rng: random.Random) -> Case:
    """Change fields of a header in text."""
    name, files = _any(rng, lambda n, _: n.endswith(_TEXT_HEADERS))
    data = files[name]
    end = (
        data.find(b"\n\n") if name.endswith("nrrd") else data.find(b"LOCAL\n") if name.endswith("mha") else -1
    )
    end = data.find(b"@1\n", data.find(b"# Data")) if name.endswith(".am") else end
    end = len(data) if end < 0 else end
    lines = data[:end].split(b"\n")
    for _ in range(rng.randint(1, 3)):
        row = rng.randrange(len(lines))
        mark = next((m for m in (b":=", b":", b"=") if m in lines[row]), b" ")
        key, _, value = lines[row].partition(mark)
        match rng.randrange(7):
            case 0:
                lines[row] = mutate_numbers(rng, lines[row])
            case 1:
                odd = rng.choice((*NUMBERS, *TEXTS)).encode("utf-8", "surrogatepass")
                lines[row] = key + mark + b" " + odd
            case 2:
                del lines[row]
            case 3:
                lines.insert(row, lines[rng.randrange(len(lines))])
            case 4:
                words = value.split(b" ")
                lines[row] = key + mark + b" ".join(rng.choice((words * 3, words[:-1], [*words, b"1"])))
            case 5:
                number = str(rng.choice(INTEGERS)).encode()
                lines[row] = key + mark + b" ".join([number] * len(value.split()))
            case _:
                named = rng.choice(
                    (b"../a", b"/dev/zero", b"/etc/passwd", b"LIST", b"s%07d.raw 0 9999999 1", name.encode())
                )
                lines[row] = key + mark + b" " + named
        if not lines:
            lines = [b""]
    return _case(rng, "header", name, {**files, name: b"\n".join(lines) + data[end:]})


def _damaged_tiff(rng: random.Random) -> Case:
    """Change tags and offsets of the directories of a TIFF."""
    name, files = _any(rng, lambda n, _: n.endswith((".tif", ".btf")))
    data = bytearray(files[name])
    order = "<" if data[:2] == b"II" else ">"
    big = struct.unpack_from(order + "H", data, 2)[0] == 43
    form, entry, count_form = ("Q", 20, "Q") if big else ("I", 12, "H")
    places = []
    offset = struct.unpack_from(order + form, data, 8 if big else 4)[0]
    while offset and offset not in places and len(places) < 50:
        places.append(offset)
        count = struct.unpack_from(order + count_form, data, offset)[0]
        after = offset + struct.calcsize(count_form) + count * entry
        offset = struct.unpack_from(order + form, data, after)[0]
    for _ in range(rng.randint(1, 3)):
        place = rng.choice(places)
        count = struct.unpack_from(order + count_form, data, place)[0]
        first = place + struct.calcsize(count_form)
        if not 0 < count < 100:
            break
        at = first + rng.randrange(count) * entry
        width = struct.calcsize(form)
        mask = 2 ** (8 * width) - 1
        number = (rng.choice((*INTEGERS, len(data), *places))) & mask
        match rng.randrange(6):
            case 0:  # the next directory
                struct.pack_into(order + form, data, first + count * entry, rng.choice((*places, number)))
            case 1:
                struct.pack_into(order + "H", data, at + 2, rng.choice((*range(1, 19), 255)))
            case 2:
                struct.pack_into(order + form, data, at + 4, number)
            case 3:
                struct.pack_into(
                    order + "H", data, at, rng.choice((256, 257, 258, 259, 273, 278, 279, 330, 34665))
                )
            case _:
                struct.pack_into(order + form, data, at + 4 + width, number)
    return _case(rng, "directories", name, {**files, name: bytes(data)})


def _damaged_zarr(rng: random.Random) -> Case:
    """Change the metadata of a Zarr image."""
    name, files = _any(rng, lambda n, _: n.endswith(".zarr"))
    chosen = rng.choice([k for k in files if k.endswith((".zarray", ".zattrs", ".zgroup", "zarr.json"))])
    changed = json_bytes(rng, mutate_tree(rng, json.loads(files[chosen])))
    return _case(rng, f"metadata {chosen}", name, {**files, chosen: changed})


def _has_chunks(name: str, files: Files) -> bool:
    return f"{name}/0/.zarray" in files


def _chunks(name: str, files: Files) -> list[str]:
    return [k for k in files if k.startswith(f"{name}/0/") and not k.endswith(".zarray")]


def _damaged_chunk(rng: random.Random) -> Case:
    """Change the header of a packed chunk, or its blocks."""
    name, files = _any(rng, _has_chunks)
    chosen = rng.choice(_chunks(name, files) or sorted(files))
    data = bytearray(files[chosen])
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(min(len(data), rng.choice((16, 40, len(data)))))
        if rng.random() < 0.5 and at + 4 <= len(data):
            struct.pack_into("<I", data, at & ~3, rng.choice(INTEGERS) & 0xFFFFFFFF)
        else:
            data[at] = rng.randrange(256)
    return _case(rng, f"chunk {chosen}", name, {**files, chosen: bytes(data)})


def _damaged_dicom(rng: random.Random) -> Case:
    """Change lengths of elements of a DICOM file."""
    name, files = _any(rng, lambda _, files: any(k.endswith(".dcm") for k in files))
    chosen = rng.choice([k for k in files if k.endswith(".dcm")])
    data = bytearray(files[chosen])
    for _ in range(rng.randint(1, 3)):
        at = rng.randrange(132, min(len(data) - 8, 1500))
        kinds = [at + k for k in range(200) if data[at + k : at + k + 2].isalpha() and at + k + 8 < len(data)]
        place = rng.choice(kinds or [at])
        if data[place : place + 2] in (b"OB", b"OW", b"SQ", b"UN", b"UT"):
            struct.pack_into("<I", data, place + 4, rng.choice(INTEGERS) & 0xFFFFFFFF)
        elif rng.random() < 0.3:
            data[place : place + 8] = (
                rng.choice((b"UN", b"OB", b"SQ", b"UT"))
                + b"\0\0"
                + struct.pack("<I", rng.choice(INTEGERS) & 0xFFFFFFFF)
            )
        else:
            struct.pack_into("<H", data, place + 2, rng.choice(INTEGERS) & 0xFFFF)
    return _case(rng, f"elements of {chosen}", name, {**files, chosen: bytes(data)})


def _damaged_jpeg(rng: random.Random) -> Case:
    """Change the packed pixels of a DICOM slice: markers, lengths, tables, or a piece of them."""
    name, files = _any(rng, lambda name, _: name == "dicom_jpeg")
    chosen = rng.choice([k for k in files if k.endswith(".dcm")])
    data = bytearray(files[chosen])
    start = data.rindex(b"\xff\xd8")
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(start, rng.choice((min(start + 60, len(data) - 4), len(data) - 4)))
        match rng.randrange(4):
            case 0:
                data[at : at + 2] = struct.pack(">H", rng.choice((0, 1, 2, 3, 0x7FFF, 0xFFFF)))
            case 1:
                count = min(rng.randrange(1, 40), len(data) - at)
                data[at : at + count] = rng.randbytes(count)
            case _:
                data[at] = rng.choice((0, 1, 2, 8, 16, 0xC3, 0xC4, 0xD9, 0xFF, rng.randrange(256)))
    return _case(rng, f"pixels of {chosen}", name, {**files, chosen: bytes(data)})


@cache
def _bombs() -> dict[str, bytes]:
    zeros = bytes(_BOMB)
    import imagecodecs

    return {
        "gzip": gzip.compress(zeros, 9),
        "zlib": zlib.compress(zeros, 9),
        "bz2": bz2.compress(zeros),
        "lzma": lzma.compress(zeros, preset=0),
        "zstd": imagecodecs.zstd_encode(zeros),
        "lz4": imagecodecs.lz4_encode(zeros, header=True),
        "blosc": imagecodecs.blosc_encode(zeros),
    }


def _bomb(rng: random.Random) -> Case:
    """Pack 64 MB where the header declares less than a kilobyte."""
    bombs = _bombs()
    if rng.random() < 0.3:
        with tempfile.TemporaryDirectory() as place:
            head = w.nifti(Path(place, "a.nii"), w.picture()).read_bytes()[:352]
        packed = gzip.compress(head) + bombs["gzip"]
        return Case("gzip bomb", {"a.nii.gz": packed}, ("read_scan", "a.nii.gz"))
    codec = rng.choice(sorted(bombs))
    name, files = _any(rng, _has_chunks)
    meta = json.loads(files[f"{name}/0/.zarray"])
    meta["compressor"] = {"id": codec}
    packed = dict.fromkeys(_chunks(name, files), bombs[codec])
    changed = {**files, **packed, f"{name}/0/.zarray": json.dumps(meta).encode()}
    return Case(f"{codec} bomb in chunks", changed, ("read_scan", name))


_MAKERS = (
    *(_damaged_bytes,) * 6,
    *(_damaged_header,) * 6,
    *(_damaged_tiff,) * 6,
    *(_damaged_zarr,) * 4,
    *(_damaged_chunk,) * 4,
    *(_damaged_dicom,) * 2,
    _damaged_jpeg,
    *(_bomb,) * 1,
)
