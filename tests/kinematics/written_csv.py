"""A small tidy table as text, and how two measurements are compared."""

from __future__ import annotations

import numpy as np

HEAD = "body,point,x_mm,y_mm,z_mm,dir,freq_hz,re_m_s,im_m_s"
WITH_BEAMS = "body,point,x_mm,y_mm,z_mm,dir_x,dir_y,dir_z,freq_hz,re_m_s,im_m_s"


ROWS = [
    f"{body},{point},{0.5 * point},0.25,{z},{axis},{freq},{point + 0.125},{-freq * 1e-3}"
    for body, z in (("stapes", 0.0), ("base", -1.5))
    for point in (1, 2)
    for axis in ("y", "-z")
    for freq in (100.0, 250.5, 1e4)
]


THREE_ROWS = ["stapes,1,0,0,0,y,100,1,2", "stapes,1,0,0,0,y,200,3,4", "stapes,2,1,0,0,-z,100,5,6"]


FIRST = 2


def written(folder, data, name="ldv.csv"):
    path = folder / name
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return path


def plain(rows=ROWS, head=HEAD, end="\n"):
    return end.join([head, *rows]) + end


def table(folder, head=HEAD, rows=THREE_ROWS):
    return written(folder, plain(rows, head))


def same(one, two):
    """Compare two measurements to the last bit."""
    assert (one.runs, one.order) == (two.runs, two.order)
    assert np.array_equal(one.freq_hz, two.freq_hz)
    assert [body.body for body in one.bodies] == [body.body for body in two.bodies]
    for a, b in zip(one.bodies, two.bodies, strict=True):
        assert a.points == b.points
        for name in ("positions_mm", "directions", "displacement"):
            assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True), name
