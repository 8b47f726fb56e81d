"""Universal files: geometry in every system, and files that are cut short, lie or are spoiled."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from legacy.kinematics.readers.uff.spectra import read
from legacy.stapeskit.faults import StapeskitError
from tests.kinematics import written_uff as uff
from tests.kinematics.readers.test_uff import X, Y, fault, written


def test_positions_in_every_unit(tmp_path):
    places = {1: (1.5, -2.5, 3.25)}
    for nodes in (uff.nodes_15(places), uff.nodes_2411(places)):
        path = written(tmp_path, uff.units(1000.0, 5, "mm (milli newton)"), nodes, uff.function(X, Y))
        made = read(path)
        np.testing.assert_allclose(made.recordings[0].position_mm, places[1], rtol=1e-5)
        assert made.length_stated
        made = read(written(tmp_path, nodes, uff.function(X, Y)))
        np.testing.assert_allclose(made.recordings[0].position_mm, np.array(places[1]) * 1e3, rtol=1e-5)
        assert not made.length_stated


def test_directions_and_positions_in_a_turned_system(tmp_path):
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    origin = np.array([0.1, 0.2, 0.3])
    old = uff.system_18(5, origin, origin + turn[0], origin + turn[2] + 3.0 * turn[0])
    new = uff.system_2420(5, turn, origin)
    for system in (old, new):
        path = written(
            tmp_path, uff.units(), system, uff.nodes_15({1: (1.0, 2.0, 3.0)}, 5, 5), uff.function(X, Y, 1, 1)
        )
        (made,) = read(path).recordings
        np.testing.assert_allclose(made.direction, turn[0], atol=1e-12)
        np.testing.assert_allclose(made.position_mm, 1e3 * (turn.T @ [1.0, 2.0, 3.0] + origin), rtol=1e-6)


def test_a_system_within_a_system(tmp_path):
    first = uff.system_18(1, (1, 0, 0), (1, 1, 0), (1, 0, 1))
    second = uff.system_18(2, (1, 0, 0), (1, 1, 0), (1, 0, 1), parent=1)
    nodes = uff.nodes_15({1: (0.0, 0.0, 0.0)}, 2, 2)
    (made,) = read(written(tmp_path, uff.units(), first, second, nodes, uff.function(X, Y, 1, 1))).recordings
    np.testing.assert_allclose(made.position_mm, [1000.0, 1000.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(made.direction, [-1.0, 0.0, 0.0], atol=1e-12)


def test_systems_that_cannot_be_used(tmp_path):
    nodes = uff.nodes_15({1: (0.0, 0.0, 0.0), 2: (1.0, 1.0, 1.0)}, 7, 7)
    made = read(written(tmp_path, uff.units(), nodes, uff.function(X, Y)))
    assert [notice.code for notice in made.notices] == ["coordinate_system_missing"]
    other = uff.system_18(3, (0, 0, 0), (1, 0, 0), (0, 0, 1))
    assert "coordinate system 7 of node 1 must be described" in fault(
        tmp_path, other, nodes, uff.function(X, Y)
    )
    round_ = uff.system_18(7, (0, 0, 0), (1, 0, 0), (0, 0, 1), shape=1)
    assert "must be cartesian; got cylindrical" in fault(tmp_path, round_, nodes, uff.function(X, Y))
    loop = uff.system_18(7, (0, 0, 0), (1, 0, 0), (0, 0, 1), parent=7)
    assert "one that refers to itself" in fault(tmp_path, loop, nodes, uff.function(X, Y))
    line = uff.system_18(7, (0, 0, 0), (1, 0, 0), (2, 0, 0))
    assert "three points that span a plane" in fault(tmp_path, line, nodes, uff.function(X, Y))
    left = uff.system_2420(7, np.diag([1.0, 1.0, -1.0]), (0, 0, 0))
    assert "a rotation, right-handed" in fault(tmp_path, left, nodes, uff.function(X, Y))


def test_a_node_with_two_positions(tmp_path):
    text = fault(tmp_path, uff.nodes_15({1: (0, 0, 0)}), uff.nodes_2411({1: (0, 0, 1)}), uff.function(X, Y))
    assert "the position of node 1 must be one" in text


def whole(binary=""):
    return b"".join(
        [
            uff.units(),
            uff.nodes_15({1: (0.0, 0.0, 0.0), 2: (1.0, 0.0, 0.0)}),
            uff.function(X, Y, 1, form=6, binary=binary),
            uff.function(X, Y, 2, form=6, binary=binary),
        ]
    )


@pytest.mark.parametrize("binary", ["", "<"])
def test_a_file_cut_anywhere_is_refused_in_one_sentence(binary, tmp_path):
    content = whole(binary)
    complete = content.rindex(b"    -1")
    begins = content.index(b"    -1\n    58") if not binary else content.index(b"    -1\n    58b")
    second = content.index(b"    -1\n    58", begins + 10)
    kept = set(range(second, second + 5))
    for end in range(begins + 8, complete + 5, 7):
        if end in kept:
            continue
        with pytest.raises(StapeskitError) as caught:
            read(written(tmp_path, content[:end]))
        assert len(str(caught.value).splitlines()) == 1
    assert len(read(written(tmp_path, content)).recordings) == 2


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"said_count": 10**9}, "of 1000000000 values, as it says"),
        ({"said_count": 24}, "of 24 values, as it says; got 23"),
        ({"said_count": 10**9, "binary": "<"}, "bytes of values, as its header says"),
        ({"said_count": 24, "binary": "<"}, "bytes of values, as its header says"),
        ({"said_count": 22, "binary": "<"}, "bytes of values, as its header says"),
        ({"said_count": 0}, "with at least one value"),
        ({"form": 3}, "of type 2, 4, 5 or 6"),
    ],
)
def test_a_file_that_lies_is_refused_before_memory_is_taken(how, words, tmp_path):
    form = how.pop("form", 5)
    content = uff.function(X, Y, **how)
    if form == 3:
        content = content.replace(f"{5:10d}{23:10d}".encode(), f"{3:10d}{23:10d}".encode())
    path = written(tmp_path, content)
    tracemalloc.start()
    with pytest.raises(StapeskitError) as caught:
        read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert words in str(caught.value)
    assert peak < 5e6


def test_a_wrong_number_of_bytes_is_forgiven_when_the_values_are_whole(tmp_path):
    (made,) = read(written(tmp_path, uff.function(X, Y, form=6, binary="<", said_bytes=184))).recordings
    np.testing.assert_array_equal(made.value, Y)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (b"    58\n", b"  text\n", "the number of a dataset"),
        (b" 5.00000E", b" 5.0x000E", "a value of a function must be a number"),
        (b"  1.25000E+01  1.25000E+01", b"  1.25000E+01  0.00000E+00", "must be positive; got 0"),
        (b"  1.25000E+01  1.25000E+01", b" -1.25000E+02  1.25000E+01", "must be different and not negative"),
        (b"         5        23", b"         5        2x", "type, number and spacing"),
    ],
)
def test_spoiled_records_are_named(old, new, words, tmp_path):
    content = uff.function(X, np.full(23, 5.0 + 5.0j))
    assert old in content
    assert words in fault(tmp_path, content.replace(old, new, 1))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            b"    58b     1     2",
            b"    58b     3     2",
            "the byte order of a dataset 58b must be 1",
        ),
        (
            b"    58b     1     2",
            b"    58b     1     1",
            "dataset 58b must be 2 (IEEE 754); got 1",
        ),
        (b"          11", b"           3", "must be 11 lines long; got 3 lines"),
        (b"    58b     1     2", b"    58b  oops     2", "byte order, format, lines and bytes"),
    ],
)
def test_spoiled_binary_headers_are_named(old, new, words, tmp_path):
    content = uff.function(X, Y, form=6, binary="<")
    assert words in fault(tmp_path, content.replace(old, new, 1))


def test_all_faults_of_a_file_are_told_by_dataset_line_and_column(tmp_path):
    values = np.full(23, 5.0 + 5.0j)
    bad = uff.function(X, values, 2).split(b"\n")
    bad[14] = bad[14].replace(b"5.00000E+00", b"5.0x000E+00", 2)
    bad[16] = bad[16].replace(b"5.00000E+00", b"5_0000E+000", 1)
    parts = [
        uff.units(-1.0),
        uff.nodes_15({1: (0, 0, 0), 2: (1, 0, 0)}).replace(b"0.00000E+00\n", b"0.00o00E+00\n"),
        uff.function(X, Y, 1, unit="parsec", form=6, binary="<"),
        b"\n".join(bad),
        uff.function(X, Y, 3, direction=5),
        uff.function(X, Y, 4, form=6, binary=">", said_count=24),
        uff.function(X, Y, 5).replace(b"    4         1    1", b"    4         a    1"),
        uff.function(X, np.full(23, 2.0), 6, 3, kind=uff.COHERENCE, form=2),
        uff.function(X, Y, 6),
        uff.function(X[::-1] * 1.0, Y, 7, even=False).replace(b"  1.25000E+01", b" -1.25000E+01"),
    ]
    told = fault(tmp_path, *parts).splitlines()
    expected = [
        "the length factor of dataset 164 must be positive; got -1 (scan.uff, dataset 1, line 4)",
        "(scan.uff, dataset 2, line 9)",
        "(scan.uff, dataset 2, line 10)",
        "the unit of the values must be one of m, mm, um, nm; m/s, mm/s, um/s; m/s2, mm/s2, g [per unit",
        '"5.0x000E+00" (scan.uff, dataset 4, line',
        "column 1). Export it again",
        "column 2). Export it again",
        '"5_0000E+000"',
        "the direction at node 3 must be 0 (scalar)",
        "must be of 384 bytes of values, as its header says",
        "record 6 of a function must be function type, node and direction",
        "the coherence must be within 0 and 1; got 2 to 2 (scan.uff, dataset 9)",
        "the frequencies of a function must be different and not negative; got -12.5 at value 23 (scan.uff",
    ]
    for words in expected:
        assert any(words in line for line in told), (words, told)
    assert len(told) == 12


def test_a_missing_rule_spoils_its_own_dataset_alone(tmp_path):
    first, second, third = (uff.function(X, Y, node) for node in (1, 2, 3))
    open_ended = second[: -len(b"    -1\n")]
    told = fault(tmp_path, first, open_ended, third).splitlines()
    assert told == [
        "a dataset must be closed by a line that holds -1; got the beginning of the next one (scan.uff, "
        "dataset 2, line 24). It looks cut short: export or copy it again."
    ]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_marks_of_encodings_and_line_ends(encoding, tmp_path):
    text = uff.function(X, Y, 1, names=("\u00dcber 20 \u00b0C", "Vib  Geschwindigkeit")).decode("latin-1")
    for ends in ("\n", "\r\n", "\r"):
        (made,) = read(written(tmp_path, text.replace("\n", ends).encode(encoding))).recordings
        np.testing.assert_allclose(made.value, Y, rtol=1e-5)


def test_numbers_without_bounds_are_refused(tmp_path):
    far = uff.system_18(3, (0, 0, 0), (1e200, 0, 0), (0, 0, 1e200))
    assert "must be three points that span a plane" in fault(
        tmp_path, far, uff.nodes_15({1: (0, 0, 0)}, 3, 3), uff.function(X, Y)
    )
    steep = uff.function(X, Y).replace(b"  1.25000E+01  1.25000E+01", b"  1.25000E+01 1.25000+307")
    assert "must be different and not negative" in fault(tmp_path, steep)


@pytest.mark.parametrize("text", ["1.2.3", "1.0 abc", "1,5", "x", "1.0D+0x"])
def test_a_length_factor_with_more_than_numbers_is_refused(tmp_path, text):
    odd = uff.units().replace(b"1.0000000000000000D+00", text.rjust(22).encode(), 1)
    told = fault(tmp_path, odd, uff.function(X, Y, 1))
    assert "the length factor of dataset 164 must be positive; got" in told
    assert text.split()[0] in told


def test_a_number_of_a_million_digits_takes_no_room_for_its_neighbours(tmp_path):
    words = uff.function(X, Y)
    exponents = [place for place in range(len(words)) if words[place : place + 2] == b"E-"]
    whole, last = exponents[-10], exponents[-1]  # in a line of six numbers, and in the last one of four
    path = written(tmp_path, uff.units(), words[:whole] + b"0" * 1_000_000 + words[whole:])
    tracemalloc.start()
    (made,) = read(path).recordings
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_allclose(made.value, Y, rtol=1e-5)
    assert peak < 8e6
    cut = words[:last] + b"0" * 1_000_000 + words[last:]
    assert "at most 78 characters long; got 1000052 characters" in fault(tmp_path, uff.units(), cut)
