"""The tidy table: every unit, shorthand and dialect, and what is reported of it."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.kinematics.tidy.ldv_csv import read_ldv
from tests.kinematics.written_csv import HEAD, WITH_BEAMS, same, table, written


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
        same(read_ldv(written(tmp_path, text)), plain)


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


@pytest.mark.parametrize(
    ("cells", "code"),
    [("1,2", None), (",", "values_missing"), ("NaN,", "values_missing"), (",2", "values_incomplete")],
)
def test_empty_values_are_counted(tmp_path, cells, code):
    rows = grid()
    rows[3] = rows[3][: -len("1,2")] + cells
    notices = {one.code: one.text for one in read_ldv(table(tmp_path, HEAD, rows)).notices}
    assert set(notices) & {"values_missing", "values_incomplete"} == ({code} if code else set())
    assert code is None or notices[code].startswith("1 rows of ldv.csv (s 1)")


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
    points = written(
        tmp_path, "body,point,x_mm,y_mm,z_mm,sd_mm\nstapes,1,1,2,3,0.02\nbase,1,9,9,9,\n", "p.csv"
    )
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


def test_small_errors_of_unit_vectors_are_taken_out(tmp_path):
    body = read_ldv(table(tmp_path, WITH_BEAMS, ["s,1,0,0,0,0.6004,0.8,0,7,1,2"])).bodies[0]
    assert np.linalg.norm(body.directions[0]) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize("along", range(3))
def test_beams_at_either_side_of_an_axis_keep_their_own_directions(tmp_path, along):
    angles = np.radians(np.geomspace(1e-3, 30.0, 12))
    beams = np.concatenate([np.outer(np.sin(angles), side) for side in np.delete(np.eye(3), along, 0)])
    beams = np.concatenate([beams, -beams])
    beams[:, along] = np.tile(np.cos(angles), 4)
    rows = [f"s,{n},{n},0,0,{d[0]!r},{d[1]!r},{d[2]!r},7,1,2" for n, d in enumerate(beams.tolist())]
    read = read_ldv(table(tmp_path, WITH_BEAMS, rows)).bodies[0]
    assert read.directions == pytest.approx(beams, abs=1e-7)


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
