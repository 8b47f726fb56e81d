"""Pages as people meet them: on screens of three widths, on paper, by keyboard, and through axe-core."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright import sync_api

from ct_inertia.report.sections import mass_page
from fitting.report.page import kd_page
from kinematics.report.page import motion_page
from pipeline.compare import compare, compare_page
from pipeline.report import study_page
from pipeline.run import StudyResult
from tests.app.driven import CHROMIUM

pytestmark = [pytest.mark.browser, pytest.mark.filterwarnings("ignore")]

WIDTHS = (400, 900, 1600)
_GL = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


@pytest.fixture(scope="module")
def pages(finished: StudyResult, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    again = folder / "again"
    shutil.copytree(finished.out, again)
    made = {
        "report": study_page(finished),
        "mass": mass_page(finished.mass, finished.pictured),
        "dof": motion_page(finished.moved),
        "kd": kd_page(finished.fit),
        "compare": compare_page(compare(finished.out, again)),
    }
    for name, one in made.items():
        one.write(folder / f"{name}.html")
    return {name: folder / f"{name}.html" for name in made}


@pytest.fixture(scope="module")
def tab() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, headless=True, args=_GL)
        tab = browser.new_page()
        tab.set_default_timeout(90_000)
        yield tab
        browser.close()


def visit(tab: Any, path: Path, width: int, height: int = 1000) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    tab.goto(path.as_uri())
    tab.wait_for_timeout(500)


def unfold(tab: Any) -> None:
    tab.evaluate("document.querySelectorAll('details').forEach((fold) => { fold.open = true; })")
    tab.wait_for_timeout(200)


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", ["report", "mass", "dof", "kd", "compare"])
def test_nothing_is_cut_and_axe_core_finds_nothing(
    tab: Any, pages: dict[str, Path], name: str, width: int
) -> None:
    from axe_playwright_python.sync_playwright import Axe

    visit(tab, pages[name], width)
    unfold(tab)
    found = Axe().run(tab)
    assert found.violations_count == 0, found.generate_report()
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    cut = """Array.from(document.querySelectorAll(".scroll"))
        .filter((box) => box.scrollWidth > box.clientWidth + 1).map((box) => box.innerText.slice(0, 80))"""
    assert tab.evaluate(cut) == []


@pytest.mark.parametrize("size", [(1600, 1000), (900, 1200)])
def test_the_first_screen_holds_verdict_matrices_modes_and_rim(
    tab: Any, pages: dict[str, Path], size: tuple[int, int]
) -> None:
    visit(tab, pages["report"], *size)
    bottoms = tab.evaluate(
        """Object.fromEntries(Array.from(document.querySelectorAll("#verdict, .first p.title")).map((title) =>
        [title.innerText, (title.closest("figure") || title).getBoundingClientRect().bottom]))"""
    )
    words = " ".join(bottoms)
    for title in (
        "Verdict",
        "Stiffness K",
        "Damping D",
        "Mass M",
        "Modes",
        "Stiffness along the rim",
        "fitted",
    ):
        assert title in words
    assert max(bottoms.values()) <= size[1]


def test_everything_is_reached_by_keyboard(tab: Any, pages: dict[str, Path]) -> None:
    visit(tab, pages["report"], 1600)
    canvas = tab.locator("canvas.over")
    canvas.scroll_into_view_if_needed()
    seen: set[str] = set()
    for _ in range(200):
        tab.keyboard.press("Tab")
        at = tab.evaluate(
            """(() => { const at = document.activeElement; return at.tagName === "SUMMARY" ? at.innerText :
            at.tagName === "CANVAS" ? "canvas" : at.tagName === "BODY" ? "end" : ""; })()"""
        )
        if at == "canvas" and at not in seen:
            before = tab.locator("figure.scene .frame").screenshot()
            tab.keyboard.press("ArrowRight")
            tab.keyboard.press("ArrowRight")
            tab.wait_for_timeout(300)
            assert tab.locator("figure.scene .frame").screenshot() != before
        elif at not in ("", "end", "canvas") and at not in seen:
            tab.keyboard.press("Enter")
            assert tab.evaluate("document.activeElement.parentElement.open") is True
        seen.add(at)
        if at == "end":
            break
    names = tab.evaluate("Array.from(document.querySelectorAll('summary h2')).map((name) => name.innerText)")
    assert len(names) >= 5
    assert {"canvas", *names} <= seen


def test_the_report_prints_on_six_pages_without_its_appendix(tab: Any, pages: dict[str, Path]) -> None:
    visit(tab, pages["report"], 1600)
    hide = "section:has(> details > summary > h2) { display: none }"
    tab.add_style_tag(content=hide)
    paper = tab.pdf(prefer_css_page_size=True)
    assert 1 <= len(re.findall(rb"/Type\s*/Page\b", paper)) <= 6
