"""Large tables are read in pieces, and what is wrong in them is told as if they were read whole."""

from __future__ import annotations

import time

import numpy as np
import pandas as pd
import pytest

from legacy.kinematics.tidy.ldv_csv import read_ldv
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.tables import csv_fast
from tests.kinematics.written_csv import plain, same, written

SPOILS = (
    lambda row: row.replace("0.25", "x.25"),
    lambda row: row.replace("0.25", ""),
    lambda row: "# " + row,
    lambda row: "",
    lambda row: row + ",1",
    lambda row: row[: row.rfind(",")],
    lambda row: row.replace("0.25", '"0.25"'),
    lambda row: row + "\n" + row.replace("0.25", "0.5e"),
    lambda row: "  ,,,,,,,,",
    lambda row: row.replace(",y,", ",Y,"),
    lambda row: row.replace("0.25", "1,5"),
)


def test_pieces_and_threads_change_nothing(tmp_path, monkeypatch):
    rng = np.random.default_rng(8)
    rows = []
    for point in range(40):
        for freq in np.linspace(100.0, 5000.0, 20).tolist():
            re_, im = (rng.normal(size=2) * 10.0 ** rng.integers(-12, 3)).tolist()
            rows.append(f"s{point % 3},p{point},{point / 7!r},0,1,y,{freq!r},{re_!r},{im!r}")
    path = written(tmp_path, plain(rows))
    whole = read_ldv(path)
    monkeypatch.setattr(csv_fast, "_PIECE_BYTES", 2000)
    same(read_ldv(path), whole)
    monkeypatch.setattr(csv_fast, "read_fast", lambda *_: None)
    import legacy.stapeskit.tables.csv_table as csv_table

    monkeypatch.setattr(csv_table, "read_fast", lambda *_: None)
    same(read_ldv(path), whole)
    rng.shuffle(rows)
    mixed = read_ldv(written(tmp_path, plain(rows)))
    body = {b.body: b for b in mixed.bodies}
    for one in whole.bodies:
        other = body[one.body]
        order = [other.points.index(point) for point in one.points]
        assert np.array_equal(other.displacement[:, order], one.displacement)


def test_reading_costs_little_more_than_the_bare_parser(tmp_path):
    rng = np.random.default_rng(3)
    rows = [
        f"stapes,{point},{point},0.25,-1.5,y,{freq!r},{a!r},{b!r}"
        for point in range(60)
        for freq, (a, b) in zip(
            np.linspace(1e2, 1e4, 1000).tolist(), rng.normal(size=(1000, 2)).tolist(), strict=True
        )
    ]
    path = written(tmp_path, plain(rows))
    bare = checked = np.inf
    for _ in range(5):
        start = time.process_time()
        pd.read_csv(path)
        middle = time.process_time()
        read_ldv(path)
        bare, checked = min(bare, middle - start), min(checked, time.process_time() - middle)
    assert checked < 1.8 * bare


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("mark", [",", ";"])
def test_few_bad_rows_are_told_as_if_all_were_read_cell_by_cell(tmp_path, monkeypatch, seed, mark):
    import legacy.stapeskit.tables.csv_table as csv_table

    rng = np.random.default_rng(seed)
    rows = [f"s,p{k // 100},{k // 100},0.25,1,y,{100 + k % 100},1.5,{k}" for k in range(1000)]
    kinds = range(len(SPOILS)) if seed % 3 else (2, 3, 8, 9)
    for place in rng.choice(len(rows), 1 + seed % 4, replace=False):
        rows[place] = SPOILS[rng.choice(kinds)](rows[place])
    path = written(tmp_path, plain(rows).replace(",", mark))

    def read():
        try:
            return read_ldv(path)
        except StapeskitError as fault:
            return sorted(str(fault).splitlines())

    with monkeypatch.context() as patch:
        patch.setattr(csv_table, "read_fast", lambda *_: None)
        slow = read()
    monkeypatch.setattr(csv_fast, "_PIECE_BYTES", 9000)
    fast = read()
    if isinstance(slow, list):
        assert fast == slow
        return
    same(fast, slow)
    assert [n.code for n in fast.notices] == [n.code for n in slow.notices]
