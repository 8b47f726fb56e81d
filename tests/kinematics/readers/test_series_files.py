"""Channel tables and the files of time series: every container gives the same signals; faults are said."""

from __future__ import annotations

import tracemalloc
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat, wavfile

from legacy.kinematics.options import SeriesOptions
from legacy.kinematics.readers.series.channel_table import read_channels, sensitivity
from legacy.kinematics.readers.series.frequency_responses import read, read_steps
from legacy.kinematics.readers.series.series_files import read_series
from legacy.stapeskit.faults import StapeskitError
from tests.kinematics.written_mat import write_v73

RATE, COUNT = 2000.0, 4000
TIME = np.arange(COUNT) / RATE
RNG = np.random.default_rng(0)
DRIVE = RNG.standard_normal(COUNT)
ANSWER = 2.0 * DRIVE
TABLE = "channel,role,body,point,dir,unit\nvib,response,stapes,1,z,mm/s\nref,reference,,,,V\n"


def _csv(path):
    rows = "\n".join(f"{t:.9g},{a:.17g},{b:.17g}" for t, a, b in zip(TIME, ANSWER, DRIVE, strict=True))
    path.write_text("time_s,Vib,ref\n" + rows)


def _h5(path):
    with h5py.File(path, "w") as file:
        file.attrs["fs"] = RATE
        file["vib"], file["ref"] = ANSWER[:, None], DRIVE


WRITERS = {
    "csv": _csv,
    "npz": lambda path: np.savez_compressed(path, vib=ANSWER, ref=DRIVE, time_s=TIME),
    "mat": lambda path: savemat(path, {"vib": ANSWER, "ref": DRIVE, "t": TIME}),
    "v73.mat": lambda path: write_v73(path, {"vib": ANSWER, "ref": DRIVE, "sample_rate_hz": RATE}),
    "h5": _h5,
}


@pytest.mark.parametrize("kind", WRITERS)
def test_every_container_gives_the_same_signals(tmp_path, kind):
    path = tmp_path / f"scan.{kind}"
    WRITERS[kind](path)
    series = read_series(path, ["vib", "ref"])
    assert series.sample_rate_hz == pytest.approx(RATE)
    np.testing.assert_allclose(series.channels["vib"][0], ANSWER, rtol=1e-15)
    np.testing.assert_allclose(series.channels["ref"][0], DRIVE, rtol=1e-15)
    (tmp_path / "channels.csv").write_text(TABLE)
    found = read(path, SeriesOptions(tmp_path / "channels.csv"))
    one = found.recordings[0]
    np.testing.assert_allclose(one.value, 2e-3, rtol=1e-9)
    assert (one.body, one.point, one.order, one.per) == ("stapes", "1", 1, "V")
    assert one.direction.tolist() == [0.0, 0.0, 1.0]
    assert "H1, window hann, resolution" in found.frame_units


@pytest.mark.parametrize(
    ("kind", "atol"), [(np.int16, 1e-4), (np.float32, 1e-7), (np.uint8, 1e-2), (np.int32, 1e-9)]
)
def test_wav_is_scaled_to_full_scale(tmp_path, kind, atol):
    wave = 0.5 * np.column_stack([np.sin(TIME), np.cos(TIME)])
    full = {np.int16: 2**15, np.float32: 1, np.uint8: 2**7, np.int32: 2**31}[kind]
    wavfile.write(tmp_path / "scan.wav", 2000, (wave * full + (128 if kind is np.uint8 else 0)).astype(kind))
    series = read_series(tmp_path / "scan.wav", ["2"])
    np.testing.assert_allclose(series.channels["2"][0], wave[:, 1], atol=atol)


@pytest.mark.parametrize(
    ("text", "factor", "unit"),
    [
        ("5 mm/s/V", 5.0, "mm/s"),
        ("5 (mm/s)/V", 5.0, "mm/s"),
        ("0.2 um/mV", 200.0, "um"),
        ("100 mV/g", 10.0, "g"),
        ("10 mV/(m/s^2)", 100.0, "m/s2"),
        ("0.05 V/Pa", 20.0, "Pa"),
    ],
)
def test_sensitivities_have_their_unit(text, factor, unit):
    got = sensitivity(text)
    assert got is not None
    assert got[0] == pytest.approx(factor)
    assert got[1] == unit


@pytest.mark.parametrize("text", ["5", "mm/s/V", "-5 mm/s/V", "5 mm/s", "0 mV/g", "1..2 V/g"])
def test_a_sensitivity_without_its_unit_is_none(text):
    assert sensitivity(text) is None


def test_sensitivity_scales_volts(tmp_path):
    (tmp_path / "c.csv").write_text("channel,role,point,dir,sensitivity\nvib,response,1,z,5 mm/s/V\n")
    (one,) = read_channels(tmp_path / "c.csv")
    assert (one.scale, one.order, one.unit) == (pytest.approx(5e-3), 1, "m/s")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("channel,role\nvib,response\n", "the channel table must be with a column unit"),
        ("name,unit\nvib,m\n", "the channel table must be with a column channel"),
        (
            "channel,role,unit\nvib,output,m\n",
            "role must be response, reference, ignore; got output .*line 2",
        ),
        ("channel,unit\nvib,Pa\n", 'unit must be .*; got "Pa"'),
        ("channel,role,unit\nvib,response,m\nref,reference,\n", "the unit of the reference, e.g. Pa"),
        ("channel,sensitivity\nvib,5\n", 'a number with volts in its unit; got "5"'),
        ("channel,unit,sensitivity\nvib,m/s,5 mm/s/V\n", "unit and sensitivity must be of one unit"),
        ("channel,dir,unit\nvib,q,m\n", "dir must be x, y, z, -x, -y or -z; got q"),
        ("channel,dir_x,dir_y,dir_z,unit\nvib,1,1,0,m\n", "a unit vector"),
        ("channel,unit,x_mm,y_mm,z_mm\nvib,m,1,,2\n", "three finite numbers or empty"),
        ("channel,unit\nvib,m\nvib,m\n", "channel vib must be listed once"),
        ("channel,role,unit\nref,reference,V\n", "a table of at least one response"),
        ("channel,unit\n,m\n", "channel must be the name of a column"),
        ("channel,unit,x_mm\nvib,m,abc\n", 'x_mm must be a number; got "abc"'),
    ],
)
def test_faulty_channel_tables(tmp_path, text, message):
    (tmp_path / "c.csv").write_text(text)
    with pytest.raises(StapeskitError, match=message):
        read_channels(tmp_path / "c.csv")


def _with(tmp_path, table=TABLE, **arrays):
    np.savez(tmp_path / "scan.npz", **arrays)
    (tmp_path / "channels.csv").write_text(table)
    return tmp_path / "scan.npz", SeriesOptions(tmp_path / "channels.csv")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"vib": ANSWER, "fs": RATE}, "channel ref must be in the file, which has vib, fs; got no such one"),
        ({"vib": ANSWER, "ref": DRIVE}, "the file must be with a sampling rate; got the variables vib, ref"),
        ({"vib": ANSWER, "ref": DRIVE, "fs": -1.0}, "the sampling rate must be positive"),
        ({"vib": ANSWER, "ref": DRIVE, "time_s": TIME**1.01}, "time_s must be evenly spaced"),
        ({"vib": ANSWER, "ref": DRIVE[:-1], "fs": RATE}, "the channels must be of one number of samples"),
        (
            {"vib": np.where(TIME == 1.0, np.nan, ANSWER), "ref": DRIVE, "fs": RATE},
            "the first in sample 2001",
        ),
        ({"vib": np.zeros(COUNT), "ref": DRIVE, "fs": RATE}, "the responses must be with a signal"),
        ({"vib": ANSWER, "ref": np.ones(COUNT), "fs": RATE}, "the reference must be a signal"),
        ({"vib": ANSWER[:50], "ref": DRIVE[:50], "fs": RATE}, "a segment must be at least 8 samples long"),
        (
            {"vib": np.ones((2, 2, 50)), "ref": DRIVE, "fs": RATE},
            "a channel must be samples, or rows x samples",
        ),
        (
            {"vib": np.tile(ANSWER, (3, 1)), "ref": np.tile(DRIVE, (2, 1)), "fs": RATE},
            "the reference ref must be 3 rows, as the responses have; got 2",
        ),
    ],
)
def test_faulty_series(tmp_path, arrays, message):
    path, options = _with(tmp_path, **arrays)
    with pytest.raises(StapeskitError, match=message):
        read(path, options)


def test_references_are_chosen(tmp_path):
    table = TABLE + "mic,reference,,,,Pa\n"
    path, options = _with(tmp_path, table, vib=ANSWER, ref=DRIVE, mic=0.5 * DRIVE, fs=RATE)
    with pytest.raises(StapeskitError, match="the reference must be one channel; got ref, mic"):
        read(path, options)
    one = read(path, SeriesOptions(options.channels, reference_channel="mic")).recordings[0]
    assert one.per == "Pa"
    np.testing.assert_allclose(one.value, 4e-3, rtol=1e-9)
    with pytest.raises(StapeskitError, match="--reference-channel must be one of vib, ref, mic; got other"):
        read(path, SeriesOptions(options.channels, reference_channel="other"))
    path, options = _with(tmp_path, TABLE.replace("reference", "ignore"), vib=ANSWER, fs=RATE)
    with pytest.raises(StapeskitError, match="the channel table must be with a reference; got none"):
        read(path, options)


def test_rows_are_records_of_a_point_or_points(tmp_path):
    arrays = {"vib": ANSWER.reshape(2, -1), "ref": DRIVE.reshape(2, -1), "fs": RATE}
    path, options = _with(tmp_path, **arrays)
    (one,) = read(path, options).recordings
    assert one.point == "1"
    table = TABLE.replace(",stapes,1,", ",stapes,,")
    arrays["vib"] = np.vstack([arrays["vib"], np.zeros((1, COUNT // 2))])
    arrays["ref"] = np.vstack([arrays["ref"], arrays["ref"][:1]])
    path, options = _with(tmp_path, table, **arrays)
    found = read(path, options)
    assert [one.point for one in found.recordings] == ["1", "2"]
    assert [notice.code for notice in found.notices] == ["zero_rows"]


def test_clipped_channels_are_told(tmp_path):
    path, options = _with(tmp_path, vib=np.clip(np.cumsum(ANSWER) * 0.05, -1, 1), ref=DRIVE, fs=RATE)
    assert "clipped" in {notice.code for notice in read(path, options).notices}


def test_the_file_column_restricts_rows(tmp_path):
    table = "channel,role,point,dir,unit,file\nvib,response,1,z,m,scan\n"
    table += "vib,response,2,z,m,other.npz\nref,reference,,,V,\n"
    path, options = _with(tmp_path, table, vib=ANSWER, ref=DRIVE, fs=RATE)
    assert [one.point for one in read(path, options).recordings] == ["1"]
    path = path.rename(tmp_path / "third.npz")
    with pytest.raises(StapeskitError, match=r"with a response of third\.npz"):
        read(path, options)


def test_options_change_the_estimate(tmp_path):
    path, options = _with(tmp_path, vib=ANSWER, ref=DRIVE, fs=RATE)
    found = read(
        path, SeriesOptions(options.channels, resolution_hz=10.0, frf_band_hz=(100.0, 200.0))
    ).recordings[0]
    np.testing.assert_allclose(found.freq_hz, np.arange(100.0, 201.0, 10.0))
    with pytest.raises(StapeskitError, match="the band must be wide enough for at least one line"):
        read(path, SeriesOptions(options.channels, frf_band_hz=(5000.0, 6000.0)))
    with pytest.raises(StapeskitError, match="--steps must be left out when --period is given"):
        SeriesOptions(options.channels, period_s=1.0, steps=options.channels)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("start_s,stop_s\n0,1\n", "no column freq_hz"),
        ("start_s,stop_s,freq_hz\n1,0,5\n", "stop_s must be later than start_s"),
        ("start_s,stop_s,freq_hz\n0,1,-5\n", "freq_hz must be positive"),
        ("start_s,stop_s,freq_hz\n0,x,5\n", 'stop_s must be a number; got "x"'),
        (
            "start_s,stop_s,freq_hz\n0,1,5\n1.005,2,6\n0,1,5\n",
            r"must be apart from the others; got 0 to 1 s, within that of line 2 \(steps.csv, line 4\)",
        ),
        ("start_s,stop_s,freq_hz\n0,1,5\n0.5,2,6\n", "got 0.5 to 2 s, within that of line 2"),
    ],
)
def test_faulty_tables_of_steps(tmp_path, text, message):
    (tmp_path / "steps.csv").write_text(text)
    with pytest.raises(StapeskitError, match=message):
        read_steps(tmp_path / "steps.csv")


def test_steps_may_touch_and_stand_in_any_order(tmp_path):
    (tmp_path / "steps.csv").write_text("start_s,stop_s,freq_hz\n1,2,6\n0,1.005,5\n2,3,6\n")
    assert read_steps(tmp_path / "steps.csv") == [(1.0, 2.0, 6.0), (0.0, 1.005, 5.0), (2.0, 3.0, 6.0)]


def test_steps_outside_the_record(tmp_path):
    path, options = _with(tmp_path, vib=ANSWER, ref=DRIVE, fs=RATE)
    (tmp_path / "steps.csv").write_text("start_s,stop_s,freq_hz\n1,9,100\n")
    with pytest.raises(StapeskitError, match="a step must be within the record, 0 to 2 s; got 1 to 9 s"):
        read(path, SeriesOptions(options.channels, steps=tmp_path / "steps.csv"))


def test_damaged_archives_and_wav_files(tmp_path):
    rng = np.random.default_rng(1)
    for kind in ("npz", "wav"):
        path = tmp_path / f"whole.{kind}"
        if kind == "npz":
            np.savez(path, **{"1": ANSWER, "2": DRIVE, "fs": RATE})
        else:
            wavfile.write(path, 2000, np.column_stack([ANSWER, DRIVE]))
        whole, bad = path.read_bytes(), tmp_path / f"bad.{kind}"
        for length in np.linspace(20, len(whole) - 1, 20).astype(int):
            bad.write_bytes(whole[:length])
            with pytest.raises(StapeskitError):
                read_series(bad, ["1", "2"])
        for _ in range(80):
            data = bytearray(whole)
            for place in rng.integers(4, 300, 3):
                data[place] = rng.integers(256)
            bad.write_bytes(bytes(data))
            try:
                read_series(bad, ["1", "2"])
            except StapeskitError:
                continue


def test_an_array_larger_than_its_archive_is_refused(tmp_path):
    path = tmp_path / "scan.npz"
    head = (
        b"\x93NUMPY\x01\x00v\x00"
        + b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }".ljust(117)
        + b"\n"
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("vib.npy", head + b"\0" * 80)
    with pytest.raises(StapeskitError, match=r"a readable NPZ archive; got vib\.npy claims"):
        read_series(path, ["vib"])


def test_the_channel_table_of_the_page_is_read(tmp_path):
    page = (Path(__file__).parents[3] / "docs" / "vibrometer_files.md").read_text(encoding="utf-8")
    (tmp_path / "c.csv").write_text(page.split("```csv\n")[1].split("```")[0])
    vib, acc, mic = read_channels(tmp_path / "c.csv")
    assert (vib.order, vib.scale) == (1, pytest.approx(5e-3))
    assert (acc.order, acc.scale) == (2, pytest.approx(98.0665))
    assert (mic.role, mic.unit, mic.scale) == ("reference", "Pa", pytest.approx(20.0))


def test_options_that_no_file_is_for_are_refused(tmp_path):
    from legacy.kinematics.readers.input_options import InputOptions
    from legacy.kinematics.readers.measurement_files import read_measurement

    (tmp_path / "channels.csv").write_text(TABLE)
    (tmp_path / "map.toml").write_text("")
    (tmp_path / "scan.uff").write_text("    -1\n    58\n    -1\n")
    said = InputOptions(series=SeriesOptions(tmp_path / "channels.csv"), mapping=tmp_path / "map.toml")
    with pytest.raises(
        StapeskitError, match="--channels must be left out: no file holds time series"
    ) as told:
        read_measurement([tmp_path / "scan.uff"], options=said)
    assert "--mapping must be left out" in str(told.value)


def test_all_faults_of_time_series_are_told_together(tmp_path):
    path, options = _with(
        tmp_path, vib=np.where(np.arange(COUNT) == 4, np.nan, ANSWER), ref=DRIVE * 1e200, fs=-5.0
    )
    with pytest.raises(StapeskitError) as caught:
        read(path, options)
    told = str(caught.value).splitlines()
    assert "the sampling rate must be positive, up to 1e+12 Hz; got -5 Hz" in told[0]
    assert "the first in sample 5 (scan.npz, vib)" in told[1]
    assert "the samples must be below 1e+100; got" in told[2]
    assert len(told) == 3
    rows = [f"{k},{t:.6g},{a:.6g}" for k in (1, 2, 3) for t, a in zip(TIME[:20], ANSWER, strict=False)]
    rows[5], rows[10], rows[30] = rows[5].replace(",", ",9", 1), "1,0.005,y", "2,x,1"
    rows[50] = "3,7,1"
    (tmp_path / "t.csv").write_text("record,time_s,vib\n" + "\n".join(rows))
    with pytest.raises(StapeskitError) as caught:
        read_series(tmp_path / "t.csv", ["vib"])
    told = str(caught.value).splitlines()
    assert sorted(line.split("t.csv, ")[1][:7] for line in told) == [
        "line 12",
        "line 2)",
        "line 32",
        "line 42",
    ]


def test_all_steps_outside_the_record_are_told(tmp_path):
    path, options = _with(tmp_path, vib=ANSWER, ref=DRIVE, fs=RATE)
    steps = tmp_path / "steps.csv"
    steps.write_text("start_s,stop_s,freq_hz\n1,9,100\n0,1,200\n-3,-1,300\n1e300,2e300,5\n")
    with pytest.raises(StapeskitError) as caught:
        read(path, SeriesOptions(options.channels, steps=steps))
    told = str(caught.value).splitlines()
    assert [line.split("(steps.csv, ")[1] for line in told] == ["step 1).", "step 3).", "step 4)."]


def test_a_recording_without_samples_is_refused(tmp_path):
    wavfile.write(tmp_path / "none.wav", 2000, np.zeros((0, 2), dtype=np.int16))
    with pytest.raises(
        StapeskitError, match=r"a recording must be of at least 16 samples; got 0 \(none.wav\)"
    ):
        read_series(tmp_path / "none.wav", ["1", "2"])


def test_tables_without_one_good_row_are_refused(tmp_path):
    for rows in ("1\n2\n", "", "\n\n"):
        (tmp_path / "t.csv").write_text("time_s,vib\n" + rows)
        with pytest.raises(StapeskitError):
            read_series(tmp_path / "t.csv", ["vib"])


@pytest.mark.parametrize("times", ["time_s", "fs"])
def test_an_archive_takes_no_more_than_twice_what_it_declares(tmp_path, times):
    count = 2_000_000
    path = tmp_path / "record.npz"
    rate = {"time_s": np.arange(count) / 1e4} if times == "time_s" else {"fs": np.array(1e4)}
    np.savez_compressed(path, vib=np.zeros(count), unused=np.zeros(count), **rate)
    declared = 8 * count * (2 + (times == "time_s"))
    assert path.stat().st_size < declared / 3
    tracemalloc.start()
    read_series(path, ["vib"])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1.5 * declared
