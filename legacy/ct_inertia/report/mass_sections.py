"""Sections of the report on the ways to the mass, the surface as a cross-check, and what was exported."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.ct_inertia.mass.budget import mass_sd_missing
from legacy.ct_inertia.mass.mass_estimates import WORDS
from legacy.stapeskit.page import page
from legacy.stapeskit.page.numbers import plus_minus
from legacy.stapeskit.page.quantities import MASS, SMALL_LENGTH

if TYPE_CHECKING:
    from markupsafe import Markup

_METHOD = {
    "mass": "The mass of the bone is the one from the balance, spread evenly over its volume.",
    "density": "The mass is the density given times the volume, the same density everywhere.",
    "calibration": (
        "Every voxel is weighed by its own grey value: the calibration line turns it into a density, and the "
        "share of air in a voxel at the boundary weighs nothing."
    ),
}


def masses_section(content: Mapping[str, Any]) -> page.Section | None:
    """Compare the ways to a mass; None when only one was given."""
    others = content.get("mass_alternatives") or []
    if not others:
        return None
    lead = content["mass_known_by"]
    sd = content["uncertainty"]["total"]["mass_kg"]
    rows = [
        (
            f"{WORDS[lead]} (used)",
            _with_sd(content["mass_kg"], None if mass_sd_missing(content) else sd),
            f"{content['density_kg_m3']:.1f}",
            "",
            "",
            "",
        )
    ]
    for way in others:
        shift = SMALL_LENGTH.of(np.array(way["center_of_mass_change_m"]))
        diagonal = np.diag(np.array(way["matrix_change_percent"]))[3:]
        rows.append(
            (
                WORDS[way["by"]],
                _with_sd(way["mass_kg"], way["mass_sd_kg"] if way.get("mass_sd_stated") else None),
                f"{way['density_kg_m3']:.1f}",
                f"{way['mass_change_percent']:+.2f}",
                ", ".join(f"{value:+.1f}" for value in shift),
                ", ".join(f"{value:+.2f}" for value in diagonal),
            )
        )
    header = (
        "mass by",
        f"mass ({MASS.symbol})",
        "bone (kg/m³)",
        "Δ mass (%)",
        "Δ centre x, y, z (µm)",
        "Δ M(alpha), M(beta), M(gamma) (%)",
    )
    blocks = [page.text(_METHOD[lead]), page.table(header, rows)]
    blocks += [
        page.folded(
            f"Change of every entry of M by {WORDS[way['by']]}, in percent of √(Mii Mjj)",
            page.table(
                ("", *content["mass_matrix"]["dof"]),
                [
                    (name, *(f"{value + 0.0:+.3f}" for value in row))
                    for name, row in zip(
                        content["mass_matrix"]["dof"], way["matrix_change_percent"], strict=True
                    )
                ],
            ),
        )
        for way in others
    ]
    return page.Section("Ways to the mass", blocks, "ways_to_mass")


def _with_sd(mass_kg: float, sd_kg: float | None) -> str:
    """Return a mass with its standard deviation; None: it has none of its density, calibration or balance."""
    if sd_kg is None:
        return f"{MASS.of(mass_kg):.5g} (sd not stated)"
    return plus_minus(MASS.of(mass_kg), MASS.of(sd_kg))


def cross_check_section(content: Mapping[str, Any]) -> page.Section:
    """Compare the grey-value integral with the closed surface, and that with a second program."""
    check = content["cross_check"]
    section = page.Section("Cross-check", key="cross_check")
    if check["used"] != check["other"]:
        worst = float(np.max(np.abs(check["mass_matrix_difference_percent"])))
        rows = [
            ("stapes.ply", *_differences(check), f"{worst:.3f} %"),
        ]
        half = check.get("half_level")
        if half is not None:
            rows.append(("half way from air to bone", *_differences(half), ""))
        section.add(
            page.text(
                "The numbers used are integrals of grey values, in which a voxel half filled with bone "
                "counts half; they need no threshold. The surface in stapes.ply is shaped to have the same "
                "volume, centre and inertia. The surface at the half level is not: blur shrinks what is "
                "convex or thin there, by a few percent of the volume; more would speak for a wrong level."
            ),
            page.table(
                (
                    "surface against the grey-value integral",
                    "volume",
                    "centre of volume (scan, µm)",
                    "largest of M, of √(Mii Mjj)",
                ),
                rows,
            ),
        )
    section.add(page.text(_second_opinion(check["surface_by_pymeshlab"])))
    return section


def _differences(check: Mapping[str, Any]) -> tuple[str, str]:
    """Return the differences of volume and of the centre in words."""
    apart = np.array(check["centroid_difference_mm"]) * 1e3
    return f"{check['volume_difference_percent']:+.4f} %", ", ".join(f"{v:+.2f}" for v in apart)


def _second_opinion(opinion: Mapping[str, Any] | None) -> str:
    if opinion is None:
        return (
            "The surface was not checked by a second mesh library: pymeshlab or its GL libraries are missing "
            "here."
        )
    worst = max(abs(opinion["volume_difference"]), abs(opinion["inertia_difference"]))
    shape = "closed and two-manifold" if opinion["two_manifold"] else "NOT closed and two-manifold"
    return (
        f"Second opinion by pymeshlab: the surface is {shape}, of genus {opinion['genus']}; volume and "
        f"inertia of the surface agree with ours within {worst:.1e}."
    )


def files_blocks(content: Mapping[str, Any]) -> list[Markup]:
    """Return what to know of the display surface and of the exports; empty when there are none."""
    blocks = []
    shown = content.get("display_mesh")
    if shown:
        rows = [
            (
                f"{step['asked']} steps of Taubin smoothing" if step["step"] == "smooth" else "thinned out",
                f"{step['faces']}",
                f"{step['mass_change_percent']:+.4f}",
                f"{np.linalg.norm(step['center_of_mass_change_mm']) * 1e3:.2f}",
                f"{step['mass_matrix_change_percent']:.4f}",
            )
            for step in shown["steps"]
        ]
        blocks += [
            page.subheading("Surface for display"),
            page.text(
                f"{shown['file']} and the exports show a lighter surface. Measured on it, the numbers would "
                "change as follows; none of them was."
            ),
            page.table(("step", "faces", "mass (%)", "centre of mass (µm)", "M (%)"), rows),
        ]
    exports = content.get("exports")
    if exports:
        rows = [
            (name, *(units.get(key, "") for key in ("coordinates", "length", "mass", "inertia")))
            for name, units in exports.items()
        ]
        blocks += [
            page.subheading("Exports"),
            page.table(("format", "coordinates", "length", "mass", "inertia"), rows),
        ]
    return blocks
