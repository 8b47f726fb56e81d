"""Tables and curves of the page, from the files that the steps leave."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

from app.job import TITLES

if TYPE_CHECKING:
    from pathlib import Path

    import altair

Row = dict[str, str]
_NAMES = {"found": "as found", "cut": "corrected"}


def html_table(rows: Sequence[Row]) -> str:
    """Return rows as an HTML table; every cell is escaped."""
    if not rows:
        return ""
    head = "".join(f"<th>{escape(name)}</th>" for name in rows[0])
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row.values()) + "</tr>" for row in rows
    )
    return f'<table class="results"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'


def mass_rows(masses: Mapping[str, Mapping[str, Any]]) -> list[Row]:
    """Return mass, volume and moments of the cut as found and of the corrected one, each with its sd."""
    rows = []
    for name, mass in masses.items():
        matrix, sd = (mass["mass_matrix"].get(key) for key in ("matrix_si", "standard_deviation_si"))

        def entry(at: int, factor: float, digits: int, matrix: Any = matrix, sd: Any = sd) -> str:
            return _with_sd(factor * matrix[at][at], None if sd is None else factor * sd[at][at], digits)

        rows.append(
            {
                "cut": _NAMES[name],
                "mass, mg": entry(0, 1e6, 4),
                "volume, mm³": f"{1e9 * mass['volume_m3']:.5f}",
                "M(alpha), mg mm²": entry(3, 1e12, 4),
                "M(beta), mg mm²": entry(4, 1e12, 4),
                "M(gamma), mg mm²": entry(5, 1e12, 4),
            }
        )
    return rows


def _with_sd(value: float, sd: float | None, digits: int) -> str:
    return f"{value:.{digits}f}" + ("" if sd is None else f" ± {sd:.{digits}f}")


def beam_rows(points: Mapping[str, Any]) -> list[Row]:
    """Return every beam with its verdict."""
    return [
        {
            "body": beam["body"],
            "point": beam["point"],
            "beam": beam["beam"],
            "verdict": beam["verdict"],
            "estimate": beam["estimate"],
            "residual, µm": f"{beam['residual_um']:.3g}",
        }
        for beam in points["beams"]
    ]


def registration_text(points: Mapping[str, Any]) -> str:
    """Return how well the fiducials fit, and which one worst."""
    count = len({(beam["body"], beam["point"]) for beam in points["beams"]})
    if points["rms_um"] is None:
        return f"{count} points; no fiducials tie them to the scan."
    name, worst = max(points["fiducials"].items(), key=lambda pair: pair[1])
    return (
        f"{count} points laid into the scan; the fiducials fit within {points['rms_um']:.0f} µm rms, worst "
        f"{name} with {worst:.0f} µm."
    )


def repeat_html(out: Path, study: Path) -> str:
    """Return where all results are, and the command that makes them again."""
    words = escape(f"scan2kd {shlex.quote(str(study))}")
    return f'<p class="path">All results: <code>{escape(str(out))}</code>. Again: <code>{words}</code></p>'


def fit_rows(fit: Mapping[str, Any]) -> list[Row]:
    """Return K and D with sd and 95 % intervals."""
    return [
        {
            "": entry["entry"],
            "of": f"{entry['row']}, {entry['column']}",
            "value": f"{entry['value']:.5g} ± {entry['sd']:.2g}",
            "95 %": f"{entry['lower_95']:.5g} to {entry['upper_95']:.5g}",
            "unit": entry["unit"],
        }
        for entry in fit["entries"]
    ]


def verdict_html(verdict: Mapping[str, Any]) -> str:
    """Return the verdict with its reasons; confirmed ones are named."""
    level = {"believe": "", "check": "check"}.get(verdict["level"], "no")
    reasons = "".join(
        f"<li><code>{escape(one['code'])}</code> {escape(one['text'])}</li>" for one in verdict["reasons"]
    )
    confirmed = (
        f"<p>Checked by you: {escape(', '.join(verdict['confirmed']))}</p>" if verdict["confirmed"] else ""
    )
    return (
        f'<div class="verdict {level}"><b>{escape(verdict["sentence"])}</b>'
        f"{f'<ul>{reasons}</ul>' if reasons else ''}{confirmed}</div>"
    )


def folded(title: str, content: str) -> str:
    """Return content that can be unfolded."""
    return f"<details><summary>{escape(title)}</summary>{content}</details>"


def notices_text(notices: Mapping[str, str]) -> str:
    """Return warnings by code as HTML that can be unfolded."""
    if not notices:
        return ""
    items = "".join(f"<li><code>{escape(code)}</code> {escape(text)}</li>" for code, text in notices.items())
    plural = "warning" if len(notices) == 1 else "warnings"
    return folded(f"{len(notices)} {plural}", f"<ul>{items}</ul>")


def done_text(step: str, seconds: float) -> str:
    """Return that a step has ended."""
    return f"{TITLES[step]}: done in {seconds:.0f} s."


def curves(fit: Mapping[str, Any]) -> list[altair.VConcatChart]:
    """Return a chart a motion: amplitude above phase, measured (dots) and fitted (lines), to be zoomed."""
    import altair as alt
    import pandas as pd

    parts = [pd.DataFrame({**row, "frequency, Hz": fit["freq_hz"]}) for row in fit["responses"]]
    table = pd.concat(parts, ignore_index=True)
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
