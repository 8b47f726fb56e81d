"""Tables and curves of the page, from the files that the steps leave; tables are those of the reports."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from stapeskit.report import page
from stapeskit.report.quantities import VOLUME, Quantity, matrix_units
from stapeskit.spatial import DOF_NAMES
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from markupsafe import Markup

_CUTS = {"found": "as found", "cut": "corrected"}
_SHOWN = {0: "mass", 3: "M(alpha)", 4: "M(beta)", 5: "M(gamma)"}
"""Places on the diagonal of the mass matrix."""
_SCHEMA = "https://vega.github.io/schema/vega-lite/v6.json"  # a name; nothing is asked for there


def mass_table(masses: Mapping[str, Mapping[str, Any]]) -> Markup:
    """Return mass, volume and moments of the cut as found and of the corrected one, each with its sd."""
    units, rows = matrix_units("M", DOF_NAMES), []
    for name, mass in masses.items():
        matrix, sd = (mass["mass_matrix"].get(key) for key in ("matrix_si", "standard_deviation_si"))
        entries = [Quantity(matrix[at][at], sd and sd[at][at], units[at][at]) for at in _SHOWN]
        rows.append((_CUTS[name], *entries, VOLUME.text(mass["volume_m3"], ".5f")))
    return page.table(("cut", *_SHOWN.values(), "volume"), rows)


def mark_table(placed: Mapping[str, Sequence[float]]) -> Markup:
    """Return every mark with its place."""
    rows = [(name, ", ".join(f"{value:.3f}" for value in at)) for name, at in placed.items()]
    return page.table(("mark", "scan x, y, z, mm"), rows, words=True)


def status(text: str, notices: Sequence[Notice] = ()) -> Markup:
    """Return a sentence, in which a file may have any name, with warnings to be unfolded."""
    shown = page.text(text)
    if not notices:
        return shown
    plural = "warning" if len(notices) == 1 else "warnings"
    return shown + page.folded(f"{len(notices)} {plural}", page.notices(notices))


class Curves:
    """A chart of one motion: amplitude above phase, measured (dots) and fitted (lines), to be zoomed."""

    def __init__(self, rows: Sequence[Mapping[str, Any]]) -> None:
        panels = [
            _panel("amplitude", rows[0]["motion"], {"type": "log"}),
            _panel("phase", "phase, °", {"zero": False}),
        ]
        self.specification = {"$schema": _SCHEMA, "data": {"values": list(rows)}, "vconcat": panels}

    def _mime_(self) -> tuple[str, str]:
        return "application/vnd.vegalite.v6+json", json.dumps(self.specification)


def _panel(what: str, title: str, scale: Mapping[str, Any]) -> dict[str, Any]:
    """Return one panel of a chart."""
    x = {"field": "frequency, Hz", "type": "quantitative", "scale": {"type": "log", "nice": False}}
    y = {"field": what, "type": "quantitative", "scale": scale, "title": title}
    marks = {"measured": {"type": "circle", "size": 12, "color": "#555555", "tooltip": {"content": "data"}},
             "fitted": {"type": "line", "color": "#d55e00"}}  # fmt: skip
    layers: list[dict[str, Any]] = [
        {"transform": [{"filter": f"datum.kind == '{kind}'"}], "mark": mark} for kind, mark in marks.items()
    ]
    layers[0]["params"] = [{"name": what, "select": "interval", "bind": "scales"}]
    return {"width": 220, "height": 140, "encoding": {"x": x, "y": y}, "layer": layers}


def curves(rows: Sequence[Mapping[str, Any]]) -> list[Curves]:
    """Return a chart a motion."""
    motions = dict.fromkeys(row["motion"] for row in rows)
    return [Curves([row for row in rows if row["motion"] == motion]) for motion in motions]
