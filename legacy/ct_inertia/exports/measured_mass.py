"""The mass record of a result in memory, as the rooms that use a mass.json read it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.ct_inertia.exports.mass_json import mass_json
from legacy.stapeskit.provenance import document_hash
from legacy.stapeskit.records.mass_record import mass_record
from legacy.stapeskit.records.measured_mass import LabelVolume, MeasuredMass

if TYPE_CHECKING:
    from legacy.ct_inertia.bodies import LabelledVolume
    from legacy.ct_inertia.ct2mass import MassMeasurement
    from legacy.ct_inertia.surface.surface import Surface


def measured_mass(result: MassMeasurement, content: Mapping[str, Any] | None = None) -> MeasuredMass:
    """Return mass, frames and surfaces of a result.

    Parameters
    ----------
    result : MassMeasurement
    content : mapping, optional
        Of mass.json, when it was made before; the record is made from the same content.
    """
    import xxhash

    record = mass_json(result, second=False) if content is None else content
    text = json.dumps(record, indent=1) + "\n"
    source = {
        "file": "mass.json in memory",
        "size_bytes": len(text.encode()),
        "modified": record["provenance"]["date"],
        "hash": f"xxh3_128:{xxhash.xxh3_128_hexdigest(text.encode())}",
        "document_hash": document_hash(json.loads(text)),
    }
    surfaces: dict[str, Surface | None] = {"stapes": result.stapes, "plate": result.plate}
    return MeasuredMass(
        mass_record(json.loads(text)),
        meshes={
            name: (surface.vertices_mm, surface.faces)
            for name, surface in surfaces.items()
            if surface is not None
        },
        labels=lambda: None if result.bodies is None else _label_volume(result.bodies.labels),
        source=source,
    )


def _label_volume(labels: LabelledVolume) -> LabelVolume:
    matrix = np.column_stack([labels.direction * labels.spacing_mm, labels.origin_mm])
    return LabelVolume(labels.labels, matrix)
