"""The command: files in, kd.json and kd.html out, faults in one sentence."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from legacy.fitting.cli import work
from legacy.fitting.errors import FittingError
from legacy.fitting.fit_files import fit_files
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.model.mass_file import read_mass
from legacy.fitting.options import KDOptions
from legacy.fitting.recorded_fit import footplate_outline
from legacy.fitting.report.at_a_glance import summary_rows
from legacy.fitting.report.kd_json import kd_json
from legacy.fitting.report.sections import kd_page, kd_sections, source_words
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.records.motion_files import write_motion
from legacy.stapeskit.spatial import dof_indices
from tests.fitting.cases import DOF, D, K, M, paper_motion, six_dof_mass, six_dof_motion

pytestmark = pytest.mark.usefixtures("undrawn")

KEYS = {
    "schema",
    "dof",
    "model",
    "estimator",
    "stiffness_si",
    "stiffness_sd_si",
    "damping_si",
    "damping_sd_si",
    "noise_only_sd_si",
    "covariance_si",
    "parameters",
    "budget",
    "stable",
    "max_real_eigenvalue_1_s",
    "passive",
    "modes",
    "overdamped_roots_1_s",
    "principal_axes",
    "fit",
    "identifiability",
    "warnings",
    "provenance",
}


def counted_motion(noise: float = 0.05, seed: int | None = 0):
    """A motion whose chi2 and n_dof are numbers, as points2dof writes it."""
    from dataclasses import replace

    motion = paper_motion(noise, seed)
    ones = np.ones_like(motion.chi2)
    return replace(motion, chi2=42.0 * ones, n_dof=42.0 * ones)


@pytest.fixture
def files(tmp_path: Path) -> Path:
    write_motion(tmp_path, "dof", counted_motion())
    np.savetxt(tmp_path / "M.csv", M, delimiter=",")
    return tmp_path


def test_command_writes_what_it_promises(files: Path, monkeypatch) -> None:
    monkeypatch.chdir(files)
    _, outcome = work(["dof.csv", "--mass", "M.csv", "--out", "new/kd.json"])
    content = json.loads((files / "new" / "kd.json").read_text(encoding="utf-8"))
    assert set(content) >= KEYS
    assert content["schema"] == "stapeskit.kd/1"
    assert content["dof"] == ["y", "alpha", "gamma"]
    assert content["parameters"][:3] == ["K11", "K12", "K13"]
    assert np.array(content["covariance_si"]).shape == (12, 12)
    gap = np.abs(np.array(content["stiffness_si"]) - K) / np.array(content["stiffness_sd_si"])
    assert gap.max() < 4.0
    assert content["stable"] is True
    assert content["passive"] == {"stiffness": True, "damping": True}
    assert [mode["frequency_hz"] for mode in content["modes"]] == pytest.approx(
        [1750.7, 2780.4, 3861.1], rel=0.005
    )
    assert {"shape_re", "shape_im", "normalisation", "undamped_frequency_hz", "damping_ratio"} <= set(
        content["modes"][0]
    )
    axes = content["principal_axes"]
    assert axes["origin_x_mm"] == pytest.approx(-0.279, abs=0.01)
    assert axes["angle_deg"] == pytest.approx(1.231, abs=0.6)
    assert content["fit"]["n_dof"] == 1188
    assert content["fit"]["chi2_per_dof"] == pytest.approx(1.0, abs=0.15)
    assert content["budget"]["channel_noise"]["K11"] == pytest.approx(content["stiffness_sd_si"][0][0])
    assert content["provenance"]["inputs"]["motion"]["file"] == "dof.csv"
    assert outcome.files == (Path("new/kd.json"), Path("new/kd.html"))
    assert len(outcome.rows) <= 15
    html = (files / "new" / "kd.html").read_text(encoding="utf-8")
    for words in (
        "Measured and simulated responses",
        "Principal axes",
        "Modes",
        "Residuals",
        "mass_uncertainty_not_given",
    ):
        assert words in html
    assert 'src="http' not in html


def test_exports_of_an_earlier_fit_do_not_stay_beside_a_new_one(files: Path) -> None:
    motion, mass, out = files / "dof.h5", files / "M.csv", files / "kd.json"
    fit_files(motion, mass, KDOptions(dof=DOF), out, export=("csv", "tex"))
    (files / "kd.mat").write_text("mine")
    fit_files(motion, mass, KDOptions(dof=DOF, robust="t4"), out, export=("tex",))
    assert not (files / "kd.entries.csv").exists()
    assert (files / "kd.tex").exists()
    assert (files / "kd.mat").read_text() == "mine"


def test_h5_and_csv_give_the_same(files: Path) -> None:
    first = fit_files(files / "dof.csv", files / "M.csv", KDOptions(), files / "a.json").fit
    second = fit_files(files / "dof.h5", files / "M.csv", KDOptions(), files / "b.json").fit
    assert first.stiffness == pytest.approx(second.stiffness, rel=1e-9)
    assert first.covariance == pytest.approx(second.covariance, rel=1e-6)


def test_exact_data_survive_the_files(tmp_path: Path) -> None:
    write_motion(tmp_path, "dof", counted_motion(1e-4, None))
    np.savetxt(tmp_path / "M.csv", M, delimiter=",", fmt="%.17g")
    for estimator in ("ml", "irls", "pinv", "constrained"):
        fit = fit_files(
            tmp_path / "dof.csv", tmp_path / "M.csv", KDOptions(estimator=estimator), tmp_path / "kd.json"
        ).fit
        root = np.sqrt(np.outer(np.diag(K), np.diag(K)))
        assert np.abs((fit.stiffness - K) / root).max() < 1e-6
        assert np.abs((fit.damping - D) / np.sqrt(np.outer(np.diag(D), np.diag(D)))).max() < 1e-6


def test_all_options_reach_the_fit(files: Path, monkeypatch) -> None:
    monkeypatch.chdir(files)
    line = "dof.h5 --mass M.csv --estimator constrained --constraint psd --lower K11=1750 --upper D11=0.03"
    _, outcome = work(
        [*line.split(), "--band", "500,4500", "--exclude", "990-1010", "--exclude", "2000-2100"]
    )
    parameters = outcome.result["provenance"]["parameters"]
    assert parameters["lower"] == {"K11": 1750.0}
    assert parameters["band_hz"] == [500.0, 4500.0]
    assert parameters["exclude_hz"] == [[990.0, 1010.0], [2000.0, 2100.0]]
    assert outcome.result["stiffness_si"][0][0] == pytest.approx(1750.0, rel=1e-4)
    assert "constraint_active" in {notice.code for notice in outcome.notices}


def test_config_file_gives_options(files: Path, monkeypatch) -> None:
    monkeypatch.chdir(files)
    (files / "o.toml").write_text(
        'mass = "M.csv"\nband = [500, 4000]\nexclude = ["990-1010"]\nrobust = "t4"\n'
    )
    _, outcome = work(["dof.csv", "--config", "o.toml"])
    assert outcome.result["provenance"]["parameters"]["robust"] == "t4"
    assert outcome.result["provenance"]["parameters"]["band_hz"] == [500.0, 4000.0]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("none.csv --mass M.csv", "none.csv"),
        ("dof.csv --mass none.json", "--mass must be an existing mass.json or M.csv; got none.json"),
        ("dof.csv --mass none.csv", "--mass must be an existing mass.json or M.csv; got none.csv"),
        (
            "dof.csv --mass M.csv --dof y,alpha",
            "M.csv must be 2 x 2 for --dof y,alpha, or 6 x 6; got 3 rows of 3 numbers",
        ),
        ("dof.csv --mass M.csv --dof y,roll", "--dof must be all, or a list of different names"),
        ("dof.csv --mass M.csv --structure incus", "the body must be one of stapes, base; got incus"),
        ("dof.csv --mass M.csv --base plate", "the body must be one of stapes, base; got plate"),
        ("dof.csv --mass M.csv --band 1,2", "the band must be one with measured lines of both bodies"),
        ("dof.csv --mass M.csv --band 0.4,5", "give --band in Hz, not in kHz."),
        (
            "dof.csv --mass M.csv --band 5000,400",
            "--band must be two frequencies in Hz, the lower first; got 5000,400. Write 400-5000.",
        ),
        ("dof.csv --mass M.csv --exclude 60-50", "Write 50-60."),
        ("dof.csv --mass M.csv --exclude 50-50", "Give two different frequencies in Hz"),
        ("dof.csv --mass M.csv --lower K11=5", "Choose an estimator that takes bounds, or leave them out."),
        (
            "dof.csv --mass M.csv --estimator constrained --lower Q9=3",
            "D33; got Q9. Count rows and columns in the order of --dof",
        ),
        (
            "dof.csv --mass M.csv --estimator constrained --lower K11=9 --upper K11=2",
            "--lower K11 must be below 2; got 9. Swap --lower and --upper of K11",
        ),
        (
            "dof.csv --mass M.csv --exclude 5",
            "--exclude must be a range of two frequencies in Hz, the lower first; got 5",
        ),
        (
            "dof.csv --mass M.csv --lower K11",
            "--lower must be an entry and a number in SI as K11=100",
        ),
        ("dof.csv --mass M.csv --inplane load", "--inplane load must be given with measured motion"),
        ("dof.csv --mass M.csv --out kd.txt", "ends with .json; got kd.txt. Write kd.json."),
        ("dof.csv", "--mass"),
        ("dof.csv --mass M.csv --estimater ml", "Did you mean --estimator?"),
        (
            "dof.csv --mass text.csv",
            'M.csv must be numbers separated by commas, without a header; got "gamma" '
            "(text.csv, row 2, column 3). Write SI numbers with decimal points",
        ),
        ("dof.csv --mass header.csv", "got y, alpha, gamma (header.csv, row 1). Remove the header."),
        (
            "M.csv --mass dof.csv",
            "It looks like the motion of points2dof: give that first, and mass.json or M.csv with --mass.",
        ),
        ("dof.csv --mass empty.csv", "got an empty cell (empty.csv, row 3, column 2)"),
        ("dof.csv --mass binary.csv", "--mass must be a text file of numbers or a mass.json"),
        ("dof.csv --mass negative.csv", "the diagonal of the mass matrix must be positive"),
    ],
)
def test_faults_are_one_sentence_and_leave_nothing(files: Path, monkeypatch, line: str, message: str) -> None:
    monkeypatch.chdir(files)
    (files / "text.csv").write_text("1,0,0\n0,1,gamma\n0,0,1\n")
    (files / "header.csv").write_text("y,alpha,gamma\n1,0,0\n0,1,0\n0,0,1\n")
    (files / "empty.csv").write_text("1,0,0\n\n0,,0\n0,0,1\n")
    (files / "binary.csv").write_bytes(b"\xff\xfe\x00\x81")
    np.savetxt(files / "negative.csv", -M, delimiter=",")
    before = sorted(path.name for path in files.iterdir())
    with pytest.raises(StapeskitError) as fault:
        work(line.split())
    assert message in str(fault.value)
    assert "\n" not in str(fault.value)
    assert sorted(path.name for path in files.iterdir()) == before


def test_help_is_quick_and_exit_codes_hold(files: Path) -> None:
    program = [sys.executable, "-c", "from fitting.cli import main; main()"]
    times = []
    for _ in range(3):
        start = sum(os.times()[2:4])
        done = subprocess.run(
            [*program, "--help"], capture_output=True, text=True, cwd=Path.cwd(), check=False
        )
        times.append(sum(os.times()[2:4]) - start)
        assert done.returncode == 0
        assert "--estimator" in done.stdout
    assert min(times) < 0.3
    done = subprocess.run(
        [*program, "none.csv", "--mass", "M.csv"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "Traceback" not in done.stderr


def test_mass_json_is_read_as_a_mass_matrix(tmp_path: Path) -> None:
    (tmp_path / "mass.json").write_text("{}")
    with pytest.raises(StapeskitError, match="schema"):
        read_mass(tmp_path / "mass.json", DOF)


def test_byte_order_mark_and_blank_lines_in_m_csv(tmp_path: Path) -> None:
    text = "\ufeff" + "\r\n".join(",".join(f"{value:.17g}" for value in row) for row in M) + "\r\n\r\n"
    (tmp_path / "M.csv").write_bytes(text.encode())
    matrix, record = read_mass(tmp_path / "M.csv", DOF)
    assert np.array_equal(matrix, M)
    assert record is None


def test_every_number_of_the_result_is_json(tmp_path: Path) -> None:
    """Enormous and undefined numbers become null, never NaN, which is no JSON."""
    mass, stiffness = np.diag(np.diag(M)), np.diag(np.diag(K))
    from sample_volumes.shaken_stapes import driven_base, simulated_motion
    from tests.fitting.cases import FREQ

    base = driven_base(FREQ, DOF, others=0.0)
    fit = fit_kd(simulated_motion(mass, stiffness, np.diag(np.diag(D)), DOF, FREQ, base, 0.02, None), mass)
    json.dumps(kd_json(fit, {}), allow_nan=False)


def test_page_of_six_degrees_of_freedom_several_runs_and_all_sources() -> None:
    from legacy.fitting.options import KDOptions as Options
    from legacy.stapeskit.spatial import DOF_NAMES
    from tests.fitting.cases import six_dof_parameters

    parameters = six_dof_parameters()
    mass = six_dof_mass({"density": 1e-4 * np.outer(parameters, parameters)})
    fit = fit_kd(six_dof_motion(0.02, 0, "xyz"), mass, Options(dof=DOF_NAMES))
    html = kd_page(fit, {"inputs": {}}).html()
    assert "Run 1." in html
    assert "Run 3." in html
    assert "mass matrix: density" in html
    assert "Principal axes" not in html
    assert any(row[0] == "worst combination" for row in summary_rows(fit))
    json.dumps(kd_json(fit, {}), allow_nan=False)


def test_page_compares_damping_laws_and_draws_the_outline() -> None:
    fit = fit_kd(paper_motion(), M, KDOptions(damping="compare"))
    angle = np.linspace(0.0, 2.0 * np.pi, 40)
    outline = np.column_stack([1.3 * np.cos(angle), 0.0 * angle, 0.6 * np.sin(angle)])
    keys = [section.key for section in kd_sections(fit, outline)]
    assert keys[:4] == ["responses", "stiffness_and_damping", "modes", "principal_axes"]
    text = "".join(str(block) for section in kd_sections(fit, outline) for block in section.blocks)
    assert "Damping laws compared" in text
    assert "over the footplate&#39;s outline" in text
    assert footplate_outline(None) is None


def test_outline_comes_from_mass_json() -> None:
    from types import SimpleNamespace

    ring = [[1.0, 0.1, 0.0], [0.0, 0.1, 0.5], [-1.0, 0.0, 0.0]]
    for raw, there in (({"found": {"footplate_outline_in_footplate_mm": ring}}, True), ({}, False)):
        assert (footplate_outline(SimpleNamespace(raw=raw)) is not None) == there


def test_sources_have_words() -> None:
    assert source_words("channel_noise") == "channel noise"
    assert source_words("mass.voxel_size") == "mass matrix: voxel size"
    assert source_words("beam_directions") == "beam directions"


def test_out_must_be_json(files: Path) -> None:
    with pytest.raises(FittingError, match=r"ends with \.json"):
        fit_files(files / "dof.csv", files / "M.csv", KDOptions(), files / "kd.csv")


def test_every_word_in_m_csv_is_reported_at_once_and_its_header_in_one_sentence(tmp_path: Path) -> None:
    for first, sentences in (("y,alpha,gamma", 1), ("1,alpha,gamma", 2)):
        (tmp_path / "M.csv").write_text(first + "\n" + "1,0,0\n" * 2)
        with pytest.raises(FittingError) as fault:
            read_mass(tmp_path / "M.csv", DOF)
        assert len(str(fault.value).splitlines()) == sentences


@pytest.mark.parametrize("mark", [";", "\t"])
def test_m_csv_with_decimal_commas_is_read(tmp_path: Path, mark: str) -> None:
    text = "\r\n".join(mark.join(f"{value:.17g}".replace(".", ",") for value in row) for row in M)
    (tmp_path / "M.csv").write_text(text)
    assert np.array_equal(read_mass(tmp_path / "M.csv", DOF)[0], M)


def test_motion_whose_load_is_not_known_is_told() -> None:
    """A matrix of --dof alone cannot carry the motion of the other degrees of freedom; a whole one does."""
    motion, whole = six_dof_motion(0.01, 0), six_dof_mass().matrix
    chosen = dof_indices(DOF)
    codes = [
        {notice.code for notice in fit_kd(motion, mass, KDOptions(inplane=inplane)).notices}
        for mass, inplane in (
            (whole[np.ix_(chosen, chosen)], "auto"),
            (whole[np.ix_(chosen, chosen)], "ignore"),
            (whole, "auto"),
        )
    ]
    assert ["inplane_mass_not_given" in found for found in codes] == [True, False, False]


def test_a_plain_mass_of_six_degrees_of_freedom_gives_what_mass_json_gives(tmp_path: Path) -> None:
    """With M of three the load of the motion in the plane is left out, and K was 10 to 35 % off."""
    motion, mass = six_dof_motion(0.01, 0, lines=60), six_dof_mass()
    np.savetxt(tmp_path / "M6.csv", mass.matrix, delimiter=",", fmt="%.17g")
    plain, record = read_mass(tmp_path / "M6.csv", DOF)
    assert record is None
    found, wanted = (fit_kd(motion, each, KDOptions(bands=0)) for each in (plain, mass))
    assert found.ligament is not None
    assert found.stiffness == pytest.approx(wanted.stiffness, rel=1e-9, abs=1e-12)
    assert "inplane_mass_not_given" not in {notice.code for notice in found.notices}


def test_a_plain_mass_of_six_degrees_of_freedom_is_that_of_a_rigid_body(tmp_path: Path) -> None:
    matrix = six_dof_mass().matrix
    matrix[0, 0] *= 1.1  # another mass along x than along y
    np.savetxt(tmp_path / "M6.csv", matrix, delimiter=",", fmt="%.17g")
    with pytest.raises(FittingError, match=r"rigid body .* \(M6\.csv\)"):
        read_mass(tmp_path / "M6.csv", DOF)
    with pytest.raises(FittingError, match="rigid body"):
        fit_kd(six_dof_motion(0.01, 0, lines=20), matrix, KDOptions(bands=0))
