"""How the stapes was found, cut out and measured, in plain words for the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Row = tuple[str, str]

_SEPARATIONS = {
    "connected component": "Nothing touches it: between the stapes and any other bone lies air.",
    "labels alone": "Taken over from the labels given; no grey values were used.",
    "labels": "Taken over from the labels given; the grey values decide how much of each voxel is bone.",
    "flooded by grey value from the cores of the pieces": (
        "Close neighbours, parted along the darkest voxels between them: each piece is flooded by grey value "
        "from its own core, and what the blur carries over the divide is counted back."
    ),
}
_BONE_FROM = {
    "interior": "the mean of voxels deep inside the bone",
    "fit": "a fit of the edge profiles, for want of a deep interior",
}


def evidence_rows(segmentation: Mapping[str, Any]) -> list[Row]:
    """Return label and text of every entry of ``segmentation`` in mass.json.

    Parameters
    ----------
    segmentation : mapping
        Keys that are not known here are shown by their own name.
    """
    rows: list[Row] = []
    evidence = dict(segmentation.get("evidence") or {})
    rest = {key: value for key, value in segmentation.items() if key not in _DESCRIBED and key != "evidence"}
    for make in (_pieces, _separation, _levels, _blur, _grid):
        rows += make(segmentation, evidence)
    rest |= {key: value for key, value in evidence.items() if key not in _USED}
    rows += [(name, text) for name, text in flat(rest).items() if text not in ("None", "")]
    return rows


_DESCRIBED = {"levels", "psf_sigma_mm", "voxel_size_mm", "size_voxels"}
_USED = {
    "stapes",
    "other_bone",
    "coarse_spacing_mm",
    "material_levels",
    "bone_above",
    "separation",
    "iso_level_share",
    "psf_sigma_mm",
    "psf_from",
    "noise_correlation",
    "air_clipped_share",
}


def _piece(entry: Mapping[str, Any]) -> str:
    parts = []
    if entry.get("volume_mm3") is not None:
        parts.append(f"{entry['volume_mm3']:.2f} mm³")
    if entry.get("extents_mm"):
        parts.append(" × ".join(f"{value:.2f}" for value in entry["extents_mm"]) + " mm")
    holes = entry.get("holes")
    if holes is not None:
        parts.append("one hole" if holes == 1 else f"{holes} holes")
    if entry.get("at_border") is not None:
        parts.append("cut off by the border of the scan" if entry["at_border"] else "whole within the scan")
    return ", ".join(parts)


def _pieces(_told: Mapping[str, Any], evidence: Mapping[str, Any]) -> list[Row]:
    rows = []
    if isinstance(evidence.get("stapes"), Mapping):
        rows.append(("taken for the stapes (first look)", _piece(evidence["stapes"])))
    others: Sequence[Mapping[str, Any]] = evidence.get("other_bone") or ()
    rows += [
        (f"other bone{f' {place}' if len(others) > 1 else ''}", _piece(entry))
        for place, entry in enumerate(others, start=1)
    ]
    if evidence.get("coarse_spacing_mm"):
        steps = " × ".join(f"{1e3 * value:.0f}" for value in evidence["coarse_spacing_mm"])
        levels = ", ".join(f"{value:.0f}" for value in evidence.get("material_levels") or ())
        text = f"voxels of {steps} µm"
        text += f"; grey values of the materials {levels}" if levels else ""
        if evidence.get("bone_above") is not None:
            text += f"; bone above {evidence['bone_above']:.0f}"
        rows.append(("first look at the whole scan", text))
    return rows


def _separation(_told: Mapping[str, Any], evidence: Mapping[str, Any]) -> list[Row]:
    method = evidence.get("separation")
    if method is None:
        return []
    text = _SEPARATIONS.get(str(method), f"{str(method)[:1].upper()}{str(method)[1:]}.")
    return [("parted from other bone", text)]


def _levels(segmentation: Mapping[str, Any], evidence: Mapping[str, Any]) -> list[Row]:
    levels = segmentation.get("levels")
    if not levels:
        return []
    contrast = levels["bone"] - levels["air"]
    rows = [
        ("grey value of air", f"{levels['air']:.1f} ± {levels['air_sd']:.2g}, measured around the stapes"),
        (
            "grey value of bone",
            f"{levels['bone']:.1f} ± {levels['bone_sd']:.2g}, "
            f"from {_BONE_FROM.get(levels['bone_from'], levels['bone_from'])}",
        ),
    ]
    if levels.get("plastic") is not None:
        rows.append(("grey value of the plate", f"{levels['plastic']:.1f}"))
    text = f"{levels['noise']:.1f}, {100.0 * levels['noise'] / contrast:.1f} % of the contrast"
    correlation = evidence.get("noise_correlation")
    if correlation is not None and correlation > 1.05:
        text += f"; neighbours share it: sums scatter as if {correlation:.1f} times fewer voxels were there"
    rows.append(("noise of one voxel", text))
    clipped = evidence.get("air_clipped_share")
    if clipped:
        rows.append(("voxels of air cut off at the lowest value", f"{100.0 * clipped:.2g} %"))
    share = evidence.get("iso_level_share")
    if share is not None:
        rows.append(
            (
                "level of the surface shown",
                f"{100.0 * share:.1f} % from air to bone, where the surface holds the volume measured",
            )
        )
    return rows


def _blur(segmentation: Mapping[str, Any], evidence: Mapping[str, Any]) -> list[Row]:
    sigma, spacing = segmentation.get("psf_sigma_mm"), segmentation.get("voxel_size_mm")
    if not sigma:
        return []
    text = f"{1e3 * sigma:.1f} µm (standard deviation, voxel included)"
    if spacing:
        text += f", {sigma / min(spacing):.2f} voxels"
    source = evidence.get("psf_from")
    return [("blur of the scan", f"{text}; read off {source}" if source else text)]


def _grid(segmentation: Mapping[str, Any], _evidence: Mapping[str, Any]) -> list[Row]:
    spacing, size = segmentation.get("voxel_size_mm"), segmentation.get("size_voxels")
    if not spacing:
        return []
    voxel = " × ".join(f"{1e3 * value:.4g}" for value in spacing) + " µm"
    return [("voxels", voxel + (f"; {' × '.join(map(str, size))} of them" if size else ""))]


def flat(value: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Return nested keys as one level of words and short texts."""
    words: dict[str, str] = {}
    for key, entry in value.items():
        name = f"{prefix}{key}".replace("_", " ")
        if isinstance(entry, Mapping):
            words |= flat(entry, f"{name}: ")
        elif isinstance(entry, list) and entry and isinstance(entry[0], Mapping):
            for place, part in enumerate(entry):
                words |= flat(part, f"{name} {place + 1}: ")
        else:
            words[name] = _format_entry(entry)
    return words


def _format_entry(entry: Any) -> str:
    if isinstance(entry, bool):
        return "yes" if entry else "no"
    if isinstance(entry, float):
        return f"{entry:.5g}"
    if isinstance(entry, list):
        return ", ".join(_format_entry(part) for part in entry)
    return str(entry)
