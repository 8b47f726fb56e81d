"""Files that belong to one chain, and those that do not."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from legacy.fitting.api import dof2kd
from legacy.fitting.errors import FittingError
from legacy.fitting.file_chain import check_chain
from legacy.stapeskit.frames import RigidTransform
from legacy.stapeskit.provenance import FRAMES_HASH, frames_hash, input_record
from legacy.stapeskit.records.mass_record import MassRecord
from legacy.stapeskit.warnings import Notice
from tests.fitting.cases import paper_motion, six_dof_mass, six_dof_motion

WARNING = Notice("touches_border", "The stapes touches the border.")


def record() -> MassRecord:
    frame = RigidTransform(np.eye(4), "scan", "footplate")
    return MassRecord(six_dof_mass(), frame, None, np.zeros((6, 6)), None, (WARNING,), {})


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    first, second = tmp_path / "mass.json", tmp_path / "other" / "mass.json"
    second.parent.mkdir()
    first.write_text("{}")
    second.write_text('{"other": 1}')
    return first, second


@pytest.mark.parametrize("sha256", [False, True])
def test_the_mass_file_of_the_motion_is_taken_and_its_warnings_travel(files, sha256) -> None:
    used = {"inputs": {"mass": input_record(files[0], sha256)}}
    motion = replace(paper_motion(0.01, 0, 20), provenance=used)
    found = check_chain(motion, "dof.h5", record(), files[0])
    assert [notice.code for notice in found] == [WARNING.code]
    assert found[0].text.startswith("mass: ")


def test_another_mass_file_is_refused_and_force_goes_on_with_a_warning(files) -> None:
    used = {"inputs": {"mass": input_record(files[0])}}
    motion = replace(paper_motion(0.01, 0, 20), provenance=used)
    with pytest.raises(FittingError) as caught:
        check_chain(motion, "dof.h5", record(), files[1])
    (fault,) = caught.value.faults
    assert fault.thing == "{mass}"
    assert used["inputs"]["mass"]["hash"] in fault.expected
    assert str(files[1]) in str(fault.where)
    forced = check_chain(motion, "dof.h5", record(), files[1], force=True)
    assert [notice.code for notice in forced] == ["other_mass_file", WARNING.code]


def test_a_motion_of_a_study_knows_the_frames_that_it_was_tied_to() -> None:
    frames = {"scan_from_footplate": np.eye(4).tolist(), "side": "left"}
    given = replace(record(), raw={"frames": frames, "density_kg_m3": 1900.0})
    motion = replace(paper_motion(0.01, 0, 20), provenance={FRAMES_HASH: frames_hash(given.raw)})
    told = {"frames": {**frames, "anterior_from": "scan.anterior"}, "density_kg_m3": 2000.0}
    denser = replace(given, raw=told)
    for mass in (given, denser):
        assert [notice.code for notice in check_chain(motion, "dof.h5", mass)] == [WARNING.code]
    other = replace(given, raw={"frames": {**frames, "scan_from_footplate": (2.0 * np.eye(4)).tolist()}})
    with pytest.raises(FittingError) as caught:
        check_chain(motion, "dof.h5", other)
    (fault,) = caught.value.faults
    assert fault.thing == "{mass}"
    assert frames_hash(other.raw) in fault.got


def test_motion_without_a_mass_and_plain_matrices_belong_to_no_chain(files) -> None:
    motion = paper_motion(0.01, 0, 20)
    assert [notice.code for notice in check_chain(motion, "dof.csv", record(), files[1])] == [WARNING.code]
    used = {"inputs": {"mass": input_record(files[0])}}
    assert check_chain(replace(motion, provenance=used), "dof.h5", None, files[1]) == []


def document(tmp_path: Path, name: str, date: str, mass: float) -> Path:
    """Write what a mass.json has of interest here."""
    content = {
        "schema": "stapeskit.mass/1",
        "frames": {},
        "mass_matrix": [mass],
        "provenance": {"date": date, "command": date},
    }
    path = tmp_path / name
    path.write_text(json.dumps(content))
    return path


def of_file(path: Path) -> MassRecord:
    return replace(record(), raw=json.loads(path.read_text()))


def test_date_and_command_of_a_mass_file_do_not_matter_but_its_numbers_do(tmp_path: Path) -> None:
    first = document(tmp_path, "mass.json", "monday", 3e-6)
    again, other = (
        document(tmp_path, "again.json", "tuesday", 3e-6),
        document(tmp_path, "other.json", "monday", 4e-6),
    )
    used = {"inputs": {"mass": input_record(first)}}
    motion = replace(paper_motion(0.01, 0, 20), provenance=used)
    for file in (again, None):
        assert [one.code for one in check_chain(motion, "dof.h5", of_file(again), file)] == [WARNING.code]
    for file in (other, None):
        with pytest.raises(FittingError) as caught:
            check_chain(motion, "dof.h5", of_file(other), file)
        assert caught.value.faults[0].thing == "{mass}"


def test_the_function_checks_the_chain_as_the_command_does(tmp_path: Path) -> None:
    first = document(tmp_path, "mass.json", "monday", 4e-6)
    used = {"inputs": {"mass": input_record(first)}}
    motion = replace(six_dof_motion(0.01, 0, lines=20), provenance=used)
    with pytest.raises(FittingError) as caught:
        dof2kd(motion, mass=record(), bands=0)
    assert caught.value.faults[0].thing == "mass"
    fit = dof2kd(motion, mass=record(), bands=0, force=True)
    assert {"other_mass_file", WARNING.code} <= {one.code for one in fit.warnings}
