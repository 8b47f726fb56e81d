"""The run of a cohort described as an RO-Crate (Soiland-Reyes et al. 2022, doi:10.3233/DS-210053)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from legacy.pipeline.cohort.cohort_laws import CohortLaws

_CONTEXT = "https://w3id.org/ro/crate/1.1/context"
_FORMATS = {
    ".csv": "text/csv",
    ".html": "text/html",
    ".json": "application/json",
    ".h5": "application/x-hdf5",
    ".svg": "image/svg+xml",
    ".tex": "application/x-tex",
    ".log": "text/plain",
    ".xlsx": "application/vnd.openxmlformats-officedocument.spreadsheetml.sheet",
}


def write(folder: Path, cohort: CohortLaws, content: Mapping[str, Any]) -> None:
    """Write ro-crate-metadata.json for the files that the folder holds now, and the ears' folders."""
    from legacy.stapeskit import __version__

    when = content["provenance"].get("date")
    files = sorted(path.name for path in folder.iterdir() if path.is_file() and path.suffix in _FORMATS)
    ears = [{"@id": f"{quote(ear.folder)}/", "@type": "Dataset", "name": ear.name} for ear in cohort.ears]
    inputs = content["provenance"].get("inputs") or {}
    software = {
        "@id": "#stapeskit",
        "@type": "SoftwareApplication",
        "name": "stapeskit",
        "softwareVersion": __version__,
    }
    action = {
        "@id": "#run",
        "@type": "CreateAction",
        "name": "scan2kd over several ears",
        "instrument": {"@id": "#stapeskit"},
        "endTime": when,
        "object": [{"@id": f"{quote(name)}/kd.json"} for name in inputs],
        "result": [{"@id": name} for name in files],
    }
    used = [
        {
            "@id": f"{quote(name)}/kd.json",
            "@type": "File",
            "encodingFormat": _FORMATS[".json"],
            "contentSize": str(entry["size_bytes"]),
            "identifier": entry["hash"],
        }
        for name, entry in inputs.items()
    ]
    root = {
        "@id": "./",
        "@type": "Dataset",
        "name": f"Cohort of {len(cohort.ears)} ears",
        "description": "Mass, stiffness and damping of stapedes, and laws over them.",
        "datePublished": when,
        "hasPart": [{"@id": part} for part in (*files, *(ear["@id"] for ear in ears))],
        "mentions": [{"@id": "#run"}],
    }
    described = [
        {
            "@id": name,
            "@type": "File",
            "name": name,
            "encodingFormat": _FORMATS[Path(name).suffix],
            "contentSize": str((folder / name).stat().st_size),
        }
        for name in files
    ]
    about = {
        "@id": "ro-crate-metadata.json",
        "@type": "CreativeWork",
        "conformsTo": {"@id": "https://w3id.org/ro/crate/1.1"},
        "about": {"@id": "./"},
    }
    graph = [about, root, action, software, *described, *ears, *used]
    text = json.dumps({"@context": _CONTEXT, "@graph": graph}, indent=1)
    (folder / "ro-crate-metadata.json").write_text(text + "\n", encoding="utf-8")
