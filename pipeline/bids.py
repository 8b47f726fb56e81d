"""Studies of ears in folders in the manner of BIDS (Gorgolewski et al. 2016, doi:10.1038/sdata.2016.44).

dataset_description.json
participants.tsv
sub-TB12/[ses-1/]sub-TB12_hemi-L_study.toml     the study file, with paths from here
sub-TB12/[ses-1/]uct/sub-TB12_hemi-L_file.tif   what [scan] names, by its key
sub-TB12/[ses-1/]ldv/sub-TB12_hemi-L_file.csv   what [ldv] names, by its key
derivatives/stapeskit/                          results: a folder an ear, and the cohort
"""

from __future__ import annotations

import filecmp
import json
import re
import shutil
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.cohort.about import about_of
from pipeline.errors import PipelineError
from pipeline.records import with_data
from pipeline.study import TABLES, Study, read_study
from stapeskit.faults import Fault, raise_all
from stapeskit.option_values import toml
from stapeskit.options import declared

_FOLDERS = {"scan": "uct", "ldv": "ldv"}
_STUDY = "_study.toml"
_VERSION = "1.10.0"


def derivatives(dataset: Path) -> Path:
    """Return the folder of results of a dataset."""
    return Path(dataset) / "derivatives" / "stapeskit"


def read_dataset(dataset: Path) -> list[Path]:
    """Return the study files of a dataset, by name.

    Raises
    ------
    PipelineError
        There is none.
    """
    dataset = Path(dataset)
    files = sorted([*dataset.glob(f"sub-*/sub-*{_STUDY}"), *dataset.glob(f"sub-*/ses-*/sub-*{_STUDY}")])
    if not files:
        expected = f"a dataset with study files sub-*/sub-*{_STUDY}"
        step = "Name study files before {bids} to write them there"
        raise PipelineError(Fault("{bids}", expected, dataset, "", step))
    return files


def write_dataset(studies: Sequence[Path], dataset: Path) -> list[Path]:
    """Copy studies with all their files into a dataset, and return the study files there.

    Parameters
    ----------
    studies : sequence of Path
    dataset : Path
        Made when missing; studies that it holds already stay.

    Raises
    ------
    PipelineError
        Two studies have one place, or another file stands at a place. Nothing has been copied then.
    """
    dataset = Path(dataset)
    faults: list[Fault] = []
    copies: dict[Path, Path] = {}
    texts: dict[Path, str] = {}
    participants: dict[str, Mapping[str, Any]] = {}
    for path in studies:
        study = read_study(path)
        about = about_of(study.study)
        subject, stem, folder = _place(path, study, about)
        target = dataset / folder / f"{stem}{_STUDY}"
        if target in texts:
            expected = "of another subject, session or side than the others"
            faults.append(Fault(f"the study {path}", expected, stem, "", "Set subject and side in [study]"))
        texts[target] = _copied(path, target, stem, copies)
        participants[f"sub-{subject}"] = about
    for target, text in texts.items():
        if target.exists() and target.read_text(encoding="utf-8") != text:
            faults.append(_taken(target))
    faults += [
        _taken(target)
        for target, source in copies.items()
        if target.exists() and not (target.is_dir() or filecmp.cmp(source, target, shallow=False))
    ]
    raise_all(PipelineError, faults)
    for target, source in copies.items():
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target, dirs_exist_ok=True)
        elif not target.exists():
            shutil.copyfile(source, target)
    for target, text in texts.items():
        target.write_text(text, encoding="utf-8")
    _describe(dataset, participants)
    return list(texts)


def _taken(path: Path) -> Fault:
    return Fault(
        f"the file {path}", "free, or equal to the copy", "another file", "", "Choose another folder"
    )


def _place(path: Path, study: Study, about: Mapping[str, Any]) -> tuple[str, str, Path]:
    """Return the subject, the beginning of the names of an ear's files, and its folder."""
    subject = _plain(about.get("subject") or about.get("ear") or study.study.name or path.stem)
    side = str(about.get("side") or study.scan.side or "")
    session = _plain(about.get("session") or "")
    parts = [f"sub-{subject}", *([f"ses-{session}"] if session else [])]
    stem = "_".join([*parts, *([f"hemi-{side[0].upper()}"] if side else [])])
    return subject, stem, Path(*parts)


def _plain(text: object) -> str:
    """Return the letters and digits of a text: labels of BIDS have no others."""
    return re.sub(r"[^A-Za-z0-9]", "", str(text))


def _copied(path: Path, target: Path, stem: str, copies: dict[Path, Path]) -> str:
    """Note what must be copied for a study, and return the text of its study file at the new place."""
    tables = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    for table, folder in _FOLDERS.items():
        files = {option.key for option in declared(TABLES[table]) if option.kind.is_file}
        for key in files & set(tables.get(table, {})):
            value = tables[table][key]
            entries = value if isinstance(value, list) else [value]
            new = []
            for number, entry in enumerate(entries, start=1):
                source = path.absolute().parent / str(entry)
                several = f"-{number}" if len(entries) > 1 else ""
                place = _target(source, target.parent / folder, f"{stem}_{key}{several}", copies)
                new.append(place.relative_to(target.parent).as_posix())
            tables[table][key] = new if isinstance(value, list) else new[0]
    lines = [
        line
        for table, values in tables.items()
        for line in (f"[{table}]", *(f"{key} = {toml(value)}" for key, value in values.items()), "")
    ]
    return "\n".join(lines)


def _target(source: Path, folder: Path, name: str, copies: dict[Path, Path]) -> Path:
    """Note a file, or a header with the files that it names, to be copied; return its new place."""
    parts = [source] if source.is_dir() else with_data(source)
    if len(parts) > 1:
        # A header names its data files: all keep their names, in a folder of the ear.
        for part in parts:
            copies[folder / name / part.name] = part
        return folder / name / source.name
    endings = source.suffixes[-2:] if source.suffix == ".gz" else source.suffixes[-1:]
    place = folder / (name if source.is_dir() else name + "".join(endings))
    copies[place] = source
    return place


def _describe(dataset: Path, participants: Mapping[str, Mapping[str, Any]]) -> None:
    """Write the descriptions of dataset and derivatives, and the table of participants."""
    import pandas as pd

    from stapeskit import __version__

    made_by = [{"Name": "stapeskit", "Version": __version__}]
    for folder, kind in ((dataset, "raw"), (derivatives(dataset), "derivative")):
        folder.mkdir(parents=True, exist_ok=True)
        content = {
            "Name": "Ears: micro-CT and laser Doppler vibrometry",
            "BIDSVersion": _VERSION,
            "DatasetType": kind,
            "GeneratedBy": made_by,
        }
        path = folder / "dataset_description.json"
        if not path.exists():
            path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    path = dataset / "participants.tsv"
    keys = ("age", "sex", "group")
    rows = {name: [about.get(key, "n/a") for key in keys] for name, about in participants.items()}
    if path.exists():
        before = pd.read_csv(path, sep="\t", dtype=str, keep_default_na=False)
        known = {row["participant_id"]: [row.get(key, "n/a") for key in keys] for _, row in before.iterrows()}
        rows = {**known, **rows}
    table = pd.DataFrame([[name, *rows[name]] for name in sorted(rows)], columns=["participant_id", *keys])
    table.to_csv(path, sep="\t", index=False, lineterminator="\n")
