"""Figures and tables of a page as files."""

from __future__ import annotations

import base64
import csv
import io
import os
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure

from legacy.pipeline.figure_files import write_figures
from legacy.pipeline.figure_pdf import figure_pdf, replayed
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.page import page

EXPONENTIAL = (
    b'<svg xmlns="http://www.w3.org/2000/svg" xmlns:x="http://www.w3.org/1999/xlink" viewBox="0 0 9 9"><defs>'
    + b"".join(
        b'<g id="a%d"><use x:href="#a%d"/><use x:href="#a%d"/></g>' % (k, k + 1, k + 1) for k in range(40)
    )
    + b'<g id="a40"/></defs><use x:href="#a0"/></svg>'
)


def drawing():
    """Lines, dashes, areas, markers, text and clipped curves."""
    made = Figure(figsize=(4.0, 3.0))
    axes = made.add_subplot()
    x = np.linspace(0.0, 3.0, 40)
    axes.plot(x, np.sin(3.0 * x), "o-", markersize=4.0)
    axes.plot(x, 2.0 * np.cos(x), "--", alpha=0.5)
    axes.fill_between(x, -0.5, 0.2 * x, color="C2", alpha=0.3)
    axes.set(ylim=(-1.0, 1.2), xlabel="frequency (kHz)", ylabel="α µm")
    return made


def _svg(made):
    stream = io.BytesIO()
    made.savefig(stream, format="svg")
    return stream.getvalue()


def _grey(made):
    stream = io.BytesIO()
    made.savefig(stream, format="rgba", dpi=72)
    return np.frombuffer(stream.getvalue(), np.uint8).reshape(216, 288, 4)[:, :, :3].mean(axis=2)


def _coarse(grey):
    return grey.reshape(36, 6, 48, 6).mean(axis=(1, 3))


@pytest.fixture
def made(tmp_path):
    sheet = page.Page("an ear")
    sheet.section(
        "Modes & axes",
        page.image(_svg(drawing()), "caption", "a line", "svg"),
        page.matrix(np.diag([1.5, -2.0]), ["y", "alpha"], "K", np.full((2, 2), 0.25)),
        page.table(("name", "value"), [("=1+1", "50 %"), ("x_1", "3.0 ± 0.1")], words=True),
    )
    sheet.write(tmp_path / "kd.html")
    return tmp_path


def test_every_figure_and_table_becomes_a_file(made):
    files = {path.name: path for path in write_figures(made / "kd.html", made / "figures")}
    tables = [f"table_modes_axes_{k}.{kind}" for k in (1, 2) for kind in ("csv", "tex")]
    assert sorted(files) == sorted(["modes_axes_1.svg", "modes_axes_1.pdf", *tables])
    assert files["modes_axes_1.svg"].read_bytes().startswith(b"<?xml")
    assert files["modes_axes_1.pdf"].read_bytes().startswith(b"%PDF")
    with files["table_modes_axes_1.csv"].open(encoding="utf-8-sig", newline="") as stream:
        rows = list(csv.reader(stream))
    assert rows == [
        ["", "y", "alpha"],
        ["y", "1.50 ± 0.25", "0.00 ± 0.25"],
        ["alpha", "0.00 ± 0.25", "-2.00 ± 0.25"],
    ]
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


def test_a_figure_is_drawn_anew_as_it_was():
    again = replayed(ElementTree.fromstring(_svg(drawing())))
    difference = np.abs(_coarse(_grey(drawing())) - _coarse(_grey(again)))
    assert np.max(difference) < 40.0  # of 255: lines are not shifted to whole pixels
    assert np.max(np.abs(_coarse(_grey(drawing())) - 255.0)) > 80.0


def test_a_figure_as_pdf_holds_no_date_and_pictures_too():
    content = _svg(drawing())
    assert figure_pdf("svg", content) == figure_pdf("svg", content)
    stream = io.BytesIO()
    drawing().savefig(stream, format="png", dpi=130)
    assert b"/Width 520" in figure_pdf("png", stream.getvalue())


def test_a_figure_that_no_command_drew_is_refused(tmp_path):
    sheet = page.Page("an ear")
    sheet.section("one", page.image(b"<svg/>", "caption", "a line", "svg"))
    sheet.write(tmp_path / "kd.html")
    with pytest.raises(StapeskitError, match="a figure must be one that a command drew"):
        write_figures(tmp_path / "kd.html", tmp_path / "figures")


def _sheet(picture):
    return f'<h2>{"long " * 200}</h2><img src="data:image/{picture}"><table>{"<tr><td>-1+1|cmd" * 3}</table>'


@pytest.mark.parametrize(
    "picture",
    [
        *("png;base64,A", "png;base64,AAAA", "svg+xml;base64,PHN2Zz4=", "png;base64,é"),
        "svg+xml;base64," + base64.b64encode(b"<a>" * 5000 + b"</a>" * 5000).decode(),
        "svg+xml;base64," + base64.b64encode(EXPONENTIAL).decode(),
    ],
)
def test_a_damaged_figure_is_refused(picture, tmp_path):
    (tmp_path / "kd.html").write_text(_sheet(picture), encoding="utf-8")
    with pytest.raises(StapeskitError):
        write_figures(tmp_path / "kd.html", tmp_path / "figures")
    assert not (tmp_path / "figures").exists()


def test_pipes_and_odd_declarations_are_no_pages(tmp_path):
    os.mkfifo(tmp_path / "pipe.html")
    (tmp_path / "odd.html").write_text("<![if x [ <!DOCTYPE <![CDATA[ <!--", encoding="utf-8")
    for name in ("pipe.html", "odd.html", ""):
        with pytest.raises(StapeskitError):
            write_figures(tmp_path / name, tmp_path / "figures")


def test_long_headings_and_cells_that_call_something(tmp_path):
    (tmp_path / "kd.html").write_text(_sheet("gif;base64,AAAA"), encoding="utf-8")
    table, _ = write_figures(tmp_path / "kd.html", tmp_path / "figures")
    assert len(table.name) < 130
    assert table.read_text(encoding="utf-8-sig").splitlines() == ["'-1+1|cmd"] * 3
