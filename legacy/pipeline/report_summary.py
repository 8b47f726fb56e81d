"""The top of the report: the verdict and the numbers that a reader looks for first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from legacy.ct_inertia.mass.budget import mass_sd_missing
from legacy.pipeline.verdict import BELIEVE, CHECK, DO_NOT_USE, Verdict
from legacy.stapeskit.page import page
from legacy.stapeskit.page.numbers import plus_minus, printed
from legacy.stapeskit.page.quantities import MASS, ShownUnit, diagonal_unit, si_unit

if TYPE_CHECKING:
    from markupsafe import Markup

Card = tuple[str, list[tuple[str, ...]]]
_KEYS = {"K": "stiffness", "D": "damping"}
_SENTENCES = {
    BELIEVE: "No warning calls for a check. The uncertainties hold what is known to go wrong.",
    CHECK: "The numbers are there; look at these points before you use them:",
    DO_NOT_USE: "Something is wrong that the uncertainties do not hold:",
}
_TEMPLATE = """<div class="verdict {{ css }}" id="verdict">
<strong>{{ level }}</strong> <span>{{ sentence }}</span>
{% if reasons %}<ul>{% for reason in reasons %}
<li>{% if reason.code %}<code>{{ reason.code }}</code> {% endif %}
<span class="short">{{ reason.text }}</span></li>{% endfor %}
</ul><a class="more" href="#warnings">the whole texts</a>{% endif %}</div>
<div class="cards" id="summary">{% for title, rows in cards %}<div><table><caption>{{ title }}</caption>
{% for row in rows %}<tr><th scope="row">{{ row[0] }}</th>{% for cell in row[1:] %}<td>
{%- for words in cell.split(", ") %}<span class="n">{{ words }}
{%- if not loop.last %},{% endif %}</span> {% endfor %}</td>{% endfor %}</tr>
{% endfor %}</table></div>{% endfor %}</div>"""


def key_results(mass: Mapping[str, Any], kd: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the numbers that a reader looks for first, each with its standard deviation."""
    return [(name, text) for _, rows in cards(mass, kd) for name, text, *_ in rows]


def cards(
    mass: Mapping[str, Any], kd: Mapping[str, Any], truth: Mapping[str, Any] | None = None
) -> list[Card]:
    """Return the groups of the summary: a title, and rows of name, value and, when known, the truth."""
    sd = None if mass_sd_missing(mass) else mass["mass_matrix"]["standard_deviation_si"][1][1]
    blocks: list[Card] = [
        ("Mass", [_row("mass", MASS, mass["mass_kg"], sd, None if truth is None else truth.get("mass_kg"))])
    ]
    exponent = kd["model"]["damping_exponent"]
    for letter, title in (("K", "Stiffness"), ("D", "Damping")):
        key = _KEYS[letter]
        rows: list[tuple[str, ...]] = []
        true = _true_matrix(truth, f"{key}_si", kd["dof"])
        for place, dof in enumerate(kd["dof"]):
            value, spread = (kd[f"{key}{end}"][place][place] for end in ("_si", "_sd_si"))
            known = None if true is None else true[place][place]
            rows.append(_row(f"{letter}({dof})", diagonal_unit(letter, dof, exponent), value, spread, known))
        blocks.append((title, rows))
    rows = []
    for place, mode in enumerate(kd["modes"]):
        frequency = plus_minus(mode["frequency_hz"], mode.get("frequency_sd_hz"))
        ratio = plus_minus(mode["damping_ratio"], mode.get("damping_ratio_sd"))
        rows.append((f"mode {place + 1}", f"{frequency} Hz, damping ratio {ratio}"))
    stable, passive = ("yes" if value else "NO" for value in (kd["stable"], all(kd["passive"].values())))
    blocks.append(("Modes", [*rows, ("stable; passive", f"{stable}; {passive}")]))
    return blocks


def axes_card(kd: Mapping[str, Any]) -> list[Card]:
    """Return where the principal axes of K lie on the footplate."""
    axes = kd.get("principal_axes")
    if not axes:
        return []
    rows: list[tuple[str, ...]] = [
        (f"origin {name}", f"{plus_minus(axes[f'origin_{name}_mm'], axes[f'origin_{name}_sd_mm'])} mm")
        for name in "xz"
    ]
    rows.append(("turned about y", f"{plus_minus(axes['angle_deg'], axes['angle_sd_deg'])}°"))
    return [("Principal axes of K", rows)]


def frame_card(mass: Mapping[str, Any]) -> list[Card]:
    """Return what x and z of the footplate point to, and by which statement, so that a wrong side shows."""
    frames = mass["frames"]
    by = str(frames.get("anterior_from") or "").removeprefix("--")
    rows: list[tuple[str, ...]] = [
        ("x", f"anterior, by {by}" if by else "along the footplate; anterior is not known"),
        ("y", "lateral, towards the head"),
    ]
    z_is, side = frames.get("z_is"), frames.get("side")
    rows.append(("z", f"{z_is}: stated as a {side} ear" if z_is and side else "x × y; the side is not known"))
    return [("Axes of the footplate", rows)]


def summary_block(
    mass: Mapping[str, Any], kd: Mapping[str, Any], results: Verdict, truth: Mapping[str, Any] | None
) -> Markup:
    """Return the verdict with its reasons and the key numbers in the units of people."""
    return page.template(
        _TEMPLATE,
        level=f"Verdict: {results.level}",
        css=results.level.replace(" ", "-"),
        sentence=_SENTENCES[results.level],
        reasons=[type(reason)(reason.level, reason.code, printed(reason.text)) for reason in results.reasons],
        cards=[*cards(mass, kd, truth), *axes_card(kd), *frame_card(mass)],
    )


def si_table(mass: Mapping[str, Any], kd: Mapping[str, Any]) -> Markup:
    """Return the same numbers in SI units, with every entry of K and D."""
    sd = mass["mass_matrix"]["standard_deviation_si"][1][1]
    shown = "" if mass_sd_missing(mass) else f"{sd:.2g}"
    rows: list[Sequence[object]] = [("m", f"{mass['mass_kg']:.6g}", shown, "kg")]
    exponent = kd["model"]["damping_exponent"]
    for letter, key in _KEYS.items():
        for i, first in enumerate(kd["dof"]):
            for j, second in enumerate(kd["dof"][i:], i):
                name = f"{letter}({first})" if i == j else f"{letter}({first}, {second})"
                value, spread = (kd[f"{key}{end}"][i][j] for end in ("_si", "_sd_si"))
                unit = si_unit(letter, first, second, exponent)
                rows.append((name, f"{value:.6g}", "" if spread is None else f"{spread:.2g}", unit))
    return page.folded("In SI units, every entry", page.table(("", "value", "sd", "unit"), rows))


def _row(name: str, unit: ShownUnit, value: float, sd: float | None, true: float | None) -> tuple[str, ...]:
    shown = unit.with_sd(value, sd)
    return (name, shown) if true is None else (name, shown, f"true {f'{unit.of(true):#.4g}'.rstrip('.')}")


def _true_matrix(truth: Mapping[str, Any] | None, key: str, dof: Sequence[str]) -> Any:
    if truth is None or list(truth.get("dof", ())) != list(dof):
        return None
    return truth.get(key)
