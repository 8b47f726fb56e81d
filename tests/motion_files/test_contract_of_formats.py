"""The contract of every format: what is written is read, what is cut is refused, nothing crashes."""

from contextlib import suppress

import numpy as np
import pytest

from kinematics.readers.formats import FORMATS, format_of, read_file
from kinematics.readers.stated_by_user import FileFacts
from stapeskit.faults import StapeskitError
from tests.motion_files.written_files import FREQ_HZ, OTHERS, PLACES_M, VELOCITY, WRITERS

WAYS = {**WRITERS, **OTHERS}
NAMES = [*(entry.name for entry in FORMATS), *OTHERS]
FORMAT_OF = {"hdf5": "matlab", "points": "psv"}
SEEDS = 6  # damages of each kind of file; benchmarks/damaged_files.py tries as many as one asks for
# Rounding of the formats: digits of the text, and of single precision in a genuine scan.
TOLERANCE = {"series": 1e-9, "psv": 1e-11, "points": 1e-11, "uff": 1e-11}


def by_channel(recording):
    """Values by point and beam."""
    return {row.beam: row.value for row in recording.rows}


@pytest.mark.parametrize("name", NAMES)
def test_what_is_written_is_recognised_and_read(name, tmp_path):
    path, facts = WAYS[name](tmp_path)
    assert format_of(path).name == FORMAT_OF.get(name, name)
    recording = read_file(path, facts)
    if name == "svd":  # a genuine scan: see test_polytec_scans.py
        return
    assert np.allclose(recording.freq_hz, FREQ_HZ, rtol=1e-9)
    found = by_channel(recording)
    assert len(found) == 9
    for point in range(3):
        for axis in range(3):
            value = found[str(point + 1), tuple((1e6 * np.eye(3)[axis]).tolist())]
            size = np.max(np.abs(VELOCITY))
            assert np.allclose(value, VELOCITY[point, axis], rtol=0.0, atol=TOLERANCE.get(name, 1e-14) * size)
    if name != "wide":
        places = {row.point: row.position_m for row in recording.rows}
        for point in range(3):
            assert np.allclose(places[str(point + 1)], PLACES_M[point], atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_cut_files_are_refused(name, tmp_path):
    """Cut in their last tenth, where what is there may look whole."""
    path, facts = WAYS[name](tmp_path)
    whole = path.read_bytes()
    silent = []
    for share in np.linspace(0.05, 0.97, 6):
        path.write_bytes(whole[: int(share * len(whole))])
        try:
            values = read_file(path, facts).value
        except StapeskitError:
            continue
        silent.append(np.sum(np.isfinite(values)))
    # A text that ends between two numbers or rows cannot be told from a shorter one; its lines are fewer.
    most = 9 * len(FREQ_HZ) if name in ("tidy", "wide", "psv", "points") else 0
    assert all(count < most for count in silent), silent


@pytest.mark.parametrize("name", NAMES)
def test_damaged_files_end_in_values_or_in_a_refusal(name, tmp_path):
    path, facts = WAYS[name](tmp_path)
    whole = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        content = whole.copy()
        # half of the seeds strike the head, where formats say what follows
        end = len(content) if seed % 2 else min(len(content), 600)
        content[rng.integers(0, end, 1 + seed % 8)] = rng.integers(0, 256, 1 + seed % 8)
        path.write_bytes(content.tobytes())
        with suppress(StapeskitError):
            recording = read_file(path, facts)
            assert recording.value.shape == (len(recording.rows), len(recording.freq_hz))
            assert np.all(np.diff(recording.freq_hz) > 0.0)


def test_other_scan_files_are_refused_with_how_to_export(tmp_path):
    (tmp_path / "a.pvd").write_bytes(b"a scan of another program")
    with pytest.raises(StapeskitError) as caught:
        read_file(tmp_path / "a.pvd", FileFacts())
    assert "UFF" in caught.value.faults[0].next_step


def test_files_of_no_known_format_are_refused_with_what_to_do(tmp_path):
    for name, content, got in (
        ("a.bin", bytes(range(256)), ".bin"),
        ("a.xlsx", b"PK\x03\x04", "a workbook or archive"),
    ):
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(StapeskitError) as caught:
            format_of(path)
        fault = caught.value.faults[0]
        assert fault.got == got
        assert fault.next_step
        assert all(entry.words in fault.expected for entry in FORMATS)
