"""Figures and tables of a page as files."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from pipeline.figures import write_figures
from stapeskit.faults import StapeskitError
from stapeskit.page import page


@pytest.fixture
def made(tmp_path):
    sheet = page.Page("an ear")
    sheet.section(
        "Modes & axes",
        page.image(b"<svg/>", "caption", "a line", "svg"),
        page.matrix(np.diag([1.5, -2.0]), ["y", "alpha"], "K", np.full((2, 2), 0.25)),
        page.table(("name", "value"), [("=1+1", "50 %"), ("x_1", "3.0 ± 0.1")], words=True),
    )
    sheet.write(tmp_path / "kd.html")
    return tmp_path


def test_every_figure_and_table_becomes_a_file(made):
    files = {path.name: path for path in write_figures(made / "kd.html", made / "figures")}
    tables = [f"table_modes_axes_{k}.{kind}" for k in (1, 2) for kind in ("csv", "tex")]
    assert sorted(files) == sorted(["modes_axes_1.svg", *tables])
    assert files["modes_axes_1.svg"].read_bytes() == b"<svg/>"
    with files["table_modes_axes_1.csv"].open(encoding="utf-8-sig", newline="") as stream:
        rows = list(csv.reader(stream))
    assert rows == [["", "y", "alpha"], ["y", "1.5 ± 0.25", "0 ± 0.25"], ["alpha", "0 ± 0.25", "-2 ± 0.25"]]
    text = files["table_modes_axes_2.csv"].read_text(encoding="utf-8-sig")
    assert text.splitlines() == ["name,value", "'=1+1,50 %", "x_1,3.0 ± 0.1"]
    latex = files["table_modes_axes_2.tex"].read_text(encoding="utf-8")
    assert "x\\_1 & 3.0 $\\pm$ 0.1 \\\\" in latex
    assert "50 \\%" in latex


def test_a_second_run_replaces_its_own_files_alone(made):
    write_figures(made / "kd.html", made / "figures")
    write_figures(made / "kd.html", made / "figures")
    (made / "figures" / "modes_axes_1.svg").write_text("mine", encoding="utf-8")
    with pytest.raises(StapeskitError):
        write_figures(made / "kd.html", made / "figures")


@pytest.mark.parametrize("name", ["missing.html", "empty.html"])
def test_what_is_no_page_is_refused(tmp_path, name):
    (tmp_path / "empty.html").write_text("<p>nothing</p>", encoding="utf-8")
    with pytest.raises(StapeskitError) as caught:
        write_figures(tmp_path / name, tmp_path / "figures")
    assert caught.value.faults[0].thing == "the page"
