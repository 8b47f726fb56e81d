"""Check that stored HTML can come from this program: nothing in it loads, sends or runs foreign code."""

from __future__ import annotations

from functools import cache
from html.parser import HTMLParser
from pathlib import Path

# Elements whose content browsers read as Python does: none of SVG or MathML, none of text that ends at a tag.
_ELEMENTS = frozenset(
    (
        *("a", "b", "br", "button", "canvas", "code", "details", "div", "em", "figcaption", "figure", "h3"),
        *("i", "img", "input", "label", "li", "ol", "option", "output", "p", "pre", "script", "select"),
        *("small", "span", "strong", "style", "sub", "summary", "sup", "table", "tbody", "td", "th", "thead"),
        *("tr", "ul"),
    )
)
_ADDRESSES = frozenset(
    ("action", "background", "data", "formaction", "href", "poster", "src", "srcset", "xlink:href")
)
_JSON = "application/json"


def foreign_markup(html: str) -> str:
    """Return what no page of this program holds, in a few words, or nothing.

    Elements must be those that pages are made of; scripts those of the packages, word for word; addresses
    places within the page or pictures that it holds. Comments, and a ``<`` in styles and data, are foreign:
    browsers end them elsewhere than this look does.
    """
    look = _Look()
    look.feed(html)
    look.close()
    return look.foreign


class _Look(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.foreign = ""
        self._script: list[str] | None = None
        self._raw = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            address = (value or "").strip()
            if name.startswith("on"):
                self.foreign = self.foreign or f"the attribute {name}"
            elif name in _ADDRESSES and not address.startswith(("#", "data:image/")):
                self.foreign = self.foreign or f"an address in {name}"
        if tag not in _ELEMENTS:
            self.foreign = self.foreign or f"the element {tag}"
        self._raw = tag in self.CDATA_CONTENT_ELEMENTS
        if tag == "script" and dict(attrs).get("type") != _JSON:
            self._script = []

    def handle_data(self, data: str) -> None:
        if self._script is not None:
            self._script.append(data)
        elif self._raw and "<" in data:
            self.foreign = self.foreign or "markup within a style or data"

    def handle_comment(self, data: str) -> None:
        self.foreign = self.foreign or f"a comment or declaration: {data[:20]}"

    def handle_decl(self, decl: str) -> None:
        self.handle_comment(decl)

    def handle_pi(self, data: str) -> None:
        self.handle_comment(data)

    def unknown_decl(self, data: str) -> None:
        self.handle_comment(data)

    def handle_endtag(self, tag: str) -> None:
        self._raw = False
        if tag == "script" and self._script is not None:
            if "".join(self._script).strip() not in map(str.strip, own_scripts()):
                self.foreign = self.foreign or "a script"
            self._script = None

    def close(self) -> None:
        """End the look; a script that does not end is foreign."""
        super().close()
        if self._script is not None:
            self.foreign = self.foreign or "a script"


@cache
def own_scripts() -> tuple[str, ...]:
    """Return the scripts of all pages."""
    root = Path(__file__).resolve().parents[2]
    rooms = ("stapeskit", "kinematics", "ct_inertia", "fitting", "pipeline")
    files = [path for room in rooms for path in sorted((root / room).rglob("*.js"))]
    return tuple(path.read_text(encoding="utf-8") for path in files)
