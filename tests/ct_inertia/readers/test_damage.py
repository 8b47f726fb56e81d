"""Files damaged at random: read, or told in one sentence, but never a crash of a reader or its library."""

import random

import pytest

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.read_scan import read_volume
from tests.ct_inertia.readers.contract import CASES
from tests.ct_inertia.readers.writers import picture

# One scan of each ending and way to hold the voxels; raw voxels have no structure to damage.
SCANS = {
    (name.rpartition(".")[2], case.held): name for name, case in CASES.items() if case.raw is None
}.values()
WORDS = [b" ", b"-1 ", b"1e99 ", b"nan ", b"\n", b'"', b"[", b"{}", b"0 ", b"99999999 "]
NUMBERS = [b"\xff\xff\xff\xff", bytes(4), b"\xff\xff\xff\x7f", b"9999"]


def damaged(data, chance):
    """Change a byte, a number or a word, take out a piece, or cut the end off."""
    content = bytearray(data)
    reach = min(len(content), 600)
    place, kind = chance.randrange(reach), chance.randrange(6)
    if kind == 0:
        content[place] = chance.randrange(256)
    elif kind == 1:
        content[place : place + 4] = chance.choice(NUMBERS)
    elif kind == 2:
        del content[place : place + chance.randrange(1, 30)]
    elif kind == 3:
        content[place:place] = chance.choice(WORDS)
    elif kind == 4:
        del content[max(1, place) :]
    else:
        digits = [k for k in range(reach) if 48 <= content[k] < 58]
        if digits:
            content[chance.choice(digits)] = chance.choice(b"0123456789-")
    return bytes(content)


@pytest.mark.parametrize("name", SCANS)
def test_damage_is_told(tmp_path, name, capsys):
    case = CASES[name]
    path = case.write(tmp_path / name, picture(case.types[0]), **case.options)
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    chance, messages = random.Random(name), []
    for attempt in range(15):
        file = chance.choice(files)
        whole = file.read_bytes()
        file.write_bytes(damaged(whole, chance))
        try:
            part = read_volume(path, 0.02 if attempt % 2 else None).array[1:3, ::2, ::2]
            assert part.shape[0] <= 2
        except CtInertiaError as told:
            messages.append(str(told))
        file.write_bytes(whole)
    assert all(" must be " in message for message in messages)
    assert not any(word in message for message in messages for word in ("Error", "itk::", "Traceback"))
    assert capsys.readouterr() == ("", "")
