"""Faults of the tidy table, each with its line and column."""

from __future__ import annotations

import re
import time
import tracemalloc

import pytest

from legacy.kinematics.tidy.ldv_csv import read_ldv
from legacy.stapeskit.faults import StapeskitError
from tests.kinematics.written_csv import HEAD, THREE_ROWS, WITH_BEAMS, table, written


@pytest.mark.parametrize("word", ["n/a", "NA", "N/A", "#N/A", "#DIV/0!", "null", "None", "-", "missing"])
def test_words_for_missing_values_are_refused_with_their_place(tmp_path, word):
    rows = ["s,1,0,0,0,y,100,1,2", f"s,1,0,0,0,y,200,{word},3", "s,1,0,0,0,y,300,1,1"]
    with pytest.raises(StapeskitError) as caught:
        read_ldv(table(tmp_path, HEAD, rows))
    found = (
        f're_m_s must be a number; got "{word}" (ldv.csv, line 3). Write a plain number, or leave the cell'
    )
    assert str(caught.value).startswith(found)


def test_a_line_of_units_below_the_header_is_one_fault(tmp_path):
    rows = [",,mm,mm,mm,,Hz,m/s,m/s", "s,1,0,0,0,y,100,1,2"]
    with pytest.raises(StapeskitError) as caught:
        read_ldv(table(tmp_path, HEAD, rows))
    (fault,) = caught.value.faults
    assert fault.thing == "the line below the header"
    assert fault.where.numbers == (2,)


@pytest.mark.parametrize(
    ("head", "row", "match"),
    [
        (
            HEAD,
            "s,1,0,0,0,y,0,1,2",
            r"freq_hz must be positive and finite; got 0 \(ldv.csv, line 3, freq_hz\)",
        ),
        (HEAD, "s,1,0,0,0,y,-5,1,2", r"got -5 \(ldv.csv, line 3, freq_hz\)"),
        (HEAD, "s,1,0,0,0,y,,1,2", r"got an empty or NaN cell \(ldv.csv, line 3, freq_hz\)"),
        (HEAD, "s,1,0,0,0,y,7,inf,2", r"re_m_s must be finite; got inf \(ldv.csv, line 3, re_m_s\)"),
        (HEAD, "s,1,0,0,0,y,7,abc,2", r're_m_s must be a number; got "abc" \(ldv.csv, line 3\)'),
        (
            HEAD,
            "s,1,0,0,0,y,7,1_000,2",
            r're_m_s must be a number; got "1_000" .*line 3.* Write a plain number',
        ),
        (HEAD, 's,1,0,0,0,y,7,"1,5",2', r"Write a point for the decimals"),
        (HEAD, "s,1,0,0,0,y,7,1,5,2", r"a row must be 9 cells long.*got 10 .*Decimal commas need semicolons"),
        (HEAD, "s,1,0,0,0,y,7", r"a row must be 9 cells long, as the header is; got 7 \(ldv.csv, line 3\)"),
        (HEAD, "s,1,0,0,0,up,7,1,2", r"dir must be x, y, z, -x, -y or -z; got up"),
        (HEAD, "s,1,0,0,0,,7,1,2", r"dir must be .*got an empty cell"),
        (HEAD, "s,1,0,0,0,y,100,8,9", r"the only one of its run.*the same as in line 2 .*line 3"),
        (HEAD, "s,1,0,0.1,0,x,100,8,9", r"the position of point 1 of body s must be one; .*line 2 and"),
        (HEAD, "s,1,,0,0,x,100,8,9", r"x_mm, y_mm, z_mm must be finite numbers"),
        (HEAD, ",1,0,0,0,x,100,8,9", r"body must be a name; got an empty cell \(ldv.csv, line 3, body\)"),
        (WITH_BEAMS, "s,1,0,0,0,0,0,0,7,1,2", r"unit vector \(within 1e-3\); got \(0, 0, 0\) of length 0"),
        (WITH_BEAMS, "s,1,0,0,0,0,1.01,0,7,1,2", r"unit vector .* of length 1.01"),
        (
            WITH_BEAMS,
            "s,1,0,0,0,0,,0,7,1,2",
            r"unit vector .*; got \(0, nan, 0\) \(ldv.csv, line 3",
        ),
        (HEAD + ",sd_m_s", "s,1,0,0,0,x,7,1,2,-1", r"sd_m_s must be positive and finite; got -1"),
        (HEAD + ",coherence,n_avg", "s,1,0,0,0,x,7,1,2,1.1,4", r"coherence must be within 0 and 1; got 1.1"),
        (HEAD + ",n_avg", "s,1,0,0,0,x,7,1,2,0", r"n_avg must be 1 or more; got 0"),
    ],
)
def test_faulty_rows_are_named(tmp_path, head, row, match):
    first = {HEAD: "s,1,0,0,0,y,100,1,2", WITH_BEAMS: "s,1,0,0,0,0,1,0,100,1,2"}
    good = next(text for key, text in first.items() if head.startswith(key)) + ",1" * head.count(",c")
    good += ",1" * (head.count(",sd_") + head.count(",n_avg"))
    with pytest.raises(StapeskitError, match=match):
        read_ldv(table(tmp_path, head, [good, row]))


@pytest.mark.parametrize(
    ("head", "match"),
    [
        ("point,x_mm,y_mm,z_mm,dir,freq_hz,re_m_s,im_m_s", "no column body"),
        ("body,point,dir,freq_hz,re_m_s,im_m_s", "no column x_mm, y_mm, z_mm.*--points"),
        ("body,point,x_mm,y_mm,z_mm,dir_x,freq_hz,re_m_s,im_m_s", "no column dir_y, dir_z"),
        ("body,point,x_mm,y_mm,z_mm,dir,freq_hz,re_m_s", "re_m_s with im_m_s.*got re_m_s alone"),
        ("body,point,x_mm,y_mm,z_mm,dir,freq_hz,amp_m", "got amp_m alone"),
        ("body,point,x_mm,y_mm,z_mm,dir,freq_hz", "got none of them .*Add the missing column"),
        (
            "body,point,x_mm,y_mm,z_mm,dir,freq_hz,re_inch_s,im_inch_s",
            "unit of column re_inch_s must be one of",
        ),
        ("body,point,x_mm,y_mm,z_mm,dir,freq_khz,re_m,im_m", "frequency column freq_khz must be freq_hz"),
        ("body,point,x_mm,y_mm,z_mm,dir,freq_hz,amp_m,phase_rad", "phase column phase_rad must be phase_deg"),
        (HEAD + ",amp_m_s", "the value must be given once"),
        (HEAD + ",re_m", "the value must be given once"),
        (HEAD.replace("im_m_s", "im_mm_s"), "real and imaginary part must be in one unit"),
        (HEAD + ",dir_x", "the direction must be given once"),
        (HEAD + ",sd_m", "the standard deviation must be sd_m_s, in the unit of its value"),
        (HEAD + ",sd_rms_m_s", "the standard deviation must be sd_m_s"),
        (HEAD + ",sd_m_s,sd_mm_s", "the standard deviation must be given once"),
        (HEAD + ",body", "column names must be different; got body twice"),
    ],
)
def test_faulty_headers_are_named(tmp_path, head, match):
    with pytest.raises(StapeskitError, match=match):
        read_ldv(table(tmp_path, head, ["x"]))


def test_all_faults_come_in_one_message(tmp_path):
    rows = [
        *THREE_ROWS,
        "stapes,2,1,0,0,up,100,5,6",
        "stapes,3,1,0,0,x,-1,5,oops",
        "stapes,4,1,0,0,x,100,inf,6,7",
    ]
    with pytest.raises(StapeskitError) as caught:
        read_ldv(table(tmp_path, rows=rows))
    lines = str(caught.value).splitlines()
    assert len(lines) == 4
    assert {int(number) for number in re.findall(r"line (\d+)", str(caught.value))} == {5, 6, 7}


def test_duplicates_are_told_beside_other_faults(tmp_path):
    rows = [*THREE_ROWS, "stapes,3,1,0,0,x,-1,5,6", THREE_ROWS[0], "stapes,4,1,0,0,x,100,oops,6"]
    with pytest.raises(StapeskitError) as caught:
        read_ldv(table(tmp_path, rows=rows))
    assert len(str(caught.value).splitlines()) == 3
    assert re.search(r"the same as in line 2 \(ldv.csv, line 6\)", str(caught.value))


@pytest.mark.parametrize(
    ("head", "row", "column"),
    [
        (WITH_BEAMS, "s,1,0,0,0,0,a,0,7,1,2", "dir_y"),
        (WITH_BEAMS, "s,1,0,0,0,0,1,0,b,1,2", "freq_hz"),
        (WITH_BEAMS, "s,1,0,c,0,0,1,0,7,1,2", "y_mm"),
    ],
)
def test_a_text_is_one_fault(tmp_path, head, row, column):
    with pytest.raises(StapeskitError) as caught:
        read_ldv(table(tmp_path, head, [row]))
    (line,) = str(caught.value).splitlines()
    assert line.startswith(f"{column} must be a number")


def test_an_unknown_unit_is_told_once(tmp_path):
    head = HEAD.replace("re_m_s,im_m_s", "re_inch_s,im_inch_s")
    with pytest.raises(StapeskitError) as caught:
        read_ldv(table(tmp_path, head, ["x"]))
    assert [
        "of column re_inch_s" in line or "of column im_inch_s" in line
        for line in str(caught.value).splitlines()
    ] == [True, True]


def test_every_fault_says_what_to_do_next(tmp_path):
    heads = [
        "point,x_mm,dir,freq_khz,re_inch",
        HEAD + ",sd_m,dir_x",
        HEAD + ",amp_m",
        HEAD.replace("im_m_s", "im_mm_s"),
    ]
    bad = [
        "s,1,0,0,0,y,0,1,2",
        "s,1,0,0,1,up,7,inf,a",
        ",1,,0,0,y,,1,2",
        "s,2,0,0,0,y,5,1,2",
        "s,2,0,0,0,y,5,1,2",
    ]
    for head, rows in [*((head, ["x"]) for head in heads), (HEAD, bad)]:
        with pytest.raises(StapeskitError) as caught:
            read_ldv(table(tmp_path, head, rows))
        for line in str(caught.value).splitlines():
            assert re.search(r"\(ldv.csv, line .*\)\. [A-Z].*[.?]$", line), line


def test_points_must_be_listed_once_and_agree(tmp_path):
    path = table(tmp_path, "body,point,dir,freq_hz,re_m_s,im_m_s", ["s,1,y,100,1,2", "s,9,y,100,1,2"])
    points = written(tmp_path, "body,point,x_mm,y_mm,z_mm\ns,1,0,0,0\n", "p.csv")
    with pytest.raises(StapeskitError, match=r"point 9 of body s must be listed in p.csv.*line 3"):
        read_ldv(path, points)
    points = written(tmp_path, "body,point,x_mm,y_mm,z_mm\ns,1,0,0,0\ns,1,0,0,1\ns,9,0,0,0\n", "p.csv")
    with pytest.raises(StapeskitError, match="listed once; got a second position"):
        read_ldv(path, points)
    points = written(tmp_path, "body,point,x_mm,y_mm,z_mm,sd_mm\ns,1,0,,0,-1\n,9,0,0,0,1\n", "p.csv")
    with pytest.raises(StapeskitError, match="y_mm must be a finite number") as caught:
        read_ldv(path, points)
    assert "sd_mm must be positive" in str(caught.value)
    assert "body and point must be names" in str(caught.value)
    points = written(tmp_path, "body,point,x_mm,y_mm,z_mm\nstapes,1,0,0,0.1\nstapes,2,1,0,0\n", "p.csv")
    with pytest.raises(StapeskitError, match="the position of point 1 of body stapes must be one"):
        read_ldv(table(tmp_path), points)
    with pytest.raises(StapeskitError, match="no column z_mm"):
        read_ldv(path, written(tmp_path, "body,point,x_mm,y_mm\ns,1,0,0\n", "p.csv"))


def test_sd_that_is_empty_throughout_is_refused(tmp_path):
    with pytest.raises(StapeskitError, match="sd_m_s must be a number in at least one row"):
        read_ldv(table(tmp_path, HEAD + ",sd_m_s", [row + ",nan" for row in THREE_ROWS]))


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"", "an empty file"),
        (HEAD.encode(), "the header alone"),
        ((HEAD + "\n,,,,,,,,\n,,,,,,,,\n").encode(), "got empty rows"),
        (HEAD.encode("utf-16-le"), "UTF-16 or binary"),
        (("\ufeff" + HEAD).encode("utf-16"), "the header alone"),
        ((HEAD + "\nst\u00e4pes,1,0,0,0,y,100,1,\u00b52\n").encode("latin-1"), "another encoding"),
        (b"\x00\x01\x02" * 100, "UTF-16 or binary"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path, data, match):
    with pytest.raises(StapeskitError, match=match):
        read_ldv(written(tmp_path, data))


def test_other_formats_are_told_what_is_read(tmp_path):
    with pytest.raises(StapeskitError, match="an existing CSV file"):
        read_ldv(tmp_path / "nowhere.csv")
    with pytest.raises(StapeskitError, match=r"a CSV table .*which is what is read now"):
        read_ldv(written(tmp_path, b"x", "scan.uff"))
    with pytest.raises(StapeskitError, match="a CSV table"):
        read_ldv(tmp_path)


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("stapes,p{0},{0},2,3,1,0,0,{1},1,2,1", "3000 readings of 3000 channels in 3000 lines and 1 runs"),
        ("stapes,p{0},{0},2,3,1,0,0,100,1,2,r{0}", "3000 readings of 3000 channels in 1 lines and 3000 runs"),
        ("b{0},p,1,2,3,1,0,0,100,1,2,1", "the bodies must be at most 1000; got 3000"),
    ],
)
def test_readings_that_share_no_lines_runs_or_bodies_are_refused_in_little_memory(tmp_path, row, words):
    path = tmp_path / "ldv.csv"
    path.write_text(WITH_BEAMS + ",run\n" + "".join(row.format(k, k + 1) + "\n" for k in range(3000)))
    tracemalloc.start()
    with pytest.raises(StapeskitError) as caught:
        read_ldv(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert words in str(caught.value)
    assert peak < 30 << 20


def test_columns_of_one_name_are_found_among_many(tmp_path):
    path = tmp_path / "ldv.csv"
    path.write_text("body,point," + "re_m_s,im_m_s," * 100_000 + "x\n" + "1," * 200_002 + "1\n")
    begun = time.process_time()
    with pytest.raises(StapeskitError, match="im_m_s, re_m_s twice"):
        read_ldv(path)
    assert time.process_time() - begun < 5.0
