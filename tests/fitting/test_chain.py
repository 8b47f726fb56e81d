"""Files that belong to one chain, and those that do not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fitting.chain import check_chain
from fitting.errors import FittingError
from stapeskit.frames import RigidTransform
from stapeskit.provenance import input_record
from stapeskit.records.mass_record import MassRecord
from stapeskit.warnings import Notice
from tests.fitting.cases import paper_motion, six_dof_mass

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
    found = check_chain(motion, Path("dof.h5"), files[0], record())
    assert [notice.code for notice in found] == [WARNING.code]
    assert found[0].text.startswith("mass.json: ")


def test_another_mass_file_is_refused_and_force_goes_on_with_a_warning(files) -> None:
    used = {"inputs": {"mass": input_record(files[0])}}
    motion = replace(paper_motion(0.01, 0, 20), provenance=used)
    with pytest.raises(FittingError) as caught:
        check_chain(motion, Path("dof.h5"), files[1], record())
    (fault,) = caught.value.faults
    assert fault.thing == "{mass}"
    assert used["inputs"]["mass"]["hash"] in fault.expected
    assert str(files[1]) in str(fault.where)
    forced = check_chain(motion, Path("dof.h5"), files[1], record(), force=True)
    assert [notice.code for notice in forced] == ["other_mass_file", WARNING.code]


def test_motion_without_a_mass_and_plain_matrices_belong_to_no_chain(files) -> None:
    motion = paper_motion(0.01, 0, 20)
    assert [notice.code for notice in check_chain(motion, Path("dof.csv"), files[1], record())] == [
        WARNING.code
    ]
    used = {"inputs": {"mass": input_record(files[0])}}
    assert check_chain(replace(motion, provenance=used), Path("dof.h5"), files[1], None) == []
