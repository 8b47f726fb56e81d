"""Pages: every text is escaped, nothing is loaded from elsewhere."""

from __future__ import annotations

import base64
import hashlib
import re
from html import unescape

import numpy as np

from legacy.stapeskit.page import page
from legacy.stapeskit.page.foreign_markup import own_scripts
from legacy.stapeskit.page.numbers import plus_minus, printed
from legacy.stapeskit.page.page import Page, Section
from legacy.stapeskit.warnings import Notice

EVIL = '<script>alert("x")</script> & more'


def test_every_text_is_escaped(tmp_path):
    made = page.Page(EVIL, EVIL)
    made.section(
        EVIL,
        page.text(EVIL),
        page.subheading(EVIL),
        page.table([EVIL], [[EVIL]]),
        page.table([EVIL], [[EVIL]], words=True),
        page.notices([Notice(EVIL, EVIL)]),
        page.matrix([[1.0]], [EVIL], EVIL, [[0.1]], [[EVIL]]),
        page.image(b"x", EVIL, EVIL),
        page.folded(EVIL, page.text(EVIL)),
        page.inputs_table(
            {"inputs": {EVIL: {"file": EVIL, "size_bytes": 1, "modified": EVIL, "hash": EVIL}}}
        ),
    )
    made.section("two")
    made.section("three")
    made.write(tmp_path / "p.html")
    html = (tmp_path / "p.html").read_text(encoding="utf-8")
    assert html.count("<script") == 1  # the page's own
    assert html.count("&lt;script&gt;") >= 18
    assert "http" not in html.replace("http-equiv", "")


def test_no_warning_is_said():
    assert "No warnings" in page.notices([])


def test_figures_are_embedded():
    drawing = page.new_figure(2.0, 1.0)
    drawing.subplots().plot([0.0, 1.0])
    assert "data:image/svg+xml;base64," in page.figure(drawing, "caption", "alt")
    drawing = page.new_figure(2.0, 1.0)
    drawing.subplots().plot([0.0, 1.0])
    assert "data:image/png;base64," in page.figure(drawing, "caption", "alt", vector=False)


def test_matrix_shows_values_and_deviations():
    html = page.matrix(np.diag([1.5, 2.5]), ["y", "alpha"], "M", np.full((2, 2), 0.1))
    assert "1.5" in html
    assert "± 0.1" in html


def test_matrix_writes_no_deviation_beside_a_zero_of_the_pattern():
    html = page.matrix(np.diag([1.5, 2.5]), ["y", "alpha"], "M", np.diag([0.1, 0.2]))
    assert "± 0.1" in html
    assert "± 0<" not in html


def test_values_are_written_to_the_second_digit_of_their_deviation():
    assert plus_minus(1736.4, 17.2) == "1736 ± 17"
    assert plus_minus(3.0531e-08, 7.2e-10) == "(3.053 ± 0.072)·10⁻⁸"
    assert plus_minus(2.5, None) == "2.5 ± unknown"


def test_messages_have_the_letters_of_a_page():
    text = "0.2 urad enter per nm, 14 um off, factor 1.08 +- 0.01; give --density RHO+-SD, x_um, a volume"
    assert printed(text) == (
        "0.2 µrad enter per nm, 14 µm off, factor 1.08 ± 0.01; give --density RHO+-SD, x_um, a volume"
    )
    assert "1.08 ± 0.01" in page.notices([Notice("channel_gain", text)])


def test_units_have_one_notation():
    text = "2.3 mm3 of 1900 kg/m3, 5 mg mm2, 1e-12 kg m2, 9.8 m/s2; m2, mode 3, mm30"
    assert printed(text) == "2.3 mm³ of 1900 kg/m³, 5 mg mm², 1e-12 kg m², 9.8 m/s²; m2, mode 3, mm30"


def test_a_column_without_a_name_has_no_empty_heading():
    html = page.table(["", "x"], [["a", "1"]])
    assert "<thead><tr><td></td>" in html
    assert re.findall(r"<th .*?>(.*?)</th>", html) == ["x"]


def test_sections_are_linked_by_their_keys():
    made = Page("t")
    made.section("one")
    made.sections.append(Section("two", key="second"))
    made.section("three")
    html = made.html()
    assert re.findall(r'<section id="(\w+)"', html) == ["s1", "second", "s3"]
    assert re.findall(r'<a href="#(\w+)"', html) == ["s1", "second", "s3"]


def test_groups_make_a_navigation_at_the_side():
    made = Page(
        "t", sections=[Section("one", group="A"), Section("two", group="A"), Section("three", group="B")]
    )
    html = made.html()
    assert re.findall(r'<h2 class="group">(\w+)</h2>', html) == ["A", "B"]
    navigation = html.partition("<nav")[2].partition("</nav>")[0]
    assert re.findall(r'<a href="#(\w+)"', navigation) == ["s1", "s2", "s3"]
    assert re.findall(r"<b>(\w+)</b>", navigation) == ["A", "B"]


def test_no_line_breaks_inside_a_number():
    html = page.table(["", "x"], [["a", "about 3.433e-09 kg and 2.5"]], words=True)
    assert '<span class="n">3.433e-09</span>' in html
    html = page.table(["", "x"], [["a", "(1.38 ± 0.03)·10⁻³ N m, 1734 ± 17 N/m"]], words=True)
    assert re.findall(r'<span class="n">(.*?)</span>', html) == ["(1.38 ± 0.03)·10⁻³", "1734 ± 17 N/m"]
    assert "&lt;" in page.table(["", "x"], [["a", "<3.4e-09>"]], words=True)


def test_a_page_forbids_itself_the_network():
    html = Page("title").html()
    policy = html.partition('Content-Security-Policy" content="')[2].partition('">')[0]
    assert "default-src &#39;none&#39;" in policy
    assert "http" not in policy


def test_a_page_runs_the_scripts_of_this_program_alone(tmp_path):
    made = Page("title")
    made.section("own", page.with_script(page.text("x"), "", "slices-data", "{}", own_scripts()[0]))
    html = made.html()
    policy = unescape(html.partition('Content-Security-Policy" content="')[2].partition('">')[0])
    allowed = policy.partition("script-src ")[2].split()
    scripts = re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    assert len(scripts) == 2
    for script in scripts:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in allowed
    assert all(entry.startswith("'sha256-") for entry in allowed)


def test_names_of_no_utf8_do_not_stop_a_page(tmp_path):
    Page("b\udcff.tif", "").write(tmp_path / "a.html")
    assert "b?.tif" in (tmp_path / "a.html").read_text(encoding="utf-8")
