"""Tables as spreadsheets and people write them: read alike, or refused with line and column."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from legacy.kinematics.tidy.ldv_csv import read_ldv
from legacy.kinematics.tidy.points_csv import read_points
from legacy.stapeskit.faults import StapeskitError
from tests.kinematics.written_csv import FIRST, HEAD, ROWS, plain, same, written


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    return read_ldv(written(tmp_path_factory.mktemp("plain"), plain()))


def semicolons(text):
    return text.replace(",", ";")


def decimal_commas(text):
    return text.replace(",", ";").replace(".", ",")


DIALECTS = {
    "semicolons": semicolons(plain()),
    "decimal commas": decimal_commas(plain()),
    "tabs": plain().replace(",", "\t"),
    "tabs and decimal commas": decimal_commas(plain()).replace(";", "\t"),
    "carriage returns": plain(end="\r\n"),
    "old line ends": plain(end="\r"),
    "byte order mark": "\ufeff" + plain(),
    "utf-16": plain().encode("utf-16"),
    "utf-16 big": b"\xfe\xff" + plain().encode("utf-16-be"),
    "utf-16 tabs": plain(end="\r\n").replace(",", "\t").encode("utf-16"),
    "excel": "sep=;\r\n" + decimal_commas(plain(end="\r\n")),
    "quoted excel line": '"sep=,"\n' + plain(),
    "comments above": "# measured on a Tuesday\n\n# by us\n" + plain(),
    "comments between": plain([ROWS[0], "# a pause, at noon", *ROWS[1:]]),
    "blank lines": plain(["", *ROWS[:5], "", "  ", *ROWS[5:], "", ""]),
    "empty rows": plain([*ROWS, ",,,,,,,,", ",,,,,,,,"]),
    "quotes": plain([re.sub(r"^(\w+),(\d)", r'"\1","\2"', row) for row in ROWS]),
    "all quoted": plain([",".join(f'"{c}"' for c in row.split(",")) for row in ROWS]),
    "blanks": plain([row.replace(",", " , ") for row in ROWS]),
    "upper case": plain(head=HEAD.upper()),
    "blanks in the header": plain(head="Body, Point, X mm, Y mm, Z mm, Dir, Freq Hz, Re m s, Im m s"),
    "brackets": plain(head="Body,Point,X [mm],Y [mm],Z [mm],Dir,Freq (Hz),Re [m/s],Im [m/s]"),
    "quoted header": plain(head=",".join(f'"{name}"' for name in HEAD.split(","))),
    "separator at the ends": plain([row + "," for row in ROWS], HEAD + ","),
    "no end": plain().rstrip(),
    "another order": plain([",".join(row.split(",")[::-1]) for row in ROWS], ",".join(HEAD.split(",")[::-1])),
}


@pytest.mark.parametrize("name", DIALECTS)
def test_dialects_are_read_to_the_last_bit(tmp_path, expected, name):
    same(read_ldv(written(tmp_path, DIALECTS[name])), expected)


def test_comments_are_told(tmp_path):
    read = read_ldv(written(tmp_path, plain([ROWS[0], "#stapes,1,0,0,0,y,300,1,1", *ROWS[1:]])))
    assert [notice.code for notice in read.notices] == ["comments_skipped"]


def test_columns_that_are_not_used_are_told(tmp_path):
    rows = [row + ",21.5,0.9" for row in ROWS]
    read = read_ldv(written(tmp_path, plain(rows, HEAD + ",temperature,coherance")))
    (notice,) = read.notices
    assert notice.code == "columns_ignored"
    assert "temperature, coherance (did you mean coherence?)" in notice.text


def test_the_lines_told_are_those_of_the_file(tmp_path):
    rows = list(ROWS)
    rows[3] = rows[3].replace("stapes", "st,apes")
    text = "sep=,\n# note\n\n" + plain(["", *rows[:2], "# pause", *rows[2:]])
    with pytest.raises(StapeskitError, match="line 10") as caught:
        read_ldv(written(tmp_path, text))
    assert "must be 9 cells long" in str(caught.value)
    with pytest.raises(StapeskitError, match=r"no column body \(ldv.csv, line 3\)"):
        read_ldv(written(tmp_path, "# note\n\n" + plain(head=HEAD.replace("body", "bone"))))


@pytest.mark.parametrize(
    ("cell", "words"),
    [
        ("1.234,5", "nothing between thousands"),
        ("1 234", "a plain number"),
        ("1'234", "a plain number"),
        ("1_000", "a plain number"),
        ("0x10", "a plain number"),
        ("1d-3", "a plain number"),
        ("\u22125", "a plain number"),
        ("1+2i", "a plain number"),
        ("#DIV/0!", "a plain number"),
        ("true", "a plain number"),
    ],
)
@pytest.mark.parametrize("mark", [";", "\t"])
def test_what_is_no_number_is_refused(tmp_path, cell, words, mark):
    rows = [row.replace(",", ";").replace(".", ",").split(";") for row in ROWS]
    rows[4][7] = cell
    text = plain([mark.join(row) for row in rows], HEAD.replace(",", mark))
    with pytest.raises(
        StapeskitError, match=rf're_m_s must be a number; got "{re.escape(cell)}" \(ldv.csv, line 6\)'
    ) as caught:
        read_ldv(written(tmp_path, text))
    assert words in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_decimal_points_among_decimal_commas_are_refused(tmp_path):
    rows = [decimal_commas(row) for row in ROWS]
    rows[7] = semicolons(ROWS[7])
    with pytest.raises(StapeskitError, match=r"line 9\)") as caught:
        read_ldv(written(tmp_path, plain(rows, semicolons(HEAD))))
    assert {int(n) for n in re.findall(r"line (\d+)\)", str(caught.value))} == {9}


def test_words_for_truth_are_no_numbers(tmp_path):
    rows = [row.split(",") for row in ROWS]
    for row in rows:
        row[8] = "True"
    with pytest.raises(StapeskitError, match=r'im_m_s must be a number; got "True" .*lines 2 to 25\)'):
        read_ldv(written(tmp_path, plain([",".join(row) for row in rows])))


def test_cells_moved_from_row_to_row_are_found(tmp_path):
    rows = list(ROWS)
    rows[2] += ",5"
    rows[6] = rows[6].rsplit(",", 1)[0]
    with pytest.raises(StapeskitError) as caught:
        read_ldv(written(tmp_path, plain(rows)))
    told = str(caught.value)
    assert "got 10 (ldv.csv, line 4)" in told
    assert "got 8 (ldv.csv, line 8)" in told
    assert "ends before im_m_s" in told


def test_runs_and_levels_named_in_some_rows_only_are_refused(tmp_path):
    for name in ("run", "repeat", "level"):
        rows = [f"{row},{'' if k == 5 else '1'}" for k, row in enumerate(ROWS)]
        with pytest.raises(StapeskitError) as caught:
            read_ldv(written(tmp_path, plain(rows, f"{HEAD},{name}")))
        assert str(caught.value) == (
            f"{name} must be given in every row, or in none; got an empty cell "
            f"(ldv.csv, line 7, {name}). Fill it in."
        )
        rows = [f"{row}," for row in ROWS]
        assert read_ldv(written(tmp_path, plain(rows, f"{HEAD},{name}"))).runs == ("1",)


def test_rows_parted_otherwise_than_the_header(tmp_path):
    with pytest.raises(
        StapeskitError, match="Separate all cells by commas, as in the header, not by semicolons"
    ):
        read_ldv(written(tmp_path, plain([semicolons(row) for row in ROWS])))


def test_an_unclosed_quotation_mark_is_named(tmp_path):
    rows = list(ROWS)
    rows[3] = '"' + rows[3]
    with pytest.raises(StapeskitError, match=r"\(ldv.csv, line 5\). Close the quotation mark"):
        read_ldv(written(tmp_path, plain(rows)))


def test_many_faults_name_every_line_and_every_kind(tmp_path):
    rows = []
    for k in range(200):
        rows.append(f"stapes,{k},0,0,0,up,100,1,2")
    rows[150] = "stapes,150,0,0,0,y,-5,1,2"
    rows[160] = "stapes,160,0,0,0,y,100,one,2"
    with pytest.raises(StapeskitError) as caught:
        read_ldv(written(tmp_path, plain(rows)))
    faults = caught.value.faults
    assert [str(fault.where) for fault in faults if fault.got == "-5"] == ["ldv.csv, line 152, freq_hz"]
    assert [str(fault.where) for fault in faults if fault.got == '"one"'] == ["ldv.csv, line 162"]
    assert len([fault for fault in faults if fault.thing == "dir"]) == 198
    text = str(caught.value)
    assert "got up (ldv.csv, lines 2 to 151, 153 to 161, 163 to 201, dir)" in text
    assert len(text.splitlines()) == 3


def test_faults_of_both_files_come_together(tmp_path):
    points = written(tmp_path, "body,point,x_mm,y_mm,z_mm\ns,1,0,oops,0\ns,2,0,0,\n", "points.csv")
    head = "body,point,dir,freq_hz,re_m_s,im_m_s"
    table = written(tmp_path, plain(["s,1,y,0,1,2", "s,2,up,5,1,2"], head))
    with pytest.raises(StapeskitError) as caught:
        read_ldv(table, points)
    lines = str(caught.value).splitlines()
    assert len(lines) == 4
    assert sum("points.csv" in line for line in lines) == 2
    table = written(tmp_path, plain(["s,1,y,0,1,2"], head.replace("dir", "richtung")))
    with pytest.raises(StapeskitError, match="no column dir_x, dir_y, dir_z") as caught:
        read_ldv(table, points)
    assert "points.csv, line 2" in str(caught.value)


def test_unknown_bodies_and_names_in_other_letters(tmp_path):
    points = written(tmp_path, "body,point,x_mm,y_mm,z_mm\nStapes,1,0,0,0\nbone,1,0,0,1\n", "points.csv")
    head = "body,point,dir,freq_hz,re_m_s,im_m_s"
    table = written(tmp_path, plain(["stapes,1,y,5,1,2", "incus,1,y,5,1,2"], head))
    with pytest.raises(StapeskitError) as caught:
        read_ldv(table, points)
    told = str(caught.value)
    assert "no row of that name there, but Stapes 1 (ldv.csv, line 2, point). Write both names alike" in told
    assert "no point of that body there, only of Stapes, bone (ldv.csv, line 3, point)" in told
    read = read_ldv(written(tmp_path, plain(["Stapes,1,y,5,1,2"], head)), points)
    assert [notice.code for notice in read.notices] == ["bodies_not_measured"]
    table = written(tmp_path, plain(["s,1,0,0,0,y,5,1,2", "S,1,0,0,0,y,5,1,2"]))
    assert [notice.code for notice in read_ldv(table).notices] == ["names_alike"]


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(value=st.floats(-1e100, 1e100))
def test_numbers_are_read_to_the_nearest(tmp_path, value):
    row = f"s,1,0,0,0,y,100,{value!r},{value:.17e}"
    read = read_ldv(written(tmp_path, plain([row], HEAD.replace("m_s", "m"))))
    got = read.bodies[0].displacement[0, 0, 0]
    assert abs(got.real - value) <= np.spacing(abs(value))
    assert abs(got.imag - value) <= np.spacing(abs(value))


def test_numbers_beyond_any_motion_and_torn_headers_are_refused(tmp_path):
    rows = ["s,1,0,0,0,y,1e13,1,2", "s,1,0,0,0,y,5,1e101,2", "s,1,0,0,0,y,6,1e400,-1e308"]
    rows += ["s,1,0,0,0,y,4e-298,1,2"]
    with pytest.raises(StapeskitError) as caught:
        read_ldv(written(tmp_path, plain(rows)))
    told = [line.split(". ")[0] for line in str(caught.value).splitlines()]
    assert sorted(told) == [
        "freq_hz must be 1e-12 Hz or more; got 4e-298 (ldv.csv, line 5, freq_hz)",
        "freq_hz must be at most 1e+12 Hz; got 1e+13 (ldv.csv, line 2, freq_hz)",
        "im_m_s must be below 1e+100; got -1e+308 (ldv.csv, line 4, im_m_s)",
        "re_m_s must be below 1e+100; got 1e+101 (ldv.csv, line 3, re_m_s)",
        "re_m_s must be finite; got inf (ldv.csv, line 4, re_m_s)",
    ]
    table = written(tmp_path, HEAD.replace("freq_hz", "freq\r_hz") + "\ns,1,0,0,0,y,5,1,2\n")
    with pytest.raises(StapeskitError, match="the header must be one line of names; got new-line character"):
        read_ldv(table)
    far = written(tmp_path, plain(["s,1,0,0,0,1e301,0,0,5,1,2"], HEAD.replace("dir", "dir_x,dir_y,dir_z")))
    with pytest.raises(StapeskitError, match="must be a unit vector"):
        read_ldv(far)


def test_positions_beyond_any_place_are_refused(tmp_path):
    rows = ["a,1,0,0,1e200,0.1", "a,2,0,n/a,0,0.1", "a,3,0,0,0,1e300", "a,4,0,0,0,1e-300"]
    path = written(tmp_path, "body,point,x_mm,y_mm,z_mm,sd_mm\n" + "\n".join(rows) + "\n", "points.csv")
    with pytest.raises(StapeskitError) as caught:
        read_points(path)
    told = [line.split(". ")[0] for line in str(caught.value).splitlines()]
    assert sorted(told) == [
        "sd_mm must be within 1e-12 and 1e+09 mm; got 1e+300 (points.csv, line 4)",
        "sd_mm must be within 1e-12 and 1e+09 mm; got 1e-300 (points.csv, line 5)",
        'y_mm must be a number; got "n/a" (points.csv, line 3)',
        "z_mm must be within 1e+09 mm; got 1e+200 (points.csv, line 2)",
    ]


NOISE = [
    "",
    ",",
    ";",
    "\n",
    '"',
    "#",
    "x",
    "-",
    ".",
    "e",
    "9",
    " ",
    "\t",
    "nan",
    "inf",
    "0",
    "\r\n",
    "é",
    "\x00",
    "''",
    "1e5",
]


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.integers(0, len(plain()) - 1), cut=st.integers(0, 3), put=st.sampled_from(NOISE))
def test_any_corruption_is_refused_in_place_or_changes_what_it_touches_only(
    tmp_path, expected, place, cut, put
):
    text = plain()
    spoiled = text[:place] + put + text[place + cut :]
    line = text[:place].count("\n") + 1
    try:
        read = read_ldv(written(tmp_path, spoiled))
    except StapeskitError as fault:
        told = str(fault)
        assert "ldv.csv" in told
        if "\x00" not in spoiled:
            numbers = {int(n) for n in re.findall(r"lines? (\d+)", told)}
            near = {1, line - 1, line, line + 1, line + 2}
            bodies_apart = "frequencies of bodies" in told
            assert numbers & near or bodies_apart, told
        return
    values = {v for body in expected.bodies for v in body.displacement.ravel().tolist() if v == v}
    got = {v for body in read.bodies for v in body.displacement.ravel().tolist() if v == v}
    touched = text[place : place + cut].count("\n") + put.count("\n") + 2
    assert len(values - got) <= touched
    assert len(got - values) <= touched


def test_a_table_without_header_is_told_so(tmp_path):
    path = written(tmp_path, "\n".join(ROWS) + "\n")
    with pytest.raises(StapeskitError, match=r"the first line must be the header; got numbers \(ldv.csv, li"):
        read_ldv(path)


def test_bad_cells_are_listed_by_line(tmp_path):
    rows = list(ROWS)
    rows[4] = rows[4].replace("1.125", "left")
    rows[1] = rows[1].replace("250.5", "1k")
    with pytest.raises(StapeskitError) as caught:
        read_ldv(written(tmp_path, plain(rows)))
    assert re.findall(r"line (\d+)", str(caught.value)) == [str(1 + FIRST), str(4 + FIRST)]


def test_large_files_are_mapped_into_memory(tmp_path, monkeypatch, expected):
    from legacy.stapeskit.tables import csv_text

    monkeypatch.setattr(csv_text, "_LARGE", 10)
    for name in ("semicolons", "byte order mark", "utf-16", "old line ends", "comments between", "quotes"):
        same(read_ldv(written(tmp_path, DIALECTS[name], f"{name}.csv")), expected)
    with pytest.raises(StapeskitError, match="UTF-16 or binary"):
        read_ldv(written(tmp_path, plain() + "\x00"))
    with pytest.raises(StapeskitError, match="an empty file"):
        read_ldv(written(tmp_path, " " * 50 + "\n"))
    with pytest.raises(StapeskitError, match="another encoding"):
        read_ldv(written(tmp_path, plain([*ROWS, ROWS[0].replace("stapes", "st\xe4pes")]).encode("latin-1")))
