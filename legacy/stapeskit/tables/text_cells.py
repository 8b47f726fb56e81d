"""Text in CSV files that people open in a spreadsheet."""

from __future__ import annotations

_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def as_text_cell(text: object) -> str:
    """Return a text that no spreadsheet takes for a formula: an apostrophe before what begins one.

    Numbers stay as they are; everything else that begins with ``=``, ``+``, ``-``, ``@``, a tab or a return
    gets the apostrophe (OWASP, "CSV Injection").
    """
    shown = str(text)
    if not shown.startswith(_FORMULA):
        return shown
    try:
        float(shown)
    except ValueError:
        return f"'{shown}"
    return shown


def from_text_cell(cell: str) -> str:
    """Return the text that `as_text_cell` made a cell of."""
    text = cell[1:]
    return text if cell.startswith("'") and as_text_cell(text) == cell else cell
