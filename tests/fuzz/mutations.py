"""Damage to files: bytes, numbers in text, tables and nested values."""

from __future__ import annotations

import copy
import json
import random
import re
import struct
from typing import Any

INTEGERS = (
    *(0, 1, 2, 7, 255, 256, 32767, 65535, 65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**64),
    *(-1, -2, -(2**31), -(2**63)),
)
NUMBERS = (
    *("0", "-0", "1", "-1", "1e308", "-1e308", "1e400", "1e-320", "nan", "NaN", "inf", "-inf", "Infinity"),
    *("0x10", "1,5", "1_000", "1e", "", " ", "--1", "٣", "1" * 400, "9" * 5000, "2147483648", "1e9", "x"),
    *("4294967296", "18446744073709551616", "true", "null", "None", "=1+1"),
)
TEXTS = (
    "",
    " ",
    "\x00",
    "ß" * 300,
    "a" * 70_000,
    "../x",
    "/dev/zero",
    "</script><b>",
    "{box}",
    "%s",
    "\ud800",
    "NaN",
)
_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")


def mutate_bytes(rng: random.Random, data: bytes, times: int | None = None, head: int = 0) -> bytes:
    """Damage a file that has no known structure.

    Parameters
    ----------
    rng : random.Random
    data : bytes
    times : int, optional
        How often; one to six times by default.
    head : int, optional
        Most damage falls into so many first bytes, where headers lie; 0 means anywhere.
    """
    found = bytearray(data)
    for _ in range(times or rng.randint(1, 6)):
        end = min(head, len(found)) if head and rng.random() < 0.8 else len(found)
        place = rng.randrange(end) if end else 0
        length = min(len(found) - place, rng.choice((1, 2, 4, 8, 16, 64, 512)))
        match rng.randrange(9):
            case 0 if found:
                found[place] ^= 1 << rng.randrange(8)
            case 1:
                found[place : place + length] = rng.randbytes(length)
            case 2:
                del found[place : place + length]
            case 3:
                found[place:place] = found[place : place + length] * rng.choice((1, 1, 2, 50))
            case 4:
                del found[place:]
            case 5:
                form = rng.choice(("<i", ">i", "<q", ">q", "<h", ">h", "<f", ">f", "<d", ">d"))
                size = struct.calcsize(form)
                value = _fitting(form, rng)
                found[place : place + size] = struct.pack(form, value)
            case 6:
                other = rng.randrange(len(found)) if found else 0
                found[place : place + length] = found[other : other + length]
            case 7:
                return mutate_numbers(rng, bytes(found))
            case _:
                found[place : place + length] = bytes([rng.choice((0, 255, 32, 10))]) * length
    return bytes(found)


def _fitting(form: str, rng: random.Random) -> float:
    if form[1] in "fd":
        return rng.choice((0.0, -1.0, float("nan"), float("inf"), 1e30, -1e30, 1e-30))
    bits = 8 * struct.calcsize(form)
    value = rng.choice(INTEGERS) & (2**bits - 1)
    return value - 2**bits if value >= 2 ** (bits - 1) else value


def mutate_numbers(rng: random.Random, data: bytes) -> bytes:
    """Replace one to three numbers of a text."""
    spans = [match.span() for match in _NUMBER.finditer(data[:100_000])]
    for start, end in sorted(rng.sample(spans, min(len(spans), rng.randint(1, 3))), reverse=True):
        data = data[:start] + rng.choice(NUMBERS).encode() + data[end:]
    return data


def mutate_table(rng: random.Random, text: bytes) -> bytes:
    """Damage a comma-separated table: its cells, rows, columns, header, separators and line ends."""
    lines = text.decode("utf-8", "replace").split("\n")
    for _ in range(rng.randint(1, 3)):
        row = rng.randrange(len(lines)) if rng.random() < 0.7 else 0
        cells = lines[row].split(",")
        column = rng.randrange(len(cells))
        match rng.randrange(10):
            case 0 | 1 | 2:
                cells[column] = rng.choice((*NUMBERS, *TEXTS))
            case 3:
                del cells[column]
            case 4:
                cells.insert(column, rng.choice(cells))
            case 5:
                lines.insert(row, lines[row])
            case 6:
                cells = [rng.choice((";", "\t", '"', '"a\n', "'")).join(cells)]
            case 7:
                lines = [",".join(line.split(",")[:column]) for line in lines]
                continue
            case 8:
                del lines[row:]
                lines.append("")
                continue
            case _:
                cells = []
        lines[row] = ",".join(cells)
    end = rng.choice(("\n", "\n", "\n", "\r\n", "\r", "\n\n"))
    coding = rng.choice(("utf-8", "utf-8", "utf-8", "utf-8-sig", "utf-16", "latin-1"))
    return end.join(lines).encode(coding, "replace")


def mutate_tree(rng: random.Random, value: Any) -> Any:
    """Damage nested mappings and lists: values, keys, lengths, depth."""
    value = copy.deepcopy(value)
    for _ in range(rng.randint(1, 3)):
        places = list(_places(value))
        if not places:
            break
        holder, key = rng.choice(places)
        old = holder[key]
        match rng.randrange(8):
            case 0 | 1:
                holder[key] = _odd(rng, old)
            case 2:
                del holder[key]
            case 3 if isinstance(old, list) and old:
                holder[key] = old[:-1] if rng.random() < 0.5 else [*old, old[0]]
            case 4 if isinstance(old, (int, float)) and not isinstance(old, bool) and abs(old) < 1e300:
                holder[key] = old * rng.choice((-1, 0, 2, 1000, 1e-9, 1e9, 1.0001))
            case 5 if isinstance(holder, dict):
                holder[rng.choice((key + "x", key.upper(), "", "__proto__"))] = holder.pop(key)
            case 6:
                holder[key] = [old] if rng.random() < 0.5 else {"value": old}
            case _:
                other, name = rng.choice(places)
                holder[key] = copy.deepcopy(other[name])
    return value


def _places(value: Any) -> Any:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in list(items):
        yield value, key
        yield from _places(inner)


def _odd(rng: random.Random, old: Any) -> Any:
    number = rng.choice((*INTEGERS, 10**400, 0.5, float("nan"), float("inf"), 1e-320, 1e308))
    kinds: tuple[Any, ...] = (
        number,
        number,
        rng.choice(TEXTS),
        None,
        True,
        [],
        {},
        [[]],
        [old] * 3,
        "3",
        [None],
    )
    return rng.choice(kinds)


def json_bytes(rng: random.Random, value: Any) -> bytes:
    """Write a value as JSON, now and then deeply nested, with a key twice, cut short or in another coding."""
    text = json.dumps(value)
    match rng.randrange(40):
        case 0:
            depth = rng.choice((500, 5000, 200_000))
            text = text.replace("[", "[" * depth, 1)
        case 1:
            depth = rng.choice((500, 5000, 100_000))
            text = '{"a":' * depth + text + "}" * depth
        case 2:
            text = text[: rng.randrange(len(text))]
        case 3:
            text = text.replace("{", '{"schema": 1, ', 1)
        case 4:
            return text.encode("utf-16")
        case 5:
            return mutate_bytes(rng, text.encode("utf-8", "replace"))
        case 6:
            text = text + text
    return text.encode("utf-8", "surrogatepass" if rng.random() < 0.1 else "replace")
