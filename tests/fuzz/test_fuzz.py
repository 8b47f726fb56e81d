"""The harness finds what it is there to find, makes cases again, and what it once found stays cured."""

from __future__ import annotations

import random

import pytest

from legacy.kinematics.readers.formats import FORMATS
from legacy.kinematics.readers.recognise_format import format_of
from legacy.stapeskit import guard
from legacy.stapeskit.faults import Fault, StapeskitError
from tests.fuzz import targets
from tests.fuzz.case import Case
from tests.fuzz.corpus import saved
from tests.fuzz.mutations import mutate_bytes, mutate_table, mutate_tree
from tests.fuzz.vibrometer import _DAMAGES
from tests.fuzz.vibrometer_files import sound
from tests.fuzz.worker import Place, run


def _refuse(*_):
    raise StapeskitError(Fault("it", "sound", "damaged"))


def _fail(*_):
    return {}["key"]


def _spoil(path, *_):
    with open(path, "w") as stream:
        stream.write("other")


def _leave(*_):
    with open(".stapeskit-abc", "w") as stream:
        stream.write("half")


@pytest.mark.parametrize(
    ("target", "kind"),
    [(_refuse, "refused"), (_fail, "error"), (_spoil, "input"), (_leave, "left"), (print, "done")],
)
def test_every_bad_end_is_found(target, kind, monkeypatch, tmp_path):
    monkeypatch.setitem(targets.TARGETS, "target", target)
    assert run(Case("a case", {"a": b"a", "empty/": b""}, ("target", "a")), tmp_path / "case")["kind"] == kind


def test_cases_are_made_again_from_their_place():
    first = list(Place("records", 3, 5).cases())
    number, case = next(Place.of("records:3:5:17").cases())
    assert number == 17
    assert len(first) == 100
    assert case == first[17][1]


def test_damage_depends_on_the_random_numbers_alone_and_leaves_the_original():
    tree = {"a": [1, 2.5, {"b": "text"}], "c": None}
    table = b"a,b\n1,2\n3,4\n"
    for seed in range(50):
        found = [
            (mutate_bytes(rng, table), mutate_table(rng, table), repr(mutate_tree(rng, tree)))
            for rng in (random.Random(seed), random.Random(seed))
        ]
        assert found[0] == found[1]
    assert tree == {"a": [1, 2.5, {"b": "text"}], "c": None}


def test_vibrometer_files_are_sound_before_they_are_damaged(tmp_path):
    for kind, made in sound().items():
        found = run(Case(kind, made.files, ("read_ldv", *made.words)), tmp_path / kind)
        assert found["kind"] == "done", kind


def test_every_vibrometer_format_is_damaged(tmp_path):
    known = {entry.name for entry in FORMATS if entry.name != "vendor"}  # which is refused unread
    for kind, made in sound().items():
        for name, content in made.files.items():
            (tmp_path / kind / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / kind / name).write_bytes(content)
        known.discard(format_of(tmp_path / kind / made.words[0]).name)
    assert known == set()
    assert set(_DAMAGES) == set(sound())


def test_what_was_found_stays_cured(tmp_path, monkeypatch):
    monkeypatch.setattr(guard, "_PROCESSOR_S", 0.1)
    monkeypatch.setattr(guard, "_CLOCK", 3.0)
    for name, case in saved():
        found = run(case, tmp_path / name)
        assert found["kind"] in ("done", "refused"), (name, found)
