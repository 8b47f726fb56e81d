"""What is stored of a page is taken back only when it can be of this program."""

from __future__ import annotations

import pytest

from legacy.stapeskit.page import page
from legacy.stapeskit.page.foreign_markup import foreign_markup


@pytest.mark.parametrize(
    "html",
    [
        "<script>alert(1)</script>",
        "<SCRIPT src=x></SCRIPT>",
        "<script>never ended",
        '<img src="x.png" onerror="alert(1)">',
        '<svg><g onload="alert(1)"></g></svg>',
        '<img src="http://example.org/x.png">',
        '<a href="javascript:alert(1)">x</a>',
        '<a href=" java\nscript:alert(1)">x</a>',
        '<svg><a xlink:href="javascript:alert(1)">x</a></svg>',
        '<iframe srcdoc="x"></iframe>',
        '<object data="x"></object>',
        '<meta http-equiv="refresh" content="0;url=x">',
        '<base href="http://example.org">',
        '<form action="http://example.org"><input></form>',
        '<link rel="stylesheet" href="x.css">',
        # what browsers read as elements, and Python's reader as text
        "<!--><b>-->",
        "<svg><style><b></style></svg>",
        "<style><b></style>",
        "<math><mtext></mtext></math>",
        "<textarea><!--</textarea><b>-->",
        '<script type="application/json"></script x><b></script>',
        "<![CDATA[><b>]]>",
        "<?x ><b>?>",
        "<!doctype html>",
    ],
)
def test_what_loads_sends_or_runs_is_foreign(html):
    assert foreign_markup(f"<p>text</p>{html}<p>more</p>")


def test_own_blocks_are_known():
    blocks = [
        page.text("a < b & c"),
        page.template("<table><tr><td>{{ v }}</td></tr></table>", v="<script>"),
        page.template('<a href="#s1">x</a><img src="data:image/png;base64,AAAA" alt="x">'),
    ]
    assert [foreign_markup(str(block)) for block in blocks] == ["", "", ""]


def test_own_scripts_are_known_word_for_word():
    from legacy.kinematics.report.animation import _part

    code = _part("motion.js")
    own = page.with_script(page.text("x"), "p {}", "data", '{"a": "</script>"}', code)
    assert foreign_markup(str(own)) == ""
    changed = page.with_script(page.text("x"), "p {}", "data", "{}", code + "\nalert(1)")
    assert foreign_markup(str(changed)) == "a script"
