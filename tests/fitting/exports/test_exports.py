"""Exports give back what was fitted; the Abaqus deck, assembled from its text, gives the modes back."""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
import subprocess
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.io import loadmat

from legacy.fitting.errors import FittingError
from legacy.fitting.export_formats import EXPORTS, exported, file_name
from legacy.fitting.exports.inp import mass_points, spring_points
from legacy.fitting.exports.joint import joint_parameters
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.options import KDOptions
from legacy.fitting.recorded_fit import kd_of
from legacy.stapeskit.spatial import matrix_from_parameters
from tests.fitting.cases import K, M, paper_motion, six_dof_mass, six_dof_motion, six_dof_parameters


@pytest.fixture(scope="module")
def fit():
    mass = six_dof_mass({"density": 0.02**2 * np.outer(six_dof_parameters(), six_dof_parameters())})
    return kd_of(six_dof_motion(0.01, 0, lines=60), mass, KDOptions(bands=0))


def test_every_export_is_written_beside_the_record(fit, tmp_path) -> None:
    assert len({file_name("kd", name) for name in EXPORTS}) == len(EXPORTS)
    files = fit.write(tmp_path, export=tuple(EXPORTS))
    assert {file.name for file in files} == {
        "kd.json",
        "kd.html",
        *(file_name("kd", name) for name in EXPORTS),
    }
    assert all(file.stat().st_size > 100 for file in files)


def test_matlab_and_table_hold_matrices_and_covariance(fit) -> None:
    read = loadmat(io.BytesIO(exported(fit, "mat")))
    assert np.array_equal(read["K"], fit.stiffness)
    assert np.array_equal(read["covariance"][:12, :12], joint_parameters(fit).covariance[:12, :12])
    rows = list(csv.DictReader(io.StringIO(exported(fit, "csv").decode())))
    assert [row["entry"] for row in rows] == list(fit.parameters)
    assert float(rows[0]["value"]) == fit.stiffness[0, 0]
    assert [float(rows[3][f"cov_{name}"]) for name in fit.parameters] == list(fit.covariance[3])


def test_joint_covariance_holds_the_errors_that_k_d_and_m_share(fit) -> None:
    """A density that is too high raises M and K together: their relative errors are nearly one."""
    found = json.loads(exported(fit, "joint"))
    names, covariance = found["parameters"], np.array(found["covariance_si"])
    assert np.allclose(covariance, covariance.T)
    sd = np.sqrt(np.diag(covariance))
    values = np.linalg.eigvalsh(covariance / np.outer(np.where(sd > 0, sd, 1), np.where(sd > 0, sd, 1)))
    assert values[0] > -1e-9
    k11, m11 = names.index("K11"), names.index("M11")
    assert covariance[k11, m11] == pytest.approx(0.02**2 * fit.stiffness[0, 0] * fit.mass[0, 0], rel=0.1)
    assert np.array_equal(covariance[:12, :12], 0.5 * (fit.covariance + fit.covariance.T))


def test_springs_and_masses_make_their_matrices() -> None:
    points = spring_points(K)
    rows = np.column_stack([np.ones(4), -points[:, 1], points[:, 0]])
    assert rows.T @ rows * K[0, 0] / 4.0 == pytest.approx(K, rel=1e-9, abs=1e-12)
    parameters = six_dof_parameters()
    total = np.zeros(10)
    for place in mass_points(parameters):
        mass = parameters[0] / 6.0
        tensor = mass * (place @ place * np.eye(3) - np.outer(place, place))
        entries = [tensor[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))]
        total += np.array([mass, *(mass * place), *entries])
    assert matrix_from_parameters(total) == pytest.approx(
        matrix_from_parameters(parameters), rel=1e-9, abs=1e-18
    )


def deck_blocks(deck: str) -> list[tuple[str, list[str]]]:
    """Return the keyword lines of an Abaqus deck, each with its data lines."""
    made: list[tuple[str, list[str]]] = []
    for line in deck.splitlines():
        if line.startswith("**"):
            continue
        if line.startswith("*"):
            made.append((line, []))
        else:
            made[-1][1].append(line.strip())
    return made


def assembled(deck: str) -> dict[str, np.ndarray]:
    """Assemble the deck's rigid body by itself: mass, stiffness and damping (6, 6) about node 1."""
    nodes: dict[int, np.ndarray] = {}
    sets: dict[str, tuple[str, list[list[int]]]] = {}
    total = {name: np.zeros((6, 6)) for name in ("MASS", "SPRING", "DASHPOT")}
    for keyword, lines in deck_blocks(deck):
        name, _, rest = keyword[1:].partition(",")
        options = dict(part.strip().split("=") for part in rest.split(",") if "=" in part)
        if name == "NODE":
            for line in lines:
                number, *place = line.split(",")
                nodes[int(number)] = np.array(place, dtype=float)
        elif name == "ELEMENT":
            sets[options["ELSET"]] = (
                options["TYPE"],
                [[int(n) for n in line.split(",")[1:]] for line in lines],
            )
        elif name in total:
            kind, elements = sets[options["ELSET"]]
            for own in elements if not options["ELSET"].startswith("far") else ():
                if kind == "SPRING1":  # node 2 holds the rotations
                    rows = np.eye(6)[[int(lines[0]) - 1 + 3 * (own[0] == 2)]]
                else:
                    r = nodes[own[0]]
                    skew = np.array([[0.0, r[2], -r[1]], [-r[2], 0.0, r[0]], [r[1], -r[0], 0.0]])
                    rows = np.hstack([np.eye(3), skew])
                    if kind.endswith("A"):
                        line = nodes[own[1]] - r
                        rows = (line / np.linalg.norm(line))[None] @ rows
                total[name] += float(lines[-1]) * rows.T @ rows
    return total


def test_the_deck_alone_gives_back_modes_and_damping(fit) -> None:
    """Assembled from the text by the rules of the elements, without the program's matrices."""
    found = assembled(exported(fit, "inp").decode())
    values = np.sort(np.linalg.eigvals(np.linalg.solve(found["MASS"], found["SPRING"])).real)[:3]
    wanted = np.sort(np.linalg.eigvals(np.linalg.solve(fit.mass, fit.stiffness)).real)
    assert np.sqrt(values) == pytest.approx(np.sqrt(wanted), rel=1e-3)
    piston = np.ix_([1, 3, 5], [1, 3, 5])
    size = np.sqrt(np.outer(np.diag(fit.damping), np.diag(fit.damping)))
    assert np.abs((found["DASHPOT"][piston] - fit.damping) / size).max() < 1e-8


# Parameters of each keyword used here. CalculiX reads lines of 132 characters in at most 16 fields, and of a
# real number the first 20 characters; a dashpot's first line is its constant, without an empty one
# (dashpots.f).
CALCULIX = {
    "NODE": {"NSET"},
    "ELEMENT": {"TYPE", "ELSET"},
    "SPRING": {"ELSET"},
    "DASHPOT": {"ELSET"},
    "MASS": {"ELSET"},
    "NSET": {"NSET"},
    "RIGID BODY": {"NSET", "REF NODE", "ROT NODE"},
    "BOUNDARY": set(),
    "STEP": set(),
    "FREQUENCY": set(),
    "NODE FILE": set(),
    "END STEP": set(),
}
NODES_OF = {"SPRINGA": 2, "DASHPOTA": 2, "SPRING1": 1, "MASS": 1}
IN_STEP = ("FREQUENCY", "NODE FILE", "END STEP")


def test_the_deck_follows_the_grammar_of_calculix(fit) -> None:
    deck = exported(fit, "inp").decode()
    assert max(map(len, deck.splitlines())) <= 132
    nodes: set[int] = set()
    elements: set[int] = set()
    sets: dict[str, str] = {}
    groups: set[str] = set()
    in_step = False
    for keyword, lines in deck_blocks(deck):
        name, _, rest = keyword[1:].partition(",")
        options = dict(part.strip().split("=") for part in rest.split(",") if part.strip())
        assert set(options) <= CALCULIX[name]
        assert all(value[0].isalnum() and len(value) <= 80 for value in options.values())
        fields = [[field.strip() for field in line.rstrip(",").split(",")] for line in lines]
        assert all(len(line) <= 16 and max(map(len, line)) <= 20 for line in fields)
        in_step |= name == "STEP"
        assert (name in IN_STEP) == (in_step and name != "STEP")
        if name == "NODE":
            numbers = [int(line[0]) for line in fields]
            assert not nodes & set(numbers)
            assert all(len(line) == 4 for line in fields)
            nodes |= set(numbers)
            groups.add(options["NSET"])
        elif name == "ELEMENT":
            kind = options["TYPE"]
            assert all(len(line) == 1 + NODES_OF[kind] for line in fields)
            assert {int(node) for line in fields for node in line[1:]} <= nodes
            numbers = [int(line[0]) for line in fields]
            assert not elements & set(numbers)
            elements |= set(numbers)
            sets[options["ELSET"]] = kind
        elif name == "NSET":
            assert {int(line[0]) for line in fields} <= nodes
            groups.add(options["NSET"])
        elif name in ("SPRING", "DASHPOT", "MASS"):
            kind = sets[options["ELSET"]]
            assert kind.startswith(name)
            # the first line of a spring is its direction, none for SPRINGA; a dashpot has its constant alone
            first = [line[0] for line in fields[:-1]]
            assert first in {"SPRINGA": [[""]], "SPRING1": [["1"], ["2"], ["3"]]}.get(kind, [[]])
            assert float(fields[-1][0]) > 0.0
        elif name == "BOUNDARY":
            assert all(line[0] in groups and 1 <= int(line[1]) <= int(line[2]) <= 6 for line in fields)
        elif name == "RIGID BODY":
            assert options["NSET"] in groups
            assert {int(options["REF NODE"]), int(options["ROT NODE"])} <= nodes


@pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX is not installed")
def test_calculix_finds_the_three_modes_of_k_and_m(fit, tmp_path) -> None:
    (tmp_path / "kd.inp").write_bytes(exported(fit, "inp"))
    done = subprocess.run(["ccx", "kd"], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "*ERROR" not in done.stdout
    rows = re.findall(r"^ +\d+ +(0\.\d+E[+-]\d+) +0\.", (tmp_path / "kd.dat").read_text(), re.MULTILINE)
    values = np.sort(np.linalg.eigvals(np.linalg.solve(fit.mass, fit.stiffness)).real)
    assert np.sqrt(np.array(rows[:3], dtype=float)) == pytest.approx(np.sqrt(values), rel=1e-3)


def test_tendons_and_inertia_of_the_mujoco_model_make_k_d_and_m(fit) -> None:
    model = ElementTree.fromstring(exported(fit, "mjcf"))
    found = {"k": np.zeros((3, 3)), "d": np.zeros((3, 3))}
    for tendon in model.find("tendon"):
        column = np.array([float(joint.get("coef")) for joint in tendon])
        assert [joint.get("joint") for joint in tendon] == ["y", "alpha", "gamma"]
        found[tendon.get("name")[0]] += np.outer(column, column)
    for letter, matrix in (("k", fit.stiffness), ("d", fit.damping)):
        size = np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))
        assert np.abs(found[letter] - matrix).max() < 1e-8 * size.max()
        assert np.all(np.abs(found[letter] - matrix) < 1e-8 * size)
    inertial = model.find("worldbody/body/inertial")
    mass = float(inertial.get("mass"))
    x, y, z = (float(value) for value in inertial.get("pos").split())
    xx, yy, zz, xy, xz, yz = (float(value) for value in inertial.get("fullinertia").split())
    about = [xx + mass * (y * y + z * z), yy + mass * (x * x + z * z), zz + mass * (x * x + y * y)]
    about += [xy - mass * x * y, yz - mass * y * z, xz - mass * x * z]
    again = matrix_from_parameters(np.array([mass, mass * x, mass * y, mass * z, *about]))
    assert np.allclose(again[np.ix_([1, 3, 5], [1, 3, 5])], fit.mass, rtol=1e-7, atol=1e-18)


def test_the_mujoco_model_needs_a_mass_of_six_degrees_of_freedom() -> None:
    with pytest.raises(FittingError) as caught:
        exported(fit_kd(paper_motion(0.01, 0, 40), M, KDOptions(bands=0)), "mjcf")
    assert caught.value.faults[0].thing == "the export mjcf"


def test_latex_and_methods_name_the_numbers(fit) -> None:
    assert r"\begin{pmatrix}" in exported(fit, "tex").decode()
    text = exported(fit, "methods").decode()
    assert "60 lines" in text
    assert "plane of the ligament" in text


def test_springs_need_the_paper_s_degrees_of_freedom() -> None:
    fit = fit_kd(paper_motion(0.01, 0, 40), M, KDOptions(bands=0))
    assert b"No masses" in exported(fit, "inp")
    one = fit_kd(six_dof_motion(0.01, 0, lines=40), six_dof_mass(), KDOptions(dof=("y",), bands=0))
    with pytest.raises(FittingError) as caught:
        exported(one, "inp")
    assert caught.value.faults[0].thing == "the export inp"
