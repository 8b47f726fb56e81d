"""What was found of the stapes, next to published sizes: the first section of the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from legacy.ct_inertia.mass.budget import mass_sd_missing
from legacy.ct_inertia.mass.published_sizes import NAMES, shown
from legacy.stapeskit.page import page
from legacy.stapeskit.page.quantities import LENGTH, MASS, SMALL_LENGTH, VOLUME


def mass_words(content: Mapping[str, Any]) -> str:
    """Return the mass with its standard deviation, or with the reason why it has none.

    Parameters
    ----------
    content : mapping
        Of mass.json.
    """
    missing = mass_sd_missing(content)
    if missing:
        return f"{MASS.text(content['mass_kg'], '.3g')} ({missing})"
    return MASS.with_sd(content["mass_kg"], content["uncertainty"]["total"]["mass_kg"])


def found_section(content: Mapping[str, Any]) -> page.Section:
    """Return sizes, mass and centre of mass, and how far they lie from published ones."""
    stapes = content["found"]
    com = np.array(content["inertial_parameters"]["values_si"])
    com = LENGTH.of(com[1:4] / com[0])
    deviation = content["uncertainty"]["total"]
    com_sd = ", ".join(f"{SMALL_LENGTH.of(value):.2g}" for value in deviation["center_of_mass_m"])
    rows = [
        ("mass with what was added" if stapes["added_masses"] else "mass", mass_words(content)),
        ("density of the bone", f"{content['density_kg_m3']:.1f} kg/m³"),
        ("volume of the bone", VOLUME.text(content["volume_m3"], ".4f")),
        (
            "centre of mass, footplate axes",
            f"{com[0]:+.4f}, {com[1]:+.4f}, {com[2]:+.4f} mm (± {com_sd} µm)",
        ),
        ("height of the stapes", f"{stapes['height_mm']:.2f} mm"),
        ("length of the footplate", f"{stapes['footplate_length_mm']:.2f} mm"),
        ("width of the footplate", f"{stapes['footplate_width_mm']:.2f} mm"),
        (
            "medial face of the footplate",
            f"{stapes['footplate_area_mm2']:.3f} mm², "
            f"{stapes['footplate_flatness_rms_mm'] * 1e3:.0f} µm off its plane (rms)",
        ),
        ("gap around the footplate", gap_words(stapes)),
        ("holes through the body (a stapes has 1)", str(stapes["holes"])),
    ]
    for mass in stapes["added_masses"]:
        place = ", ".join(f"{value:g}" for value in mass["position_mm"])
        sd = f" ± {MASS.of(mass['sd_kg']):g}" if mass["sd_kg"] else ""
        value = f"{MASS.of(mass['mass_kg']):g}{sd} {MASS.symbol}"
        rows.append(("added mass", f"{value} at {place} (scan, mm)"))
    blocks = [page.table(("", "found"), rows, words=True)]
    compared = content.get("published") or []
    if compared:
        blocks += [
            page.subheading("Next to published human stapedes"),
            page.table(
                ("", "found", "published", "z", "reference"), [_compare(row) for row in compared], words=True
            ),
        ]
    return page.Section("What was found", blocks, "literature")


def gap_words(evidence: Mapping[str, Any]) -> str:
    """Return the gap between the footplate's rim and the bone around it, or that there is none."""
    if evidence.get("gap_mm") is None:
        return "not measured: no other bone along half of the rim, or too near for the blur"
    gap, sd, spread = (1e3 * evidence[key] for key in ("gap_mm", "gap_sd_mm", "gap_spread_mm"))
    return (
        f"{gap:.0f} ± {sd:.1f} µm (median along the {100.0 * evidence['gap_rim_share']:.0f} % of the rim "
        f"with bone opposite; sd along it {spread:.0f} µm)"
    )


def _compare(row: Mapping[str, Any]) -> tuple[str, ...]:
    name, unit = NAMES[row["quantity"]]
    value, mean = (shown(row["quantity"], row[key]) for key in ("value", "mean"))
    sd = "" if row["sd"] is None else f" ± {shown(row['quantity'], row['sd']):.3g}"
    number = f" (n = {row['n']})" if row["n"] else ""
    z = "" if row["z"] is None else f"{row['z']:+.1f}"
    unit = unit.replace("mm3", "mm³").replace("m3", "m³")
    return f"{name} ({unit})", f"{value:.4g}", f"{mean:.4g}{sd}{number}", z, row["reference"]
