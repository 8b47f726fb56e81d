"""Make inputs.tar.xz anew from the generators of tests and sample_volumes.

Done once, by python -m tests.golden.make_inputs; new inputs mean new results (make golden-record).
"""

from __future__ import annotations

import json
import lzma
import shutil
import tarfile
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.golden.inputs import ARCHIVE
from tests.golden.make_recordings import exports, faults, repeats, series


def main() -> None:
    """Write the archive."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for part in PARTS:
            part(folder)
        _pack(folder)
    print(f"{ARCHIVE.name}: {ARCHIVE.stat().st_size / 1e6:.2f} MB")


def _pack(folder: Path) -> None:
    with (
        lzma.open(ARCHIVE, "wb", preset=9 | lzma.PRESET_EXTREME) as stream,
        tarfile.open(fileobj=stream, mode="w") as archive,
    ):
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                entry = archive.gettarinfo(path, path.relative_to(folder).as_posix())
                entry.uid = entry.gid = entry.mtime = 0
                entry.uname = entry.gname = ""
                entry.mode = 0o644
                with path.open("rb") as file:
                    archive.addfile(entry, file)


def _scans(folder: Path) -> None:
    """Clean pictures of ears: with and without plate, in situ, with an incus, mirrored, at the border."""
    from sample_volumes import bodies
    from sample_volumes.old_study import make_study
    from sample_volumes.phantom import Ear, render, scene, truth
    from sample_volumes.vibrometer import Vibrometry

    plain = Ear(voxel_mm=(0.05,) * 3, noise=0.0, dtype="uint8")
    ears = {
        "whole": plain,
        "unequal": replace(plain, voxel_mm=(0.05, 0.045, 0.06), pose_seed=4, bone=False),
        "mirrored": replace(plain, mirror="z", plate=False, pose_seed=3),
        "gap": replace(plain, voxel_mm=(0.04,) * 3, gap_mm=0.06, plate=False, pose_seed=2),
        "bridges": replace(plain, voxel_mm=(0.04,) * 3, gap_mm=0.08, bridges=2, plate=False),
        "incus": replace(plain, voxel_mm=(0.04,) * 3, incus_gap_mm=-0.05, plate=False),
        "border": replace(plain, bone_reach=1.5, plate=False, dust=3),
        "plate_cropped": replace(plain, plate_reach=1.6, bone=False, pose_seed=5),
        "cupping": replace(plain, cupping=0.1, bone=False, plate=False, pose_seed=6),
        "graded": replace(plain, gradient=0.1, bone=False, plate=False, pose_seed=7),
    }
    for name, ear in ears.items():
        placed = scene(ear)
        (folder / name).mkdir()
        np.savez(folder / name / "scan.clean.npz", grey=render(placed), spacing_mm=ear.voxel_mm)
        behind = truth(placed)
        found = {
            "anterior": np.array(behind["scan_from_footplate"])[:3, 0].tolist(),
            "in_the_footplate_mm": placed.scan_from_footplate.points(np.array([0.0, 0.1, 0.0])).tolist(),
        }
        (folder / name / "known.json").write_text(json.dumps(found))
    how = Vibrometry(lines=40, stapes_points=7, bone_points=6)
    made = folder / "made"
    make_study(made, plain, how, "small ear", ("ldv",))
    for name in ("ldv.csv", "points.csv", "fiducials.csv", "study.toml"):
        (made / name).rename(folder / "whole" / name)
    (made / "truth.json").unlink()
    two = replace(how, excitations=("y", "x"), lines=30, seed=2)
    bare = replace(plain, plate=False)
    make_study(folder / "two_runs", bare, two, "two runs", ("ldv",))
    for name in ("truth.json", "study.toml"):
        (folder / "two_runs" / name).unlink()
    _landmarks(folder, scene(ears["whole"]), bodies)


def _landmarks(folder: Path, placed: object, bodies: object) -> None:
    pose = placed.scan_from_footplate
    places = {
        "anterior": [1.3, 0, 0],
        "superior": [0, 0, 0.6],
        "head": [0, 3.2, 0],
        "footplate_centre": [0] * 3,
    }
    rows = [
        f"{name}," + ",".join(f"{v:.4f}" for v in pose.points(np.array(place, dtype=float)))
        for name, place in places.items()
    ]
    (folder / "whole" / "landmarks.csv").write_text("\n".join(["name,x_mm,y_mm,z_mm", *rows]) + "\n")
    plate = pose @ placed.footplate_from_plate
    marks = np.array([[-2.0, 0, -1.3], [2.0, 0, -1.3], [2.0, 0, 1.3], [-2.0, 0, 1.3], [0, -0.5, 0]])
    rows = [
        f"p{k}," + ",".join(f"{v:.4f}" for v in (*plate.points(mark), *mark)) for k, mark in enumerate(marks)
    ]
    head = "name,x_mm,y_mm,z_mm,x_ref_mm,y_ref_mm,z_ref_mm"
    (folder / "whole" / "plate_fiducials.csv").write_text("\n".join([head, *rows]) + "\n")


def _ears(folder: Path) -> None:
    """Three studies whose scans are meshes."""
    from tests.pipeline.ears import make_ear

    for number in (1, 2, 3):
        make_ear(folder / f"ear{number}", f"ear {number}", seed=number, density=f"{1300 + 50 * number}+-14")
    import trimesh

    mesh = trimesh.load(folder / "ear1" / "stapes.ply")
    mesh.export(folder / "ear1" / "stapes.stl")
    mesh.export(folder / "ear1" / "stapes.obj")
    mesh.update_faces(np.arange(len(mesh.faces)) > 20)
    mesh.export(folder / "ear1" / "open.stl")


def _formats(folder: Path) -> None:
    """One small scan in every format; rounded, so that it packs."""
    from tests.ct_inertia.ears import ear
    from tests.ct_inertia.readers import scanner_writers as scanners
    from tests.ct_inertia.readers import writers as f

    made = folder / "formats"
    made.mkdir()
    grey = (np.clip(np.round(ear(h=0.07, seed=2).volume.array / 256.0), 0, 120) * 256).astype(np.int16)
    f.SPACING = np.array([0.07] * 3)
    f.imagej(made / "imagej.tif", grey.astype(np.uint16))
    f.ome(made / "ome.ome.tif", grey)
    f.slices(made / "slices", grey)
    f.skyscan(made / "skyscan", grey)
    f.itk(made / "itk.nrrd", grey)
    f.itk(made / "packed.nrrd", grey, packed=True)
    f.itk(made / "itk.mha", grey)
    f.itk(made / "itk.mhd", grey)
    f.nifti(made / "scan.nii", grey)
    f.dicom(made / "dicom", grey)
    scanners.isq(made / "scan.isq", grey)
    scanners.aim(made / "scan.aim", grey)
    scanners.aim30(made / "scan30.aim", grey)
    scanners.vgi(made / "scan.vgi", grey.astype(np.uint16))
    scanners.amira(made / "scan.am", grey)
    f.raw(made / "scan.raw", grey, header=77)
    f.ome_zarr(made / "scan.zarr", grey, "0.5", chunk=64)
    f.ome_zarr(made / "scan2.zarr", grey, "0.4", chunk=64)
    (made / "shape.txt").write_text(",".join(map(str, grey.shape[::-1])))
    f.itk(made / "labels.nrrd", _labels(grey))


def _labels(grey: np.ndarray) -> np.ndarray:
    from scipy.ndimage import label

    found, _ = label(grey > 11000)
    sizes = np.bincount(found.ravel())
    return (found == 1 + np.argmax(sizes[1:])).astype(np.uint8)


def _surfaces(folder: Path) -> None:
    """A folder of ct2mass with points on the plate and the bone, as tests/kinematics has them."""
    from tests.kinematics.registration import test_geometry_command as command
    from tests.kinematics.registration.test_sample_displacement import write_scan

    made = folder / "surfaces"
    made.mkdir()
    write_scan(made)
    command.files.__wrapped__(made)  # what the fixture wraps


def _motions(folder: Path) -> None:
    """Motions as points2dof writes them, with the mass they belong to."""
    from legacy.fitting.model.damping import DampingLaw
    from legacy.pipeline.scan2kd import run_study
    from legacy.stapeskit.records.motion_files import write_motion
    from tests.fitting.cases import M, paper_motion, six_dof_matrices, six_dof_motion

    made = folder / "motions"
    made.mkdir()
    motions = {
        "paper": paper_motion(lines=40),
        "hysteretic": paper_motion(lines=40, law=DampingLaw("hysteretic")),
        "exact": paper_motion(seed=None, lines=40),
        "six": six_dof_motion(0.02, 1, "yxz", lines=30),
    }
    for name, motion in motions.items():
        ones = np.ones_like(motion.chi2)
        write_motion(made, name, replace(motion, chi2=42.0 * ones, n_dof=42.0 * ones))
    np.savetxt(made / "M.csv", M, delimiter=",")
    np.savetxt(made / "M6.csv", six_dof_matrices()[0], delimiter=",")
    run_study(folder / "ear1" / "study.toml", folder / "run")
    for name in ("mass.json", "dof.csv", "dof.h5"):
        (folder / "run" / name).rename(made / name)
    shutil.rmtree(folder / "run")


PARTS = (_scans, _ears, _formats, faults, repeats, exports, series, _surfaces, _motions)


if __name__ == "__main__":
    main()
