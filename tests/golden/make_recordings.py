"""Write the recordings of a vibrometer among the golden inputs, in every file and unit that is read."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np


def recording_of(lines: int = 30, seed: int = 3, **how: object) -> tuple[object, object]:
    from legacy.fitting.examples.paper import PAPER_MASS
    from legacy.stapeskit.frames import RigidTransform
    from sample_volumes import bodies
    from sample_volumes.vibrometer import Vibrometry, record

    chosen = Vibrometry(lines=lines, seed=seed, stapes_points=8, bone_points=6, **how)
    mass = np.diag([3.2e-6, 3.2e-6, 3.2e-6, 9e-12, 4e-12, 9e-12])
    mass[np.ix_([1, 3, 5], [1, 3, 5])] = PAPER_MASS
    marks = [(f"f{k}", np.array(place)) for k, place in enumerate(np.eye(3) * 4.0)] + [("f3", np.zeros(3))]
    frame = RigidTransform.identity("footplate", "plate")
    return record(mass, frame, chosen, marks, stapes=bodies.stapes_in_footplate()), chosen


def faults(folder: Path) -> None:
    """One recording without and with a fault of each kind; positions in the footplate frame by fiducials."""
    from sample_volumes.faults import KINDS, Fault, faulty
    from sample_volumes.old_study import write_recording

    recording, how = recording_of()
    sizes = {"gain": 0.08, "direction": 5.0, "position": 0.4, "noise": 5.0, "drift": 0.1}
    for kind in ("none", *KINDS):
        seen = recording
        if kind != "none":
            seen = faulty(recording, Fault(kind, "stapes", "3", 1, sizes.get(kind, 0.05), "5"))
        made = folder / "faults" / kind
        made.mkdir(parents=True)
        write_recording(made, seen, how, "footplate")
    mirrored, how = recording_of(mirror="z")
    (folder / "mirrored_ldv").mkdir()
    write_recording(folder / "mirrored_ldv", mirrored, how, "footplate")


def repeats(folder: Path) -> None:
    """Write four repeats, steady and with creep, and two levels of excitation in a file each."""
    from tests.kinematics.simulated import HEADER, csv_rows, scene

    made = folder / "repeats"
    made.mkdir()
    rng = np.random.default_rng(5)
    for name, creep in (("steady", 0.0), ("creep", 0.01)):
        rows = []
        for repeat in range(4):
            for body, seed in (("stapes", 1), ("base", 2)):
                one = scene(seed, lines=24, count=4)
                moved = np.exp(1j * creep * repeat * one.freq_hz / 400.0)
                fresh = one.sd * (rng.normal(size=(*one.value.shape, 2)) @ np.array([1.0, 1j]))
                one.value = one.value * moved + fresh
                rows += [f"{row},{repeat + 1}" for row in csv_rows(body, one, 7)]
        (made / f"{name}.csv").write_text("\n".join([f"{HEADER},repeat", *rows]) + "\n")
    for number, push in enumerate((1.0, 2.0), 1):
        rows = []
        for body, seed in (("stapes", 1), ("base", 2)):
            one = scene(seed, lines=24, count=4)
            one.value = one.value * push
            one.sd = one.sd * push
            rows += [f"{row},{push:g}" for row in csv_rows(body, one, 7)]
        (made / f"level{number}.csv").write_text("\n".join([f"{HEADER},level", *rows]) + "\n")


def exports(folder: Path) -> None:
    """One measurement in every file of a vibrometer, along x, y, z."""
    from scipy.io import savemat

    from legacy.kinematics.readers.hdf5 import write_hdf5
    from legacy.kinematics.tidy.ldv_csv import read_ldv
    from sample_volumes.old_study import write_recording
    from tests.kinematics import written_uff as uff
    from tests.kinematics.readers.test_matlab import usd
    from tests.kinematics.rewritten import write_three_ways
    from tests.kinematics.written_mat import write_v73
    from tests.kinematics.written_psv import point

    made = folder / "exports"
    made.mkdir()
    recording, how = recording_of(lines=16, seed=6)
    write_recording(made, recording, how, "footplate")
    measured = read_ldv(made / "ldv.csv", made / "points.csv")
    shutil.copy(made / "points.csv", made / "places.csv")
    write_three_ways(made, measured)
    freq = 400.0 + round(measured.freq_hz[1] - measured.freq_hz[0], 2) * np.arange(16)
    rate = 2j * np.pi * freq
    table = {}
    for body in measured.bodies:
        for start in range(0, len(body.points), 3):
            own = slice(start, start + 3)
            value = np.linalg.solve(body.directions[own], body.displacement[0, own] * rate)
            table[len(table) + 1] = (body.body, body.positions_mm[start], value)
    places = {number: place * 1e-3 for number, (_, place, _) in table.items()}
    for name, nodes, binary, form in (
        ("text15.uff", uff.nodes_15, "", 6),
        ("binary2411.uff", uff.nodes_2411, "<", 5),
    ):
        parts = [uff.units(), nodes(places)]
        for number, (_, _, value) in table.items():
            for axis in range(3):
                for kind, line in ((uff.FRF, value[axis]), (uff.COHERENCE, np.full(16, 0.98))):
                    real = 4 if form == 6 else 2
                    parts.append(
                        uff.function(
                            freq,
                            line,
                            number,
                            axis + 1,
                            kind=kind,
                            binary=binary,
                            form=form if kind == uff.FRF else real,
                        )
                    )
        (made / name).write_bytes(b"".join(parts))
    (made / "points_text").mkdir()
    for number, (_, place, value) in table.items():
        text = point(number, freq, value.T, place=place * 1e-3, component="XYZ")
        (made / "points_text" / f"p{number}.txt").write_bytes(text)
    dense = np.array([value for _, _, value in table.values()])
    arrays = {"freqp": freq, "xyz_mm": np.array([place for _, place, _ in table.values()]), "n_avg": 20.0}
    for axis, name in enumerate("xyz"):
        arrays |= {
            f"amp_{name}": dense[:, axis],
            f"usd_{name}": usd(),
            f"coh_{name}": np.full((14, 16), 0.99),
        }
    savemat(made / "scan.mat", arrays)
    write_v73(made / "scan73.mat", arrays)
    write_hdf5(
        made / "scan.h5",
        freq,
        dense.reshape(-1, 16),
        unit="m/s",
        point=[str(number) for number in table for _ in "xyz"],
        body=[body for body, _, _ in table.values() for _ in "xyz"],
        direction=np.tile(np.eye(3), (len(table), 1)),
        position_mm=np.repeat([place for _, place, _ in table.values()], 3, axis=0),
    )
    _units(made, recording)


def _units(made: Path, recording: object) -> None:
    """The tidy table in other units: displacement in nm, acceleration, RMS amplitude and phase."""
    head = "body,point,dir_x,dir_y,dir_z,freq_hz,"
    kinds = {
        "re_nm": (head + "re_nm,im_nm", lambda v, w: v / (1j * w) * 1e9),
        "re_m_s2": (head + "re_m_s2,im_m_s2", lambda v, w: v * 1j * w),
        "amp_rms_mm_s": (head + "amp_rms_mm_s,phase_deg,n_avg,coherence", None),
    }
    for name, (columns, change) in kinds.items():
        rows = [columns]
        for channel, body in enumerate(recording.body):
            beam = ",".join(f"{part:.12g}" for part in recording.direction[channel])
            for freq, value in zip(recording.freq_hz, recording.velocity_m_s[0, channel], strict=True):
                start = f"{body},{recording.point[channel]},{beam},{freq:.12g}"
                if change is None:
                    size, phase = abs(value) * 1e3 / np.sqrt(2.0), np.angle(value, deg=True)
                    rows.append(f"{start},{size:.7g},{phase:.6g},20,0.995")
                else:
                    other = change(value, 2.0 * np.pi * freq)
                    rows.append(f"{start},{other.real:.7g},{other.imag:.7g}")
        (made / f"{name}.csv").write_text("\n".join(rows) + "\n")


def series(folder: Path) -> None:
    """Sampled signals: periodic, random and stepped excitation, in whole steps of a converter."""
    from tests.kinematics import series

    made = folder / "series"
    made.mkdir()
    rng = np.random.default_rng(11)
    used = [k for k, one in enumerate(series.channels()) if int(one[2]) <= 3]
    names = [series.channels()[k][0] for k in used]
    series.table(made / "all.csv")
    kept = [
        line
        for line in (made / "all.csv").read_text().splitlines()
        if line.split(",")[0] in ("channel", "drive", *names)
    ]
    (made / "channels.csv").write_text("\n".join(kept) + "\n")
    (made / "all.csv").unlink()

    def stored(drive: np.ndarray, velocity: np.ndarray) -> dict[str, np.ndarray]:
        arrays = {"drive": np.round(drive * 1e3) / 1e3}
        for name, k in zip(names, used, strict=True):
            step = np.max(np.abs(velocity[k])) / 2047.0
            arrays[name] = (np.round(velocity[k] / step) * step * 1e3).astype(np.float32)
        return arrays

    _, drive, velocity = series.multisine(rng, 1024, 5, 0.05)
    np.savez_compressed(made / "periodic.npz", sample_rate_hz=series.RATE_HZ, **stored(drive, velocity))
    _, drive, velocity = series.multisine(rng, 4096, 1, 0.1, every=1, low=300.0)
    np.savez_compressed(made / "random.npz", sample_rate_hz=series.RATE_HZ, **stored(drive, velocity))
    freq = np.linspace(500.0, 4500.0, 8)
    set_hz, drive, velocity = series.stepped(rng, freq, 0.03, 0.05)
    arrays = {"set_hz": set_hz} | stored(drive, velocity)
    np.savez_compressed(made / "stepped.npz", sample_rate_hz=series.RATE_HZ, **arrays)
    lasts = int(0.03 * series.RATE_HZ) / series.RATE_HZ
    rows = [f"{k * lasts:.6g},{(k + 1) * lasts - 1e-4:.6g},{one:.10g}" for k, one in enumerate(freq)]
    (made / "steps.csv").write_text("\n".join(["start_s,stop_s,freq_hz", *rows]) + "\n")
