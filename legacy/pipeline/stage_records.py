"""Records of finished stages, inputs and outputs by hash: a stage is reused while they are unchanged."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from legacy.stapeskit.json_toml import parse_json
from legacy.stapeskit.page.foreign_markup import foreign_markup
from legacy.stapeskit.page.page import Section
from legacy.stapeskit.provenance import Hashes
from legacy.stapeskit.warnings import Notice, from_json

FOLDER = ".stapeskit"
SCHEMA = "stapeskit.stage/1"
_SOURCES = {".py", ".js", ".css", ".html", ".toml"}


@dataclass(frozen=True)
class StageRecord:
    """One finished stage.

    Attributes
    ----------
    fingerprint : mapping of str to str
        Everything its outputs depend on: ``code``, ``input scan``, ``spacing_mm`` ...
    outputs : mapping of str to str
        Content hash by file name.
    seconds : float
        What it took.
    """

    stage: str
    fingerprint: Mapping[str, str]
    outputs: Mapping[str, str]
    seconds: float

    def changes(self, fingerprint: Mapping[str, str]) -> list[str]:
        """Name what differs from another fingerprint."""
        names = sorted({*self.fingerprint, *fingerprint})
        return [name for name in names if self.fingerprint.get(name) != fingerprint.get(name)]

    def spoiled(self, folder: Path, hashes: Hashes) -> list[str]:
        """Name the outputs in ``folder`` that are missing or no longer what was written."""
        return [
            name
            for name, known in self.outputs.items()
            if not (folder / name).is_file() or hashes.of(folder / name) != known
        ]


def record_name(stage: str) -> str:
    """Return the name of a stage's record within the output folder."""
    return f"{FOLDER}/{stage}.json"


def write_record(folder: Path, record: StageRecord) -> None:
    """Write a record into the folder that holds the stage's outputs."""
    content = {
        "schema": SCHEMA,
        "stage": record.stage,
        "fingerprint": dict(record.fingerprint),
        "outputs": dict(record.outputs),
        "seconds": round(record.seconds, 3),
    }
    path = Path(folder) / record_name(record.stage)
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_record(folder: Path, stage: str) -> StageRecord | None:
    """Read a record; None when there is none or it cannot be believed."""
    try:
        content = parse_json((Path(folder) / record_name(stage)).read_text(encoding="utf-8"))
        if content["schema"] != SCHEMA or content["stage"] != stage:
            return None
        prints, outputs = dict(content["fingerprint"]), dict(content["outputs"])
        if not all(isinstance(value, str) for value in (*prints.values(), *outputs.values())):
            return None
        if any(Path(name).is_absolute() or ".." in Path(name).parts for name in outputs):
            return None
        return StageRecord(stage, prints, outputs, float(content["seconds"]))
    except (OSError, ValueError, KeyError, TypeError, OverflowError):
        return None


def fingerprint(
    rooms: Iterable[str],
    inputs: Mapping[str, Path | None],
    parameters: Mapping[str, Any],
    hashes: Hashes,
) -> dict[str, str]:
    """Return everything that a stage depends on, by name.

    Parameters
    ----------
    rooms : iterable of str
        Packages, or files as ``package/file.py``, whose code makes the outputs.
    parameters : mapping
        JSON-able; paths left out.
    hashes : Hashes
        Of the files of this run.
    """
    prints = {"stapeskit": code_hash(rooms), "packages": json.dumps(hashes.versions(), sort_keys=True)}
    for role, path in inputs.items():
        if path is not None:
            prints[f"input {role}"] = hashes.of(path)
    for name, value in parameters.items():
        prints[name] = _shorten(json.dumps(value, sort_keys=True))
    return prints


def _shorten(text: str) -> str:
    """Return a text, or its hash when it is long."""
    import xxhash

    return text if len(text) <= 120 else xxhash.xxh3_128_hexdigest(text.encode())


def code_hash(rooms: Iterable[str]) -> str:
    """Hash the source of packages."""
    import xxhash

    root = Path(__file__).resolve().parents[1]
    digest = xxhash.xxh3_128()
    for room in rooms:
        files = [root / room] if room.endswith(".py") else (root / room).rglob("*")
        for file in sorted(file for file in files if file.suffix in _SOURCES):
            digest.update(str(file.relative_to(root)).encode())
            digest.update(file.read_bytes())
    return str(digest.hexdigest())


@dataclass(frozen=True)
class StageReport:
    """The part of a stage in the report: its sections and warnings."""

    sections: tuple[Section, ...] = ()
    notices: tuple[Notice, ...] = ()


def stage_report_name(stage: str) -> str:
    """Return the name of the file with a stage's sections within the output folder."""
    return f"{FOLDER}/{stage}.sections.json"


def write_stage_report(folder: Path, stage: str, report: StageReport) -> None:
    """Keep the sections of a stage, so that the report can be put together without making them anew."""
    content = {
        "sections": [
            {
                "key": section.key,
                "heading": section.heading,
                "blocks": [str(block) for block in section.blocks],
            }
            for section in report.sections
        ],
        "warnings": [notice.as_json() for notice in report.notices],
    }
    path = Path(folder) / stage_report_name(stage)
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(content), encoding="utf-8")


def read_stage_report(path: Path) -> StageReport | None:
    """Read the report of a stage; None when the content is not as write_stage_report writes it.

    The hash in the stage's record does not prove who wrote it: whoever passes a folder on can change both.
    """
    from markupsafe import Markup

    try:
        content = parse_json(Path(path).read_text(encoding="utf-8"))
        sections = tuple(
            Section(
                str(entry["heading"]), [Markup(block) for block in entry["blocks"]], str(entry.get("key", ""))
            )
            for entry in content["sections"]
        )
        blocks = [str(block) for section in sections for block in section.blocks]
        if any(map(foreign_markup, blocks)):
            return None
        return StageReport(sections, from_json(content["warnings"]))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
