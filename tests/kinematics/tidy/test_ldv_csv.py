"""The tidy table: every unit, every shorthand, every fault with its line and column."""

from __future__ import annotations

import re
import time
import tracemalloc

import numpy as np
import pytest

from kinematics.tidy.ldv_csv import read_ldv
from stapeskit.faults import StapeskitError

HEAD = "body,point,x_mm,y_mm,z_mm,dir,freq_hz,re_m_s,im_m_s"
ROWS = ["stapes,1,0,0,0,y,100,1,2", "stapes,1,0,0,0,y,200,3,4", "stapes,2,1,0,0,-z,100,5,6"]


def write(folder, text, name="ldv.csv", encoding="utf-8"):
    path = folder / name
    path.write_bytes(text.encode(encoding) if isinstance(text, str) else text)
    return path


def table(folder, head=HEAD, rows=ROWS, end="\n"):
    return write(folder, end.join([head, *rows]) + end)


def test_values_become_displacements(tmp_path):
    read = read_ldv(table(tmp_path))
    assert read.freq_hz.tolist() == [100.0, 200.0]
    body = read.bodies[0]
    assert body.points == ("1", "2")
    assert body.directions.tolist() == [[0, 1, 0], [0, 0, -1]]
    assert body.displacement[0, 0, 0] == pytest.approx((1 + 2j) / (2j * np.pi * 100.0))
    assert np.isnan(body.displacement[0, 1, 1])
    assert read.order == 1


@pytest.mark.parametrize(
    ("suffix", "order", "scale"),
    [
        ("m", 0, 1.0),
        ("mm", 0, 1e-3),
        ("um", 0, 1e-6),
        ("nm", 0, 1e-9),
        ("m_s", 1, 1.0),
        ("mm_s", 1, 1e-3),
        ("um_s", 1, 1e-6),
        ("m_s2", 2, 1.0),
        ("mm_s2", 2, 1e-3),
        ("rms_m_s", 1, np.sqrt(2.0)),
        ("rms_nm", 0, 1e-9 * np.sqrt(2.0)),
    ],
)
def test_units_by_suffix(tmp_path, suffix, order, scale):
    head = f"body,point,x_mm,y_mm,z_mm,dir,freq_hz,amp_{suffix},phase_deg,sd_{suffix}"
    read = read_ldv(table(tmp_path, head, ["a,1,0,0,0,x,50,4,30,0.5"]))
    factor = (2j * np.pi * 50.0) ** order
    body = read.bodies[0]
    assert body.displacement[0, 0, 0] == pytest.approx(4.0 * scale * np.exp(1j * np.pi / 6) / factor)
    assert body.sd[0, 0, 0] == pytest.approx(0.5 * scale / abs(factor))


def same(one, two):
    assert one.freq_hz.tolist() == two.freq_hz.tolist()
    for a, b in zip(one.bodies, two.bodies, strict=True):
        assert (a.body, a.points) == (b.body, b.points)
        assert np.allclose(a.displacement, b.displacement, rtol=1e-14, equal_nan=True)
        assert np.array_equal(a.positions_mm, b.positions_mm)


def test_dialects_read_the_same(tmp_path):
    plain = read_ldv(table(tmp_path, rows=["stapes,1,0.5,0,0,y,100,1.25,-2e-3"]))
    row = "stapes;1;0,5;0;0;y;100;1,25;-2e-3"
    head = HEAD.replace(",", ";")
    for text in (
        f"{head}\n{row}\n",
        f"{head}\r\n{row}\r\n",
        f"\ufeff{head}\r\n{row}",
        f"{head}\n\n{row}\n;;;;;;;;\n\n",
        f"{head}\n{row}\n".replace(",", "."),
        f"{head}\n{row}\n".replace(";", "\t"),
        f"{head}\n{row}\n".replace(";", " ; "),
        f'{HEAD}\n"stapes","1",0.5,0,0,y,100,1.25,-2e-3\n',
        f"{HEAD.upper()}\nstapes,1,0.5,0,0,+Y,100,1.25,-2e-3\n",
        f"{HEAD}\rstapes,1,0.5,0,0,y,100,1.25,-2e-3\r",
    ):
        same(read_ldv(write(tmp_path, text)), plain)


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


def test_empty_and_nan_are_missing(tmp_path):
    rows = ["s,1,0,0,0,y,100,,2", "s,1,0,0,0,y,200,NaN,nan", "s,1,0,0,0,y,300,1,1"]
    values = read_ldv(table(tmp_path, rows=rows)).bodies[0].displacement[0, 0]
    assert np.isnan(values[:2]).all()
    assert np.isfinite(values[2])


def grid(leave=(), most=None):
    """Two bodies of two points along y at four lines, without the rows of some numbers or beyond a number."""
    rows = [f"{b},{p},{p},0,0,y,{f},1,2" for b in "st" for p in (1, 2) for f in (100, 200, 300, 400)]
    return [row for number, row in enumerate(rows[:most]) if number not in leave]


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (grid(), None),
        (grid(leave=(3, 7)), None),
        (grid(most=12), None),
        (grid(leave=(5,)), "1 readings of 1 channels (s 2) have no row in ldv.csv"),
        (grid(most=14), "2 readings of 1 channels (t 2) have no row in ldv.csv"),
        (grid(leave=(1, 6, 13)), "3 readings of 3 channels (s 1, s 2, t 2) have no row in ldv.csv"),
    ],
)
def test_rows_that_are_not_there_are_told(tmp_path, rows, said):
    notices = [
        one.text for one in read_ldv(table(tmp_path, HEAD, rows)).notices if one.code == "rows_missing"
    ]
    assert [text.startswith(said) for text in notices] == ([True] if said else [])
    assert ["cut off" in text for text in notices] == ([len(rows) == 14] if said else [])


def test_runs_and_bodies_with_numbers_for_names(tmp_path):
    rows = ["1,1,0,0,0,y,100,1,0,a", "1,1,0,0,0,y,100,2,0,b", "2,1,5,0,0,y,100,3,0,a"]
    read = read_ldv(table(tmp_path, HEAD + ",run", rows))
    assert read.runs == ("a", "b")
    assert [body.body for body in read.bodies] == ["1", "2"]
    assert read.bodies[0].displacement.shape == (2, 1, 1)
    assert np.isnan(read.bodies[1].displacement[1, 0, 0])


def test_nearly_equal_frequencies_are_one_line(tmp_path):
    rows = ["s,1,0,0,0,y,100,1,0", "s,1,0,0,0,x,100.00001,1,0", "s,1,0,0,0,z,100.1,1,0"]
    assert read_ldv(table(tmp_path, rows=rows)).freq_hz.tolist() == [100.0, 100.1]


def test_positions_from_a_points_file(tmp_path):
    points = write(tmp_path, "body,point,x_mm,y_mm,z_mm,sd_mm\nstapes,1,1,2,3,0.02\nbase,1,9,9,9,\n", "p.csv")
    path = table(tmp_path, "body,point,dir,freq_hz,re_m_s,im_m_s", ["stapes,1,y,100,1,2"])
    body = read_ldv(path, points).bodies[0]
    assert body.positions_mm.tolist() == [[1, 2, 3]]
    assert body.position_sd_mm.tolist() == [0.02]


def noise(folder, extra_head, extra):
    read = read_ldv(table(folder, HEAD + extra_head, ["s,1,0,0,0,y,100,3,4," + extra]))
    return read.bodies[0].sd, read.bodies[0].relative


def test_noise_of_the_file(tmp_path):
    w = 2 * np.pi * 100.0
    sd, relative = noise(tmp_path, ",sd_mm_s", "7")
    assert sd[0, 0, 0] * w == pytest.approx(7e-3)
    assert not relative
    sd, relative = noise(tmp_path, ",coherence,n_avg", "0.9,10")
    assert sd[0, 0, 0] * w == pytest.approx(5.0 * np.sqrt(0.1 / (2 * 10 * 0.9)))
    assert not relative
    sd, relative = noise(tmp_path, ",n_avg", "16")
    assert sd[0, 0, 0] * w == pytest.approx(0.25)
    assert relative
    sd, relative = noise(tmp_path, ",sd_m_s,coherence,n_avg", "7,0.9,10")
    assert sd[0, 0, 0] * w == pytest.approx(7.0)
    assert read_ldv(table(tmp_path)).bodies[0].sd is None


def test_values_without_sd_are_told(tmp_path):
    rows = ["s,1,0,0,0,y,100,1,2,0.1", "s,1,0,0,0,y,200,1,2,"]
    read = read_ldv(table(tmp_path, HEAD + ",sd_m_s", rows))
    assert [notice.code for notice in read.notices] == ["sd_missing"]


D = "body,point,x_mm,y_mm,z_mm,dir_x,dir_y,dir_z,freq_hz,re_m_s,im_m_s"


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
        (D, "s,1,0,0,0,0,0,0,7,1,2", r"unit vector \(within 1e-3\); got \(0, 0, 0\) of length 0"),
        (D, "s,1,0,0,0,0,1.01,0,7,1,2", r"unit vector .* of length 1.01"),
        (D, "s,1,0,0,0,0,,0,7,1,2", r"unit vector \(within 1e-3\); got \(0, nan, 0\) \(ldv.csv, line 3"),
        (HEAD + ",sd_m_s", "s,1,0,0,0,x,7,1,2,-1", r"sd_m_s must be positive and finite; got -1"),
        (HEAD + ",coherence,n_avg", "s,1,0,0,0,x,7,1,2,1.1,4", r"coherence must be within 0 and 1; got 1.1"),
        (HEAD + ",n_avg", "s,1,0,0,0,x,7,1,2,0", r"n_avg must be 1 or more; got 0"),
    ],
)
def test_faulty_rows_are_named(tmp_path, head, row, match):
    first = {HEAD: "s,1,0,0,0,y,100,1,2", D: "s,1,0,0,0,0,1,0,100,1,2"}
    good = next(text for key, text in first.items() if head.startswith(key)) + ",1" * head.count(",c")
    good += ",1" * (head.count(",sd_") + head.count(",n_avg"))
    with pytest.raises(StapeskitError, match=match):
        read_ldv(table(tmp_path, head, [good, row]))


def test_small_errors_of_unit_vectors_are_taken_out(tmp_path):
    body = read_ldv(table(tmp_path, D, ["s,1,0,0,0,0.6004,0.8,0,7,1,2"])).bodies[0]
    assert np.linalg.norm(body.directions[0]) == pytest.approx(1.0, abs=1e-15)


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
    rows = [*ROWS, "stapes,2,1,0,0,up,100,5,6", "stapes,3,1,0,0,x,-1,5,oops", "stapes,4,1,0,0,x,100,inf,6,7"]
    with pytest.raises(StapeskitError) as caught:
        read_ldv(table(tmp_path, rows=rows))
    lines = str(caught.value).splitlines()
    assert len(lines) == 4
    assert {int(number) for number in re.findall(r"line (\d+)", str(caught.value))} == {5, 6, 7}


def test_duplicates_are_told_beside_other_faults(tmp_path):
    rows = [*ROWS, "stapes,3,1,0,0,x,-1,5,6", ROWS[0], "stapes,4,1,0,0,x,100,oops,6"]
    with pytest.raises(StapeskitError) as caught:
        read_ldv(table(tmp_path, rows=rows))
    assert len(str(caught.value).splitlines()) == 3
    assert re.search(r"the same as in line 2 \(ldv.csv, line 6\)", str(caught.value))


@pytest.mark.parametrize(
    ("head", "row", "column"),
    [
        (D, "s,1,0,0,0,0,a,0,7,1,2", "dir_y"),
        (D, "s,1,0,0,0,0,1,0,b,1,2", "freq_hz"),
        (D, "s,1,0,c,0,0,1,0,7,1,2", "y_mm"),
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
    points = write(tmp_path, "body,point,x_mm,y_mm,z_mm\ns,1,0,0,0\n", "p.csv")
    with pytest.raises(StapeskitError, match=r"point 9 of body s must be listed in p.csv.*line 3"):
        read_ldv(path, points)
    points = write(tmp_path, "body,point,x_mm,y_mm,z_mm\ns,1,0,0,0\ns,1,0,0,1\ns,9,0,0,0\n", "p.csv")
    with pytest.raises(StapeskitError, match="listed once; got a second position"):
        read_ldv(path, points)
    points = write(tmp_path, "body,point,x_mm,y_mm,z_mm,sd_mm\ns,1,0,,0,-1\n,9,0,0,0,1\n", "p.csv")
    with pytest.raises(StapeskitError, match="y_mm must be a finite number") as caught:
        read_ldv(path, points)
    assert "sd_mm must be positive" in str(caught.value)
    assert "body and point must be names" in str(caught.value)
    points = write(tmp_path, "body,point,x_mm,y_mm,z_mm\nstapes,1,0,0,0.1\nstapes,2,1,0,0\n", "p.csv")
    with pytest.raises(StapeskitError, match="the position of point 1 of body stapes must be one"):
        read_ldv(table(tmp_path), points)
    with pytest.raises(StapeskitError, match="no column z_mm"):
        read_ldv(path, write(tmp_path, "body,point,x_mm,y_mm\ns,1,0,0\n", "p.csv"))


def test_sd_that_is_empty_throughout_is_refused(tmp_path):
    with pytest.raises(StapeskitError, match="sd_m_s must be a number in at least one row"):
        read_ldv(table(tmp_path, HEAD + ",sd_m_s", [row + ",nan" for row in ROWS]))


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
        read_ldv(write(tmp_path, data))


def test_other_formats_are_told_what_is_read(tmp_path):
    with pytest.raises(StapeskitError, match="an existing CSV file"):
        read_ldv(tmp_path / "nowhere.csv")
    with pytest.raises(StapeskitError, match=r"a CSV table .*which is what is read now"):
        read_ldv(write(tmp_path, b"x", "scan.uff"))
    with pytest.raises(StapeskitError, match="a CSV table"):
        read_ldv(tmp_path)


def test_the_two_ways_of_reading_agree(tmp_path):
    rng = np.random.default_rng(5)
    rows = []
    for point in range(4):
        for axis in "xyz":
            for freq in (100.0, 250.5, 1e4):
                rows.append(
                    f"s,{point},{point * 0.1},0,1,{axis},{freq},{rng.normal():.17g},{rng.normal():.17g}"
                )
    fast = read_ldv(table(tmp_path, rows=rows))
    slow = read_ldv(table(tmp_path, rows=[row.replace("s,", '"s",', 1) for row in rows]))
    same(fast, slow)


HEADER = "body,point,x_mm,y_mm,z_mm,dir_x,dir_y,dir_z,freq_hz,re_m_s,im_m_s,run\n"


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
    path.write_text(HEADER + "".join(row.format(k, k + 1) + "\n" for k in range(3000)))
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


@pytest.mark.parametrize("other", ["90 200 1000", "1000 200 90"])
def test_rows_of_one_body_in_the_order_of_text_are_reported(tmp_path, other):
    rows = [f"a,1,0,0,0,y,{freq},1,2" for freq in ("1000", "200", "90")]
    rows += [f"b,1,0,0,0,y,{freq},1,2" for freq in other.split()]
    read = read_ldv(table(tmp_path, rows=rows))
    texts = [notice.text for notice in read.notices if notice.code == "text_order"]
    assert len(texts) == (other == "90 200 1000")
    assert all(
        "the rows of a in ldv.csv are in the order of text (1000, 200, 90, ...)" in text for text in texts
    )
    assert read.freq_hz.tolist() == [90.0, 200.0, 1000.0]
