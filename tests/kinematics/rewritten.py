"""A measurement of three beams a point, written along x, y, z as table, universal file and FastScan."""

from __future__ import annotations

import numpy as np

from tests.kinematics import written_uff as uff
from tests.kinematics.written_psv import fastscan


def write_three_ways(folder, measurement):
    """Write points.csv, xyz.csv, xyz.uff and the folder xyz; points are numbered through all bodies."""
    lines = len(measurement.freq_hz)
    rate = 2j * np.pi * measurement.freq_hz
    # Universal files hold six digits of the step.
    freq = measurement.freq_hz[0] + round(measurement.freq_hz[1] - measurement.freq_hz[0], 2) * np.arange(
        lines
    )
    rows, points, parts = ["body,point,dir,freq_hz,re_m_s,im_m_s"], ["body,point,x_mm,y_mm,z_mm,sd_mm"], []
    places, values = [], []
    for body in measurement.bodies:
        for start in range(0, len(body.points), 3):
            own = slice(start, start + 3)
            places.append(body.positions_mm[start])
            values.append(np.linalg.solve(body.directions[own], body.displacement[0, own] * rate))
            number = len(places)
            place = ",".join(f"{v!r}" for v in places[-1].tolist())
            points.append(f"{body.body},{number},{place},0.01")
            for axis, line in enumerate(values[-1]):
                parts.append(
                    uff.function(freq, line, number, axis + 1, form=6, binary="<", kind=uff.SPECTRUM)
                )
                rows += [
                    f"{body.body},{number},{'xyz'[axis]},{float(f)!r},{float(v.real)!r},{float(v.imag)!r}"
                    for f, v in zip(freq, line, strict=True)
                ]
    (folder / "points.csv").write_text("\n".join(points) + "\n")
    (folder / "xyz.csv").write_text("\n".join(rows) + "\n")
    (folder / "xyz.uff").write_bytes(b"".join([uff.units(), *parts]))
    (folder / "xyz").mkdir()
    for k, f in enumerate(freq):
        text = fastscan(f, np.array(places) * 1e-3, np.array([v[:, k] for v in values]))
        (folder / "xyz" / f"{f:.2f}.txt").write_bytes(text)
