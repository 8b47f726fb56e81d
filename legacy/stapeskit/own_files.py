"""The outputs of one run: nothing that the command reads and nothing that it did not make is replaced.

What a command wrote is recorded by name and content hash in a hidden folder next to the outputs, so that the
record moves with them, and a file that was edited since no longer counts as the command's own.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from legacy.stapeskit.faults import Fault, StapeskitError, raise_all
from legacy.stapeskit.json_toml import parse_json
from legacy.stapeskit.outputs import existing_folder, stage_outputs
from legacy.stapeskit.provenance import Hashes
from legacy.stapeskit.warnings import Notice

RECORDS = ".stapeskit"
"""Folder of the records next to the outputs; what lies in it is the program's."""
SCHEMA = "stapeskit.outputs/1"
FOREIGN_FILE_KEPT = "foreign_file_kept"
_LONGEST_NAME = 180  # bytes, of what a record is named after
_LONGEST_OUTPUT = 255  # bytes, of file systems
_Inode = tuple[int, int]


@dataclass(frozen=True)
class OutputSet:
    """The files that one run of a command may write in a folder, and what it reads.

    Attributes
    ----------
    command : str
        Its name; together with the first of ``names`` it names the record.
    names : tuple of str
        Files that this run may write, or that would contradict its result if others were there.
    inputs : tuple of Path
        Every file and folder that the command reads; those that do not exist count for nothing.
    force : bool
        Replace files that the command is not known to have made. Inputs are never replaced.
    leftovers : tuple of str
        Names that other options of the command write: removed where they are its own, else left alone.
    known : mapping of str to str
        Content hashes by name that the command recorded elsewhere.
    hints : mapping of str to str
        What to do first about a file of this name that was edited.
    hash_of : callable
        Returns the content hash of a file; that of a run hashes each file once.
    """

    command: str
    folder: Path
    names: tuple[str, ...]
    inputs: tuple[Path, ...] = ()
    force: bool = False
    leftovers: tuple[str, ...] = ()
    known: Mapping[str, str] = field(default_factory=dict)
    hints: Mapping[str, str] = field(default_factory=dict)
    hash_of: Callable[[Path], str] = field(default_factory=lambda: Hashes().of, repr=False, compare=False)

    def check(self) -> None:
        """Look before the work begins whether every output may be written.

        Raises
        ------
        StapeskitError
            An output is an input, also by a link; a file that the command did not write, or that was edited
            since, has its name; or a folder has it. All of it in one error.
        """
        existing_folder(self.folder)
        self._check(self.names)

    @contextmanager
    def staged(self, unchanged: Collection[str] = ()) -> Iterator[Path]:
        """Lend an empty folder whose files become the outputs when the block ends well; see `output.staged`.

        The command's own files of an earlier run that are not written this time are removed.

        Parameters
        ----------
        unchanged : collection of str, optional
            Names of outputs that still hold, though they are not written; read when the block has ended.

        Raises
        ------
        StapeskitError
            As in `check`, for what has changed since.
        """
        with stage_outputs(self.folder, partial(self._record_outputs, unchanged)) as stage:
            yield stage

    def kept_notices(self, written: Collection[str]) -> tuple[Notice, ...]:
        """Return a notice on files of the command's names that are not its own and stay where they are."""
        recorded, read = self._recorded_hashes(), self._files_read
        names = [
            name
            for name in dict.fromkeys((*self.names, *self.leftovers))
            if name not in written
            and os.path.lexists(self.folder / name)
            and _inode(self.folder / name) not in read
            and not self._is_own(name, recorded)
        ]
        if not names:
            return ()
        text = (
            f"Not known as written by {self.command}, left in the output folder, and no part of this result: "
            f"{_name_files(names)}."
        )
        return (Notice(FOREIGN_FILE_KEPT, text),)

    def clashes(self, names: Collection[str] = ()) -> list[Fault]:
        """Return a fault for every output, of these names or all, that is an input, also by a link."""
        read = self._files_read
        paths = [self.folder / name for name in (*(names or self.names), self._record_name)]
        return [self._is_input(path, read[_inode(path)]) for path in paths if _inode(path) in read]

    def _check(self, names: Collection[str]) -> None:
        """Raise what forbids to write these names."""
        names = tuple(dict.fromkeys(names))
        read, recorded, foreign = self._files_read, self._recorded_hashes(), list[str]()
        faults = self.clashes(names)
        records = self.folder / RECORDS
        if os.path.lexists(records) and (records.is_symlink() or not records.is_dir()):
            # behind a link there may be files of the user
            got = "a link" if records.is_symlink() else "a file"
            faults.append(Fault(f"{records}", "the folder of records", got, "", "Move it away"))
        for name in names:
            path = self.folder / name
            if Path(name).is_absolute() or ".." in Path(name).parts:
                expected = f"within the folder {self.folder}"
                faults.append(Fault("the name of an output", expected, name, "", "Give a name alone"))
                continue
            if len(os.fsencode(path.name)) > _LONGEST_OUTPUT:
                got = f"{len(os.fsencode(path.name))}: {name[:40]}...{name[-20:]}"
                expected = f"of at most {_LONGEST_OUTPUT} bytes"
                faults.append(Fault("the name of an output", expected, got, "", "Choose a shorter one"))
                continue
            if not os.path.lexists(path) or _inode(path) in read or self._is_own(name, recorded):
                continue
            if path.is_dir():
                faults.append(Fault(f"the output {path}", "a file", "a folder", "", "Move it away"))
            else:
                foreign.append(name)
        if foreign and not self.force:
            faults.append(self._foreign_files(foreign, recorded))
        elif foreign:
            within = _files_of(path for path in self.inputs if os.path.isdir(path))
            clashes = [self.folder / name for name in foreign if _inode(self.folder / name) in within]
            faults += [self._is_input(path, within[_inode(path)]) for path in clashes]
        raise_all(StapeskitError, faults)

    def _is_input(self, output: Path, source: Path) -> Fault:
        same = source if str(source) == str(output) else f"{source}, which is the same file"
        expected = "another file than the inputs"
        return Fault(f"the output {output}", expected, f"the input {same}", "", self._next_step)

    def _foreign_files(self, names: list[str], recorded: Mapping[str, Collection[str]]) -> Fault:
        edited = [name for name in names if name in recorded]
        others = [name for name in names if name not in recorded]
        got = [f"{_name_files(edited)}, edited since"] if edited else []
        got += [f"{_name_files(others)}, which it is not known to have written"] if others else []
        steps = [self.hints[name] for name in edited if name in self.hints]
        steps.append(f"{self._next_step}, or let --force replace the files there")
        thing = f"the files in {self.folder} at the names of outputs"
        return Fault(thing, f"as {self.command} left them", "; and ".join(got), "", ". ".join(steps))

    @property
    def _next_step(self) -> str:
        """The next step; the words of stapeskit name their folder without an option."""
        by_word = self.command.startswith("stapeskit")
        return "Name another folder" if by_word else "Choose another place with --out"

    def _is_own(self, name: str, recorded: Mapping[str, Collection[str]]) -> bool:
        """Return whether a file is as the command wrote it."""
        if name.startswith(f"{RECORDS}/"):
            return True
        path = self.folder / name
        with suppress(OSError):
            return (
                name in recorded
                and stat.S_ISREG(path.lstat().st_mode)
                and self.hash_of(path) in recorded[name]
            )
        return False

    def _record_outputs(self, unchanged: Collection[str], stage: Path) -> Callable[[], None] | None:
        """Check and record the new outputs before they appear; return the work left for when they have."""
        hashes = {
            path.relative_to(stage).as_posix(): self.hash_of(path)
            for path in sorted(stage.rglob("*"))
            if path.is_file()
        }
        self._check((*self.names, *hashes) if not self.force else hashes)
        recorded = self._recorded_hashes()
        hashes = {name: digest for name, digest in hashes.items() if not name.startswith(f"{RECORDS}/")}
        after = {name: {digest} for name, digest in hashes.items()}
        if not os.path.lexists(self.folder):
            # the record appears with the files, by one rename
            self._record(stage, after, stage)
            return None
        (stage / self._record_name).unlink(missing_ok=True)
        stale = self._stale({*hashes, *unchanged}, recorded)
        # Both states are known while the files are moved one by one: a run that is killed there leaves only
        # files that the next one knows, and readers refuse them until then.
        both = {**recorded, **{name: {*recorded.get(name, ()), hashes[name]} for name in hashes}}
        self._record(stage, both, self.folder, unfinished=(*hashes, *stale))
        after = {**{name: digest for name, digest in recorded.items() if name not in stale}, **after}

        def finish() -> None:
            for name in stale:
                (self.folder / name).unlink(missing_ok=True)
            self._record(stage, after, self.folder)

        return finish

    def _stale(self, stay: Collection[str], recorded: Mapping[str, Collection[str]]) -> list[str]:
        """List own files of earlier runs that this one did not make and does not read."""
        read = self._files_read
        return [
            name
            for name in dict.fromkeys((*self.names, *self.leftovers, *self.known))
            if name not in stay
            and not name.startswith(f"{RECORDS}/")
            and self._is_own(name, recorded)
            and _inode(self.folder / name) not in read
        ]

    @property
    def _files_read(self) -> dict[_Inode | None, Path]:
        """Return the inputs that are files, by inode."""
        return _files_of(path for path in self.inputs if not os.path.isdir(path))

    @property
    def _record_name(self) -> str:
        first = self.names[0]
        if len(os.fsencode(first)) > _LONGEST_NAME:
            import xxhash

            first = xxhash.xxh3_128_hexdigest(os.fsencode(first))
        return f"{RECORDS}/{self.command}-{first}.json"

    def _recorded_hashes(self) -> dict[str, set[str]]:
        """Return the content hashes of what the command wrote here, by name."""
        records = {name: {known} for name, known in self.known.items()}
        with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
            content = parse_json((self.folder / self._record_name).read_text(encoding="utf-8"))
            if content["schema"] == SCHEMA:
                for name, hashes in content["files"].items():
                    records.setdefault(name, set()).update(map(str, hashes))
        return records

    def _record(
        self,
        stage: Path,
        files: Mapping[str, Collection[str]],
        folder: Path,
        unfinished: Collection[str] = (),
    ) -> None:
        """Write the record of a folder, at once; ``stage`` is on the same file system."""
        content: dict[str, Any] = {
            "schema": SCHEMA,
            "files": {name: sorted(files[name]) for name in sorted(files)},
        }
        if unfinished:
            content["unfinished"] = sorted(unfinished)
        text = json.dumps(content, indent=1) + "\n"
        target = folder / self._record_name
        with suppress(OSError, ValueError):
            if target.read_text(encoding="utf-8") == text:
                return
        target.parent.mkdir(parents=True, exist_ok=True)
        written = stage / f"{RECORDS}-record"
        written.write_text(text, encoding="utf-8")
        os.replace(written, target)


def check_whole(path: Path) -> None:
    """Look whether a file belongs to a set of outputs that was replaced in full.

    Raises
    ------
    StapeskitError
        The command that wrote it was killed between two files, or is placing them at this moment.
    """
    path = Path(path)
    command = unfinished(path.parent).get(path.name)
    if command is not None:
        got = f"a part of it: {command} was ended while it replaced its outputs in {path.parent}"
        fault = Fault("a set of outputs", "whole", got, path.name, f"Run {command} again")
        raise StapeskitError(fault)


def unfinished(folder: Path) -> dict[str, str]:
    """Return the files of sets that are not all in place, each with the command that wrote it."""
    return {str(name): record["command"] for record in _records_of(folder) for name in record["unfinished"]}


def _records_of(folder: Path) -> Iterator[dict[str, Any]]:
    """Read the records in a folder whose files are not all in place."""
    with suppress(OSError):
        for path in sorted((folder / RECORDS).glob("*-*.json")):
            with suppress(OSError, ValueError, KeyError, TypeError):
                content = parse_json(path.read_text(encoding="utf-8"))
                if content["schema"] == SCHEMA and isinstance(content["unfinished"], list):
                    yield {"command": path.name.partition("-")[0], "unfinished": content["unfinished"]}


def _inode(path: Path) -> _Inode | None:
    """Return what names a file whatever path leads to it; None when there is none."""
    with suppress(OSError, ValueError):
        state = os.stat(path)
        return state.st_dev, state.st_ino
    return None


def _files_of(paths: Iterable[Path]) -> dict[_Inode | None, Path]:
    """Return files, also those within folders, by inode."""
    files: dict[_Inode | None, Path] = {}
    for path in paths:
        inside = [Path(top, name) for top, _, names in os.walk(path) for name in names]
        for file in (path, *inside):
            files.setdefault(_inode(file), file)
    files.pop(None, None)
    return files


def _name_files(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
