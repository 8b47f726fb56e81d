"""Look whether stored HTML can be of this program: nothing in it loads, sends or runs foreign code."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

_FORBIDDEN = frozenset(
    (
        *("applet", "base", "embed", "form", "frame", "frameset", "iframe", "link", "meta", "noscript"),
        *("object", "portal", "template"),
    )
)
_ADDRESSES = frozenset(
    ("action", "background", "data", "formaction", "href", "poster", "src", "srcset", "xlink:href")
)
_JSON = "application/json"


def foreign_markup(html: str) -> str:
    """Return what no page of this program holds, in a few words, or nothing.

    Scripts must be those of the packages, word for word; addresses must be places within the page or pictures
    that it holds.
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

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            address = (value or "").strip()
            if name.startswith("on"):
                self.foreign = self.foreign or f"the attribute {name}"
            elif name in _ADDRESSES and not address.startswith(("#", "data:image/")):
                self.foreign = self.foreign or f"an address in {name}"
        if tag in _FORBIDDEN:
            self.foreign = self.foreign or f"the element {tag}"
        if tag == "script" and dict(attrs).get("type") != _JSON:
            self._script = []

    def handle_data(self, data: str) -> None:
        if self._script is not None:
            self._script.append(data)

    def handle_endtag(self, tag: str) -> None:
        if tag == "script" and self._script is not None:
            if "".join(self._script).strip() not in _own_scripts():
                self.foreign = self.foreign or "a script"
            self._script = None

    def close(self) -> None:
        """End the look; a script that does not end is foreign."""
        super().close()
        if self._script is not None:
            self.foreign = self.foreign or "a script"


def _own_scripts() -> set[str]:
    root = Path(__file__).resolve().parents[2]
    rooms = ("stapeskit", "kinematics", "ct_inertia", "fitting", "pipeline")
    files = [path for room in rooms for path in (root / room).rglob("*.js")]
    return {path.read_text(encoding="utf-8").strip() for path in files}
