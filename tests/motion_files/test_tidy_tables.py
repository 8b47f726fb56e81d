"""The tidy table: dialects of spreadsheets, units, noise, and a fault with its line for each mistake."""

import numpy as np
import pytest

from kinematics.readers.assemble import read_measurement
from stapeskit.faults import StapeskitError
from tests.motion_files.written_files import VELOCITY, tidy_table

HEAD = "body,point,x_mm,y_mm,z_mm,dir,freq_hz,re_m_s,im_m_s"
ROWS = ("stapes,1,0,0,0,y,100,1,2", "stapes,1,0,0,0,y,200,3,4", "stapes,2,1,0,0,-z,100,5,6")


def written(folder, text, name="ldv.csv"):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def table(folder, rows=ROWS, head=HEAD):
    return written(folder, "\n".join([head, *rows]) + "\n")


def faults(path, points=None):
    with pytest.raises(StapeskitError) as caught:
        read_measurement([path], points)
    return caught.value.faults


UNITS = {
    "re_mm_s,im_mm_s": ("velocity", 1e-3),
    "re_um,im_um": ("displacement", 1e-6),
    "re_m_s2,im_m_s2": ("acceleration", 1.0),
    "re_rms_m_s,im_rms_m_s": ("velocity", 2.0**0.5),
}


@pytest.mark.parametrize("head", UNITS)
def test_units_of_columns(head, tmp_path):
    measured = read_measurement([written(tmp_path, tidy_table(head=head))])
    quantity, factor = UNITS[head]
    assert measured.quantity == quantity
    assert np.allclose(measured.bodies[0].value[0], factor * VELOCITY.reshape(9, -1), rtol=1e-14)


def test_amplitude_and_phase(tmp_path):
    rows = ["stapes,1,0,0,0,y,100,2,90", "stapes,1,0,0,0,y,200,1,-180"]
    head = HEAD.replace("re_m_s,im_m_s", "amp_mm_s,phase_deg")
    measured = read_measurement([table(tmp_path, rows, head)])
    assert np.allclose(measured.bodies[0].value[0, 0], [2e-3j, -1e-3], atol=1e-18)
    (fault,) = faults(table(tmp_path, [*rows, "stapes,1,0,0,0,y,300,1,inf"], head))
    assert (fault.got, fault.where.numbers) == ("inf", (4,))  # infinite, and so not missing


def test_order_of_rows_does_not_matter(tmp_path):
    head, *rows = tidy_table().strip().split("\n")
    plain = read_measurement([written(tmp_path, tidy_table())]).bodies[0]
    mixed = np.random.default_rng(3).permutation(rows).tolist()
    shuffled = read_measurement([table(tmp_path, mixed, head)]).bodies[0]
    order = [
        list(zip(shuffled.points, map(tuple, shuffled.directions), strict=True)).index((name, tuple(beam)))
        for name, beam in zip(plain.points, plain.directions, strict=True)
    ]
    assert np.array_equal(plain.value[0], shuffled.value[0, order])


def test_noise_by_sd_coherence_and_averages(tmp_path):
    """Bendat and Piersol: |v| sqrt((1 - g2) / (2 n g2)) of the real part; averages alone are relative."""
    rows = [f"{row},0.8,10" for row in ROWS[:2]]
    body = read_measurement([table(tmp_path, rows, f"{HEAD},coherence,n_avg")]).bodies[0]
    assert np.allclose(body.sd, np.abs(body.value) * np.sqrt(0.2 / (2 * 10 * 0.8)))
    assert not body.relative
    body = read_measurement([table(tmp_path, [f"{row},4" for row in ROWS[:2]], f"{HEAD},n_avg")]).bodies[0]
    assert body.relative
    assert np.allclose(body.sd, 0.5)
    single = [f"{row},1,1" for row in ROWS[:2]]  # the coherence of one average is 1 and says nothing
    assert read_measurement([table(tmp_path, single, f"{HEAD},coherence,n_avg")]).bodies[0].sd is None
    body = read_measurement([table(tmp_path, [f"{row},7" for row in ROWS[:2]], f"{HEAD},sd_mm_s")]).bodies[0]
    assert np.allclose(body.sd, 7e-3)


def test_missing_values_and_rows_are_missing(tmp_path):
    rows = [*ROWS[:2], "stapes,2,1,0,0,-z,200,5,"]  # one row and one imaginary part
    measured = read_measurement([table(tmp_path, rows)])
    assert np.array_equal(np.isnan(measured.bodies[0].value[0]), [[False, False], [True, True]])
    (notice,) = measured.notices
    assert notice.code == "file_read"
    assert notice.text.startswith("2 readings")


def test_rows_that_are_commented_out_are_reported_with_their_lines(tmp_path):
    rows = [ROWS[0], "# measured on Monday", f"#{ROWS[1]}", ROWS[2]]
    measured = read_measurement([table(tmp_path, rows)])
    assert any("line 4" in notice.text for notice in measured.notices)


def test_runs_and_repeats(tmp_path):
    rows = [f"{row},{run},{again}" for run in ("push", "tilt") for again in (1, 2) for row in ROWS[:2]]
    measured = read_measurement([table(tmp_path, rows, f"{HEAD},run,repeat")])
    assert [(one.run, one.repeat) for one in measured.repeats] == [
        ("push", "1"), ("push", "2"), ("tilt", "1"), ("tilt", "2"),
    ]  # fmt: skip
    assert measured.bodies[0].value.shape == (4, 1, 2)


def test_names_that_a_spreadsheet_made_numbers_of(tmp_path):
    points = written(tmp_path, "body,point,x_mm,y_mm,z_mm\nstapes,1,1,2,3\nstapes,2,4,5,6\n", "points.csv")
    head = HEAD.replace("x_mm,y_mm,z_mm,", "")
    rows = ["Stapes ,1.0,y,100,1,2", "Stapes ,1.0,y,200,3,4", "Stapes ,2.0,-z,100,5,6"]
    path = table(tmp_path, rows, head)
    assert read_measurement([path]).bodies[0].positions_m is None
    measured = read_measurement([path], points)
    assert measured.bodies[0].points == ("1", "2")
    assert measured.bodies[0].body == "stapes"
    assert np.allclose(measured.bodies[0].positions_m, [[1e-3, 2e-3, 3e-3], [4e-3, 5e-3, 6e-3]])
    assert any(notice.code == "file_read" and "Stapes" in notice.text for notice in measured.notices)


MISTAKES = {
    "direction": ("stapes,1,0,0,0,w,300,1,2", "dir", 5),
    "no body": (",1,0,0,0,y,300,1,2", "body", 5),
    "no point": ("stapes,,0,0,0,y,300,1,2", "point", 5),
    "again": ("stapes,1,0,0,0,y,200,3,4", "the frequencies", (3, 5)),
    "moved": ("stapes,1,0,0.5,0,y,300,1,2", "the position of point 1 of body stapes", 5),
    "empty place": ("stapes,1,0,,0,y,300,1,2", "y_mm", 5),
    "short": ("stapes,1,0,0,0,y,300,1", "a row", 5),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_fault_with_its_line(name, tmp_path):
    row, thing, line = MISTAKES[name]
    found = faults(table(tmp_path, [*ROWS, row]))
    assert [fault.where.numbers for fault in found] == [line if isinstance(line, tuple) else (line,)]
    if name != "short":
        assert found[0].thing == thing


def test_a_name_of_another_language_is_one_fault(tmp_path):
    """The column is reported as missing; its unit is not."""
    (found,) = faults(table(tmp_path, ROWS, HEAD.replace("freq_hz", "frequenz")))
    assert (found.thing, found.got) == ("the table", "no column freq_hz")


HEADERS = {
    "no unit": (HEAD.replace("re_m_s", "re"), "the unit of column re"),
    "no direction": (HEAD.replace("dir,", "way,"), "the table"),
    "two directions": (HEAD.replace("dir,", "dir,dir_x,"), "the direction"),
    "both pairs": (f"{HEAD},amp_m_s", "the value"),
    "two units": (HEAD.replace("im_m_s", "im_mm_s"), "real and imaginary part"),
    "other sd": (f"{HEAD},sd_um", "the standard deviation"),
    "an empty sd": (f"{HEAD},sd_m_s", "sd_m_s"),
    "kilohertz": (HEAD.replace("freq_hz", "freq_khz"), "the unit of column freq_khz"),
}


@pytest.mark.parametrize("name", HEADERS)
def test_mistakes_of_the_header(name, tmp_path):
    head, thing = HEADERS[name]
    rows = [row.replace(",y,", ",y,1,") for row in ROWS] if "dir_x" in head else ROWS
    rows = [f"{row}," if head.count(",") > rows[0].count(",") else row for row in rows]
    assert thing in {fault.thing for fault in faults(table(tmp_path, rows, head))}


def test_all_faults_of_all_files_come_together(tmp_path):
    points = written(tmp_path, "body,point,x_mm,y_mm,z_mm\nstapes,1,0,0,far\n", "points.csv")
    found = faults(table(tmp_path, [*ROWS, "stapes,1,0,0,0,w,abc,1,2"]), points)
    assert {fault.where.file for fault in found} == {"ldv.csv", "points.csv"}
    assert len(found) == 3


@pytest.mark.parametrize(
    ("decimals", "absolute", "odd"), [(4, True, 1), (3, True, 0), (2, False, 0), (2, False, 1)]
)
def test_coherence_written_with_few_decimals(tmp_path, decimals, absolute, odd):
    """What rounds to 1 is not free of noise: its sd is right within 3. One value may have more digits."""
    relative = np.random.default_rng(3).uniform(0.006, 0.03, 200)
    relative[:5] = 0.001
    gamma = np.round(1.0 / (1.0 + 2.0 * 16 * relative**2), decimals)
    assert np.any(gamma == 1.0)
    gamma[100 : 100 + odd] = 0.98765432
    rows = [f"stapes,1,0,0,0,y,{100 + k},1,0,{value:.8g},16" for k, value in enumerate(gamma)]
    relative[100 : 100 + odd] = np.sqrt((1.0 / 0.98765432 - 1.0) / 32.0)
    body = read_measurement([table(tmp_path, rows, f"{HEAD},coherence,n_avg")]).bodies[0]
    assert body.relative is not absolute
    assert body.sd is not None
    assert np.all(body.sd > 0.0)
    ratio = body.sd[0, 0, 5:] / relative[5:]
    assert np.all((ratio > 1 / 3) & (ratio < 3)) or not absolute


def test_one_channel_whose_coherence_rounds_to_1_leaves_the_noise_of_the_others_stated(tmp_path):
    """A body is coarse by most of its values; another body of the file changes nothing."""
    near_1, others = np.random.default_rng(4).uniform(0.9996, 0.9999, 20), [0.913, 0.807] * 10
    rows = [
        f"{body},{point},0,0,0,y,{100 + line},1,0,{gamma:.3f},16"
        for body, quiet in (("stapes", (1,)), ("base", (1, 2, 3)))
        for point in (1, 2, 3, 4)
        for line, gamma in enumerate(near_1 if point in quiet else others)
    ]
    measured = read_measurement([table(tmp_path, rows, f"{HEAD},coherence,n_avg")])
    stapes, base = measured.bodies
    assert not stapes.relative
    assert base.relative
    assert np.allclose(stapes.sd[0, 1, 0], np.sqrt(0.087 / (2 * 16 * 0.913)))
    assert any("last digit" in notice.text and "stapes" in notice.text for notice in measured.notices)


def test_sd_of_0_beside_others_is_refused_with_its_rows(tmp_path):
    """Weights of values that are said to be exact would hide all others."""
    rows = [f"{row},{sd}" for row, sd in zip(ROWS, (0.1, 0, 0.2), strict=True)]
    (fault,) = faults(table(tmp_path, rows, f"{HEAD},sd_m_s"))
    assert "standard deviation" in fault.thing
    assert 3 in fault.where.numbers or 2 in fault.where.numbers
    exact = read_measurement([table(tmp_path, [f"{row},0" for row in ROWS], f"{HEAD},sd_m_s")])
    assert np.all(exact.bodies[0].sd[np.isfinite(exact.bodies[0].value)] == 0.0)


def test_columns_exchanged_are_refused(tmp_path):
    """Frequencies in the place of a name: almost no reading shares a line with another."""
    rows = [f"stapes,{k % 7},0,0,0,y,{100 + 0.37 * k:.2f},1,2,{k}" for k in range(5000)]
    found = faults(table(tmp_path, rows, f"{HEAD},run"))
    assert found[0].thing == "the readings"
