"""Files with random damage are read or refused in sentences; nothing else may come of them."""

from __future__ import annotations

import random

import numpy as np
import pytest

from legacy.kinematics.readers.input_options import InputOptions
from legacy.kinematics.readers.measurement_files import read_measurement
from legacy.stapeskit.faults import StapeskitError
from tests.kinematics import written_uff as uff
from tests.kinematics.written_psv import fastscan, point

F = np.arange(1, 13) * 12.5
Y = np.random.default_rng(0).normal(size=(12, 2)) @ [1.0, 1.0j]
COHERENCE = {"kind": uff.COHERENCE, "quantity": 1, "unit": "NONE", "form": 2}
FILES = {
    "text.uff": [
        uff.units(),
        uff.nodes_15({1: (0, 0, 0), 2: (1e-3, 0, 0)}, 3, 3),
        uff.system_18(3, (0, 0, 0), (1, 0, 0), (0, 0, 1)),
        uff.function(F, Y, 1),
        uff.function(F, Y, 2, form=6),
    ],
    "binary.uff": [
        uff.units(1000.0, 5, "mm"),
        uff.nodes_2411({1: (0, 0, 0)}, 3),
        uff.system_2420(3, np.eye(3), (0, 0, 0)),
        uff.function(F, Y, 1, form=6, binary="<"),
        uff.function(F, abs(Y) * 0.1, 1, **COHERENCE),
    ],
    "uneven.uff": [
        uff.function(F, Y, 1, form=6, even=False, binary=">"),
        uff.function(F, Y, 2, form=6, even=False),
    ],
    "fast.txt": [fastscan(500.0, np.eye(3) * 1e-3, np.ones((3, 3)) * (1.0 + 1.0j))],
    "point.txt": [point(1, F, Y, place=(1, 2, 3))],
    "axes.txt": [point(1, F, np.stack([Y, Y, Y], 1), component="3D")],
}


def damaged(content, rng):
    """Change, remove, add, copy single bytes and stretches."""
    content = bytearray(content)
    for _ in range(rng.randrange(1, 5)):
        place, other = rng.randrange(len(content)), rng.randrange(len(content))
        kind, length = rng.randrange(5), rng.randrange(1, 40)
        if kind == 0:
            content[place] = rng.randrange(256)
        elif kind == 1:
            del content[place : min(place + length, len(content) - 1)]
        elif kind == 2:
            content[place:place] = rng.randbytes(length)
        elif kind == 3:
            content[place] = rng.choice(b"0123456789-+.E \n")
        else:
            content[place : place + length] = content[other : other + length]
    return bytes(content)


def fault_of(path):
    """What reading a file says, empty when it is read."""
    try:
        read_measurement([path], options=InputOptions(body=(f"s={path.name}",)))
    except StapeskitError as fault:
        return str(fault)
    return ""


@pytest.mark.parametrize("name", FILES)
def test_damaged_files_are_read_or_refused_in_sentences(name, tmp_path):
    rng = random.Random(name)
    whole, path = b"".join(FILES[name]), tmp_path / name
    refused = 0
    for _ in range(100):
        path.write_bytes(damaged(whole, rng))
        text = fault_of(path)
        refused += bool(text)
        assert all(" must " in line or line.startswith("... and") for line in text.splitlines()), text
    assert refused > 20
