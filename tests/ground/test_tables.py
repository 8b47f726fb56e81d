"""Tables as laboratories write them are read right or refused with line and cause, on both paths alike."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stapeskit import tables
from stapeskit.faults import Fault, StapeskitError
from stapeskit.tables import Table, read_table

HEAD = "body,freq_hz,re_m_s"
MISSING = ("", "nan", "NaN", "NAN", "Nan", "-nan", "+nan", "-NaN")


def choose(header, name):
    missing = {"body", "freq_hz", "re_m_s"} - set(header)
    if missing:
        raise StapeskitError.of("columns", "complete", sorted(missing), tables.Place(name, "line", (1,)))
    return {"freq_hz", "re_m_s"}, {"body"}


@pytest.fixture
def read(tmp_path: Path):
    def write_and_read(content: str | bytes) -> Table:
        path = tmp_path / "t.csv"
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return read_table(path, choose)

    return write_and_read


@pytest.fixture
def fault_of(read):
    def only_fault(content: str | bytes) -> Fault:
        try:
            (fault,) = read(content).faults
        except StapeskitError as error:
            (fault,) = error.faults
        return fault

    return only_fault


PLAIN = f"{HEAD}\nstapes,100.5,1e-6\nbase,200,-2.5\n"
DIALECTS = {
    "plain": PLAIN,
    "no line feed at the end": PLAIN.rstrip(),
    "returns": PLAIN.replace("\n", "\r\n"),
    "old returns": PLAIN.replace("\n", "\r"),
    "semicolons": PLAIN.replace(",", ";"),
    "decimal commas": PLAIN.replace(",", ";").replace(".", ","),
    "tabs and decimal commas": PLAIN.replace(",", "\t").replace(".", ","),
    "a byte order mark": b"\xef\xbb\xbf" + PLAIN.encode(),
    "utf-16": PLAIN.encode("utf-16"),
    "utf-16 big endian": b"\xfe\xff" + PLAIN.encode("utf-16-be"),
    "a line of Excel": "sep=;\n" + PLAIN.replace(",", ";"),
    "blanks": PLAIN.replace(",", " , "),
    "quotes": PLAIN.replace("stapes", '"stapes"').replace("200", '"200"'),
    "comments and blank lines": "# made by x\n\n" + PLAIN.replace("base", "# odd\n\nbase") + "\n\n",
    "empty rows of a spreadsheet": PLAIN + ",,\n,,\n",
    "an empty row amid the others": PLAIN.replace("base", ",,\nbase"),
    "an empty last column": PLAIN.replace("\n", ",\n"),
    "names for people": PLAIN.replace("freq_hz", "Freq (Hz)").replace("re_m_s", "Re [m/s]"),
    "a further column": PLAIN.replace("\n", ",x\n").replace("s,x", "s,note"),
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_every_dialect_is_the_same_table(read, dialect):
    table = read(DIALECTS[dialect])
    assert not table.faults
    assert not table.left_out
    assert table.numbers["freq_hz"].tolist() == [100.5, 200.0]
    assert table.numbers["re_m_s"].tolist() == [1e-6, -2.5]
    assert table.texts["body"].names == ("stapes", "base")
    assert table.texts["body"].codes.tolist() == [0, 1]


def test_empty_rows_at_the_end_of_a_table_of_names_are_none(tmp_path):
    (tmp_path / "names.csv").write_text("name,meaning\na,b\n,\n,\n")
    table = read_table(tmp_path / "names.csv", lambda *_: (set(), {"name", "meaning"}))
    assert table.texts["name"].codes.tolist() == [0]


def test_missing_cells_are_nan_and_texts_are_stored_once(read):
    rows = [f"b,1,{word}" for word in MISSING] + [",1,2", "a,1,inf", "b,1,-Infinity", "nan,1,2"]
    table = read("\n".join([HEAD, *rows]))
    assert not table.faults
    assert np.isnan(table.numbers["re_m_s"][: len(MISSING)]).all()
    assert table.numbers["re_m_s"][-4:].tolist() == [2.0, np.inf, -np.inf, 2.0]
    assert table.texts["body"].names == ("b", "a", "nan")
    assert table.texts["body"].codes.tolist()[-4:] == [-1, 1, 0, 2]


@pytest.mark.parametrize(("row", "thing", "got", "step"), [
    ("s,2,x", "re_m_s", '"x"', "missing"),
    ("s,2,1_000", "re_m_s", '"1_000"', "1000"),
    ("s,2,1 000", "re_m_s", '"1 000"', "thousands"),
    ("s,2,0x10", "re_m_s", '"0x10"', "1000"),
    ("s,2,True", "re_m_s", '"True"', "missing"),
    ("s,2,1d5", "re_m_s", '"1d5"', "1000"),
    ("s,2,٣", "re_m_s", '"٣"', "1000"),
    ("s,2,5 mm/s", "re_m_s", '"5 mm/s"', "1000"),
    ("s,2,#N/A", "re_m_s", '"#N/A"', "missing"),
    ("s,NA,1", "freq_hz", '"NA"', "missing"),
    ('s,2,"1,5"', "re_m_s", '"1,5"', "point"),
    ("s,2", "a row", "2", "one cell"),
    ("s,2,1,5", "a row", "4", "semicolons"),
    ("s;2;1", "a row", "1", "commas"),
    ('"s,2,1\nb,3,4', "a row", "1", "quotation mark"),
])  # fmt: skip
def test_odd_cells_and_rows_are_named_with_line_and_cause(fault_of, row, thing, got, step):
    fault = fault_of(f"{HEAD}\ns,1,1\n{row}\n")
    assert (fault.thing, fault.got, str(fault.where)) == (thing, got, "t.csv, line 3")
    assert step in fault.next_step


def test_a_faulty_cell_is_nan_and_its_row_is_known(read):
    table = read(f"{HEAD}\ns,1,1\n\ns,x,2\ns,3,y\n")
    assert [str(fault.where) for fault in table.faults] == ["t.csv, line 4", "t.csv, line 5"]
    assert table.invalid_rows().tolist() == [False, True, True]
    assert table.invalid_rows("freq_hz").tolist() == [False, True, False]
    assert np.isnan(table.numbers["freq_hz"][1])
    assert len(table) == 3


def test_latin_1_of_older_programs_is_read(read):
    assert "Knöchel" in read(PLAIN.replace("base", "Knöchel").encode("latin-1")).texts["body"].names


def test_mixed_decimals_are_refused_not_guessed(read):
    table = read("body;freq_hz;re_m_s\ns;1,5;1,5\ns;2,5;1.500\n")
    assert [(fault.thing, fault.got) for fault in table.faults] == [("re_m_s", '"1.500"')]


@pytest.mark.parametrize(("content", "thing", "where"), [
    ("", "a CSV file", "t.csv"),
    (" \n\n", "a CSV file", "t.csv"),
    ("# only\n# comments\n", "a CSV file", "t.csv"),
    (HEAD, "t.csv", ""),
    (f"{HEAD}\n,,\n;;\n", "t.csv", ""),
    (PLAIN.encode("utf-16")[2:], "a CSV file", "t.csv"),
    (b"\x00\x01\x02", "a CSV file", "t.csv"),
    ("1,2,3\n4,5,6\n", "the first line", "t.csv, line 1"),
    ("\nbody,freq_hz,re_m_s,Freq (Hz)\ns,1,2,3\n", "column names", "t.csv, line 2"),
    ("# x\nbody,freq_hz\ns,1\n", "columns", "t.csv, line 2"),
])  # fmt: skip
def test_what_is_no_table_is_refused(fault_of, content, thing, where):
    fault = fault_of(content)
    assert (fault.thing, str(fault.where)) == (thing, where)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(StapeskitError) as caught:
        read_table(tmp_path / "none.csv", choose)
    assert caught.value.faults[0].thing == "the table"


CELL = st.text("0123456789.,-+eEinfa _#\"'٣\t;xN", max_size=6) | st.floats(allow_nan=True).map(repr)


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.sampled_from(["s", "b ", "", "ä"]), CELL, CELL), min_size=1, max_size=5),
       st.sampled_from(",;"))  # fmt: skip
def test_both_paths_read_the_same(tmp_path, monkeypatch, rows, separator):
    path = tmp_path / "t.csv"
    lines = [HEAD.replace(",", separator), *(separator.join(row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    found = []
    for odd in (False, True):
        with monkeypatch.context() as patch:
            if odd:
                patch.setattr(tables, "_read_alike", lambda *_: None)
            try:
                table = read_table(path, choose)
            except StapeskitError as error:
                found.append(error.faults)
                continue
            numbers = np.array([table.numbers["freq_hz"], table.numbers["re_m_s"]])
            body = table.texts["body"]
            found.append(
                (body.names, body.codes.tolist(), table.lines.tolist(), table.faults, numbers.tobytes())
            )
    assert found[0] == found[1]


def test_a_large_table_is_read_fast(tmp_path):
    """300 000 rows within half a second of processor time (times two for a busy machine)."""
    rng = np.random.default_rng(0)
    values = rng.normal(size=(10_000, 2)) * 1e-6
    rows = "".join(f"stapes,{100 + k // 40},{a!r},{b!r},1e-8\n" for k, (a, b) in enumerate(values.tolist()))
    path = tmp_path / "large.csv"
    path.write_text("body,freq_hz,re_m_s,im_m_s,sd_m_s\n" + 30 * rows)
    spent = []
    for _ in range(2):
        start = time.process_time()
        table = read_table(path, lambda *_: ({"freq_hz", "re_m_s", "im_m_s", "sd_m_s"}, {"body"}))
        spent.append(time.process_time() - start)
    assert np.array_equal(table.numbers["re_m_s"][-10_000:], values[:, 0])
    assert len(table) == 300_000
    assert min(spent) < 1.0
