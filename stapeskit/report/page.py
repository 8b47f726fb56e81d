"""Put together one self-contained HTML page: a title, a first screen, sections, a folded appendix.

``page.Page`` holds the blocks that ``page.text``, ``page.table``, ``page.matrix`` ... make. A page loads
nothing, needs no network, and can be read without its scripts.

Examples
--------
>>> from stapeskit.report import page
>>> shown = page.Page("An ear").add(page.verdict("believe", "No warning calls for a check."))
>>> section = shown.section("Stiffness K", page.matrix(("y",), [[1735.0]], [[19.0]]))
>>> shown.appendix_section("Inputs", page.text("scan.tif")).folded
True
>>> "1735" in shown.html()
True
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING

from stapeskit.report.blocks import (
    beside,
    cards,
    code,
    figure,
    folded,
    image,
    inputs,
    matrix,
    notices,
    render,
    subheading,
    table,
    text,
    to_base64,
    verdict,
    viewer,
)
from stapeskit.report.colours import PAGE_COLOURS

if TYPE_CHECKING:
    from markupsafe import Markup

__all__ = [
    "Page",
    "Section",
    "beside",
    "cards",
    "code",
    "figure",
    "folded",
    "image",
    "inputs",
    "matrix",
    "notices",
    "subheading",
    "table",
    "text",
    "verdict",
    "viewer",
]

_HERE = Path(__file__).parent
# Nothing is loaded from anywhere and nothing is sent; only the scripts of this project run.
_POLICY = (
    "default-src 'none'; base-uri 'none'; form-action 'none'; style-src 'unsafe-inline'; img-src data:; "
    "script-src {hashes}"
)


@dataclass
class Section:
    """A heading with its blocks.

    Attributes
    ----------
    name : str
        The heading.
    id : str
        What links refer to.
    folded : bool
        Whether the reader opens it.
    """

    name: str
    blocks: list[Markup]
    id: str
    folded: bool = False

    def add(self, *blocks: Markup) -> Section:
        """Append blocks and return the section."""
        self.blocks.extend(blocks)
        return self


@dataclass
class Page:
    """A page under construction.

    Attributes
    ----------
    title, lead : str
        Heading, and a sentence below it.
    first : list of Markup
        The first screen: verdict, summary, key matrices, a figure.
    sections, appendix : list of Section
        What follows, and what few readers open.
    """

    title: str
    lead: str = ""
    first: list[Markup] = field(default_factory=list)
    sections: list[Section] = field(default_factory=list)
    appendix: list[Section] = field(default_factory=list)

    def add(self, *blocks: Markup) -> Page:
        """Append blocks to the first screen and return the page."""
        self.first.extend(blocks)
        return self

    def section(self, name: str, *blocks: Markup, folded: bool = False) -> Section:
        """Append a section and return it."""
        return self._append(self.sections, name, blocks, folded)

    def appendix_section(self, name: str, *blocks: Markup) -> Section:
        """Append a folded section to the appendix and return it."""
        return self._append(self.appendix, name, blocks, True)

    def _append(self, part: list[Section], name: str, blocks: Iterable[Markup], folded: bool) -> Section:
        key = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") or "section"
        taken = {other.id for other in (*self.sections, *self.appendix)}
        own = next(one for one in chain([key], (f"{key}_{k}" for k in count(2))) if one not in taken)
        section = Section(name, list(blocks), own, folded)
        part.append(section)
        return section

    def html(self) -> str:
        """Return the whole page."""
        from markupsafe import Markup

        blocks = [*self.first, *(block for part in (*self.sections, *self.appendix) for block in part.blocks)]
        scripts = [str(render("script"))]
        if any("data-scene" in block for block in blocks):
            scripts.append((_HERE / "viewer.js").read_text(encoding="utf-8"))
        hashes = " ".join(f"'sha256-{to_base64(hashlib.sha256(one.encode()).digest())}'" for one in scripts)
        return str(
            render(
                "page",
                self.title,
                self.lead,
                self.first,
                self.sections,
                self.appendix,
                PAGE_COLOURS,
                _POLICY.format(hashes=hashes),
                [Markup(script) for script in scripts],
            )
        )

    def write(self, path: Path) -> None:
        """Write the page as UTF-8."""
        # Names of files may hold bytes that are no UTF-8.
        Path(path).write_text(self.html(), encoding="utf-8", errors="replace")
