"""Outputs appear whole or not at all, and never over what a command read or did not make.

A record file in the output folder (``.stapeskit.json``) holds the SHA-256 of what each command wrote. A file
at an output's name whose hash is not there belongs to the user: it is refused, or with ``force`` replaced.
Inputs are never replaced.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from stapeskit.faults import Fault, StapeskitError, list_some, raise_all
from stapeskit.provenance import sha256

MANIFEST = ".stapeskit.json"


class Outputs:
    """The files ``names`` that one run of a command may write into a folder, which is made when it ends well.

    Those of an earlier run that are not written again are removed. ``inputs`` are the files and folders that
    the run reads; ``force`` replaces files that the record does not know.
    """

    def __init__(
        self, command: str, folder: Path, names: Iterable[str], inputs: Iterable[Path], force: bool = False
    ) -> None:
        self.command, self.folder, self.force = command, Path(folder).absolute(), force
        self.names = tuple(names)
        self._written = self.names
        files = [file for path in inputs for file in _with_contents(Path(path))]
        self._inputs = {key: file for file in files if (key := _identity(file)) is not None}

    def check(self, names: Iterable[str] = ()) -> None:
        """Look, before the work begins and again before placing, whether every output may be written.

        Raises
        ------
        StapeskitError
            The folder is a file, or an output is a folder, an input (also by a link) or a foreign file.
        """
        step = "Choose another folder or name (--out)"
        there = next(parent for parent in (self.folder, *self.folder.parents) if os.path.lexists(parent))
        if not there.is_dir():
            raise StapeskitError.of("the output folder", "a folder", f"the file {there}", "", step)
        if not os.access(there, os.W_OK | os.X_OK):
            raise StapeskitError.of("the output folder", "one that you may write to", there, "", step)
        faults, foreign = [], []
        known = _read_manifest(self.folder).get(self.command, {})
        for name in dict.fromkeys((*self.names, *names)):
            path = self.folder / name
            if path.is_dir():
                faults.append(Fault(f"the output {path}", "a file", "a folder", "", "Move it away"))
            elif (read := self._inputs.get(_identity(path) or (-1, -1))) is not None:
                faults.append(Fault(f"the output {path}", "another file than the inputs", read, "", step))
            elif self.force or not os.path.lexists(path):
                continue
            elif name not in known or known[name] != _hash_or_none(path):
                foreign.append(name)
        if foreign:
            expected, got = f"as {self.command} left them", f"others: {list_some(foreign)}"
            things = f"files at the names of outputs in {self.folder}"
            faults.append(Fault(things, expected, got, "", f"{step}, or replace them with --force"))
        raise_all(faults)

    @contextmanager
    def staged(self) -> Iterator[Path]:
        """Yield an empty folder on the same disk; its files become the outputs when the block ends well.

        It raises what `check` does.
        """
        self.check()
        near = next(folder for folder in (self.folder, *self.folder.parents) if folder.is_dir())
        with tempfile.TemporaryDirectory(prefix=".stapeskit-", dir=near, ignore_cleanup_errors=True) as name:
            stage = Path(name)
            yield stage
            files = sorted(path for path in stage.rglob("*") if path.is_file())
            written = {path.relative_to(stage).as_posix(): sha256(path) for path in files}
            self.check(written)
            self._written = tuple(written)
            manifest = _read_manifest(self.folder)
            earlier = manifest.get(self.command, {})
            stale = [name for name in earlier if name in self.names and name not in written]
            kept = {name: value for name, value in earlier.items() if name not in stale}
            content = {**manifest, self.command: {**kept, **written}}
            (stage / MANIFEST).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
            self.folder.mkdir(parents=True, exist_ok=True)
            for name in written:
                (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
                os.replace(stage / name, self.folder / name)
            for name in stale:
                (self.folder / name).unlink(missing_ok=True)
            os.replace(stage / MANIFEST, self.folder / MANIFEST)

    def unchanged(self) -> bool:
        """Return whether every file that the command is known to have written is there as it was."""
        listed = _read_manifest(self.folder).get(self.command, {})
        known = {name: value for name, value in listed.items() if name in self.names}
        return bool(known) and all(_hash_or_none(self.folder / one) == value for one, value in known.items())

    def paths(self) -> tuple[Path, ...]:
        """Return the outputs that are there, relative to the working folder where they lie within it."""
        known = _read_manifest(self.folder).get(self.command, {})
        folder = Path(os.path.relpath(self.folder)) if self.folder.is_relative_to(Path.cwd()) else self.folder
        return tuple(folder / name for name in known if name in self._written)


def written_in(folder: Path) -> dict[str, set[str]]:
    """Return the names of the files in a folder that each command is known to have written."""
    return {command: set(files) for command, files in _read_manifest(folder).items()}


def _read_manifest(folder: Path) -> dict[str, dict[str, str]]:
    try:
        content = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        return {command: dict(files) for command, files in content.items()}
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return {}


def _hash_or_none(path: Path) -> str | None:
    try:
        return sha256(path)
    except OSError:
        return None


def _identity(path: Path) -> tuple[int, int] | None:
    """Return device and number of the file that a path leads to; None when there is none."""
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_dev, stat.st_ino


def _with_contents(path: Path) -> Iterator[Path]:
    yield path
    if path.is_dir():
        yield from path.rglob("*")
