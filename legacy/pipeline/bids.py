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
import os
import re
import shutil
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from legacy.ct_inertia.readers.companions import data_files
from legacy.kinematics.readers.recognise_format import companion_files
from legacy.pipeline.cohort.ear_description import about_of
from legacy.pipeline.errors import PipelineError
from legacy.pipeline.participants import PARTICIPANTS, with_participants
from legacy.pipeline.study import TABLES, Study, read_study
from legacy.stapeskit.faults import Fault, collect_faults, raise_all
from legacy.stapeskit.option_values import toml
from legacy.stapeskit.options import declared
from legacy.stapeskit.outputs import stage_outputs

# Files of other tables, such as the true values of a simulated ear, stay next to the study file.
_FOLDERS = {"scan": "uct", "ldv": "ldv"}
# From a file to those that are read with it.
_COMPANIONS: dict[str, Callable[[Path], Sequence[Path]]] = {"scan": data_files, "ldv": companion_files}
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
        raise PipelineError.of("{bids}", expected, dataset, "", step)
    return files


def write_dataset(studies: Sequence[Path], dataset: Path) -> list[Path]:
    """Copy studies with all their files into a dataset at once, and return the study files there.

    Parameters
    ----------
    dataset : Path
        Made when missing; studies that it holds already stay.

    Raises
    ------
    PipelineError
        Two studies have one destination, another file is there or in a copied folder, or the table of
        participants contradicts a study. Nothing has been copied then.
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
        texts[target] = _copy(path, target, stem, copies)
        participants[f"sub-{subject}"] = about
    files = {place: file for target, source in copies.items() for place, file in _files(source, target)}
    faults += [_taken_fault(target) for target, text in texts.items() if _holds_other(target, text.encode())]
    faults += [_taken_fault(target) for target, source in files.items() if _holds_other(target, source)]
    faults += [
        _taken_fault(stray)
        for target, source in copies.items()
        for stray in _find_strays(source, target, files)
    ]
    with collect_faults(faults):
        table = with_participants(dataset / PARTICIPANTS, participants)
    raise_all(PipelineError, faults)
    new: dict[Path, Path | bytes] = {**files, **{target: text.encode() for target, text in texts.items()}}
    new |= _descriptions(dataset)
    missing = {target: content for target, content in new.items() if not os.path.lexists(target)}
    if table is not None:
        missing[dataset / PARTICIPANTS] = table.encode()
    _write(dataset, missing)
    return list(texts)


def _write(dataset: Path, files: Mapping[Path, Path | bytes]) -> None:
    """Let files appear in the dataset at once: copies of others, or with this content."""
    if not files:
        return
    with stage_outputs(dataset) as stage:
        for target, content in files.items():
            place = stage / target.relative_to(dataset)
            place.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(content, Path):
                shutil.copyfile(content, place)
            else:
                place.write_bytes(content)


def _files(source: Path, target: Path) -> Iterator[tuple[Path, Path]]:
    """Yield the place and the source of a file, or of every file of a folder."""
    if not source.is_dir():
        yield target, source
        return
    for top, _, names in os.walk(source, followlinks=True):
        for file in (Path(top, name) for name in sorted(names)):
            if file.is_file():
                yield target / file.relative_to(source), file


def _holds_other(target: Path, content: Path | bytes) -> bool:
    """Return whether the destination holds anything but the copy."""
    if not os.path.lexists(target):
        return False
    if not target.is_file():
        return True
    if isinstance(content, Path):
        return not filecmp.cmp(content, target, shallow=False)
    return target.read_bytes() != content


def _find_strays(source: Path, target: Path, files: Mapping[Path, Path]) -> list[Path]:
    """Return files in a copied folder that are not of it: they would be read as a part of the scan."""
    if not (source.is_dir() and target.is_dir()):
        return []
    return [place for place, _ in _files(target, target) if place not in files]


def _taken_fault(path: Path) -> Fault:
    return Fault(
        f"the file {path}", "free, or equal to the copy", "another file", "", "Choose another folder"
    )


def _place(path: Path, study: Study, about: Mapping[str, Any]) -> tuple[str, str, Path]:
    """Return the subject, the beginning of the names of an ear's files, and its folder."""
    subject = _keep_letters(about.get("subject") or about.get("ear") or study.study.name or path.stem)
    side = str(about.get("side") or study.scan.side or "")
    session = _keep_letters(about.get("session") or "")
    parts = [f"sub-{subject}", *([f"ses-{session}"] if session else [])]
    stem = "_".join([*parts, *([f"hemi-{side[0].upper()}"] if side else [])])
    return subject, stem, Path(*parts)


def _keep_letters(text: object) -> str:
    """Return the letters and digits of a text: labels of BIDS have no others."""
    return re.sub(r"[^A-Za-z0-9]", "", str(text))


def _copy(path: Path, target: Path, stem: str, copies: dict[Path, Path]) -> str:
    """Collect the files to copy for a study; return the text of its study file with the new paths."""
    tables = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    for table in TABLES:
        folder = _FOLDERS.get(table, "")
        companions = _COMPANIONS.get(table, lambda _file: ())
        files = {option.key: option.kind for option in declared(TABLES[table]) if option.kind.is_file}
        for key in files.keys() & tables.get(table, {}).keys():
            value = tables[table][key]
            entries = value if isinstance(value, list) else [value]
            new = []
            for number, entry in enumerate(entries, start=1):
                source = path.absolute().parent / str(entry)
                several = f"-{number}" if len(entries) > 1 else ""
                name = f"{stem}_{key}{several}"
                kept = files[key].repeats
                place = _target(source, target.parent / folder, name, copies, companions, kept)
                new.append(place.relative_to(target.parent).as_posix())
            tables[table][key] = new if isinstance(value, list) else new[0]
    lines = [
        line
        for table, values in tables.items()
        for line in (f"[{table}]", *(f"{key} = {toml(value)}" for key, value in values.items()), "")
    ]
    return "\n".join(lines)


def _target(
    source: Path,
    folder: Path,
    name: str,
    copies: dict[Path, Path],
    companions: Callable[[Path], Sequence[Path]],
    keeps_name: bool,
) -> Path:
    """Add a file, with its companions, to the copies; return its new path.

    Files of one measurement keep their names (``keeps_name``): runs, bodies and channel tables name them.

    Raises
    ------
    PipelineError
        A header names a file outside its folder: copied by that name, it would lie outside that of the ear.
    """
    data = [Path(os.path.normpath(file)) for file in companions(source)]
    source = Path(os.path.normpath(source))
    outside = [file for file in data if not file.is_relative_to(source.parent)]
    if outside:
        raise PipelineError.of(
            "the data file", "in the folder of its header", outside[0], source.name,
            "Put both files into one folder, and correct the name in the header",
        )  # fmt: skip
    endings = source.suffixes[-2:] if source.suffix == ".gz" else source.suffixes[-1:]
    place = folder / (name if source.is_dir() else name + "".join(endings))
    if data or keeps_name:
        # Companions are found by their names: all lie in a folder of the ear.
        place = folder / name / source.name
    copies[place] = source
    for part in data:
        copies[folder / name / part.relative_to(source.parent)] = part
    return place


def _descriptions(dataset: Path) -> dict[Path, Path | bytes]:
    """Return the descriptions of dataset and derivatives."""
    from legacy.stapeskit import __version__

    made_by = [{"Name": "stapeskit", "Version": __version__}]
    contents = {
        folder: {
            "Name": "Ears: micro-CT and laser Doppler vibrometry",
            "BIDSVersion": _VERSION,
            "DatasetType": kind,
            "GeneratedBy": made_by,
        }
        for folder, kind in ((dataset, "raw"), (derivatives(dataset), "derivative"))
    }
    return {
        folder / "dataset_description.json": f"{json.dumps(content, indent=1)}\n".encode()
        for folder, content in contents.items()
    }
