"""Tables and curves of the page, from the files that the steps leave; tables are those of the reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from stapeskit.report import page
from stapeskit.report.quantities import VOLUME, Quantity, matrix_units
from stapeskit.spatial import DOF_NAMES
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    import altair
    from markupsafe import Markup

_CUTS = {"found": "as found", "cut": "corrected"}
_SHOWN = {0: "mass", 3: "M(alpha)", 4: "M(beta)", 5: "M(gamma)"}
"""Places on the diagonal of the mass matrix."""


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


def beam_table(measured: Mapping[str, Any]) -> Markup:
    """Return every beam with its verdict, to be unfolded."""
    head = ("body", "point", "beam", "verdict", "estimate", "residual, µm")
    rows = [(*words, f"{residual:.3g}") for *words, residual in measured["beams"]]
    return page.folded("beams", page.table(head, rows, words=True))


def registration_text(measured: Mapping[str, Any]) -> str:
    """Return how well the fiducials fit, and which one worst."""
    count = len({(body, point) for body, point, *_ in measured["beams"]})
    if measured["rms_um"] is None:
        return f"{count} points; no fiducials tie them to the scan."
    name, worst = max(measured["fiducials"].items(), key=lambda pair: pair[1])
    return (
        f"{count} points laid into the scan; the fiducials fit within {measured['rms_um']:.0f} µm rms, worst "
        f"{name} with {worst:.0f} µm."
    )


def notice_list(notices: Mapping[str, str]) -> Markup | str:
    """Return warnings by code, to be unfolded."""
    if not notices:
        return ""
    plural = "warning" if len(notices) == 1 else "warnings"
    return page.folded(f"{len(notices)} {plural}", page.notices(Notice(*pair) for pair in notices.items()))


def curves(responses: Mapping[str, Sequence[Any]]) -> list[altair.VConcatChart]:
    """Return a chart a motion: amplitude above phase, measured (dots) and fitted (lines), to be zoomed."""
    import altair as alt
    import pandas as pd

    table = pd.DataFrame(responses)
    x = alt.X("frequency, Hz", scale=alt.Scale(type="log", nice=False))
    columns = ["kind", "frequency, Hz", "amplitude", "phase"]

    def drawn(motion: str, what: str, title: str, scale: alt.Scale) -> Any:
        base = alt.Chart(table[table["motion"] == motion]).encode(x, alt.Y(what, scale=scale, title=title))
        dots = base.transform_filter("datum.kind == 'measured'").mark_circle(size=12, color="#555555")
        line = base.transform_filter("datum.kind == 'fitted'").mark_line(color="#d55e00")
        both = alt.layer(dots.encode(tooltip=columns), line.encode(tooltip=columns))
        return both.properties(width=220, height=140).interactive(name=f"{motion[0]}_{what}")

    return [
        drawn(motion, "amplitude", motion, alt.Scale(type="log"))
        & drawn(motion, "phase", "phase, °", alt.Scale(domain=[-180, 180]))
        for motion in dict.fromkeys(table["motion"])
    ]
