"""How the stapes was found, cut out and measured, in plain words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_BONE_FROM = {
    "interior": "the mean of voxels deep inside the bone",
    "fit": "the fit of the scene, for want of a deep interior",
    "mask": "labels",
}

Row = tuple[str, str]


def evidence_rows(content: Mapping[str, Any]) -> list[Row]:
    """Return label and text of what mass.json says of the segmentation; nothing for a mesh.

    Parameters
    ----------
    content : mapping
        Of mass.json.
    """
    segmentation = content.get("segmentation")
    if not segmentation:
        return []
    size = " × ".join(map(str, segmentation["size_voxels"]))
    voxel = " × ".join(f"{1e3 * value:.4g}" for value in segmentation["voxel_size_mm"])
    rows = [
        ("voxels", f"{size} of {voxel} µm"),
        ("separated from other bone", str(segmentation["separation"])),
    ]
    levels = segmentation["levels"]
    if levels:
        contrast = levels["bone"] - levels["air"]
        source = _BONE_FROM.get(levels["bone_from"], levels["bone_from"])
        rows += [
            ("grey value of air", f"{levels['air']:.5g} ± {levels['air_sd']:.2g}"),
            ("grey value of bone", f"{levels['bone']:.5g} ± {levels['bone_sd']:.2g}, from {source}"),
            ("noise of one voxel", f"{100.0 * levels['noise'] / contrast:.1f} % of the contrast"),
            ("blur of the scan", f"{1e3 * segmentation['psf_sigma_mm']:.1f} µm (sd, voxel included)"),
        ]
    rows += [
        (f"fitted: {name}".replace("_", " "), f"{value:.3g}") for name, value in segmentation["media"].items()
    ]
    for part in ("found", "measured"):
        rows += _flat(segmentation[part])
    return rows


def _flat(values: Mapping[str, Any], before: str = "") -> list[Row]:
    """Return nested keys as rows of words and short texts."""
    rows: list[Row] = []
    for key, value in values.items():
        name = f"{before}{key}".replace("_", " ")
        if isinstance(value, Mapping):
            rows += _flat(value, f"{name}: ")
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            for place, part in enumerate(value[:5], start=1):
                rows += _flat(part, f"{name} {place}: ")
        elif value not in (None, "", []):
            rows.append((name, _text(value)))
    return rows


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    return ", ".join(_text(part) for part in value) if isinstance(value, list) else str(value)
