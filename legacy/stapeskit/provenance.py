"""Where a result comes from: input files with their content hash, versions, parameters, date, command."""

from __future__ import annotations

import errno
import json
import os
import platform
import sys
import threading
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from legacy.stapeskit.input_changes import InputStates
from legacy.stapeskit.temporary_folders import files_within

# Read pieces that stay in the processor's cache, large enough that other threads seldom interrupt: 2 GiB take
# 0.35 s, by quarters of it 0.41 s, by eight times as much 0.43 s.
_CHUNK = 1 << 21
_RELIED_ON = ("schema", "frames", "inertial_parameters", "mass_matrix")
# Key of the provenance of a motion that a study computed: the hash of the frames that it was tied to.
FRAMES_HASH = "frames_hash"
_FRAMES = ("scan_from_footplate", "scan_from_plate", "z_is", "pose_covariance")
_PACKAGES = ("stapeskit", "numpy", "scipy", "scikit-image", "trimesh", "pymeshlab")


def content_hash(path: Path, sha256: bool = False) -> str:
    """Return ``algorithm:hex`` of a file's bytes: xxh3-128, or SHA-256 when asked for.

    A folder is hashed over the names and bytes of its files in name order, without the temporary folders of
    runs. Once the program leaves, hashing stops.

    Raises
    ------
    OSError
        A file cannot be read.
    """
    if sha256:
        import hashlib

        digest: Any = hashlib.sha256()
    else:
        import xxhash

        digest = xxhash.xxh3_128()
    path = Path(path)
    files = files_within(path) if path.is_dir() else [path]
    window, program = memoryview(bytearray(_CHUNK)), threading.main_thread()
    for file in files:
        if path.is_dir():
            digest.update(os.fsencode(file.relative_to(path)))
        with file.open("rb", buffering=0) as stream:
            while count := stream.readinto(window):
                digest.update(window[:count])
                if not program.is_alive():
                    raise InterruptedError(errno.EINTR, "the program leaves")
    return f"{'sha256' if sha256 else 'xxh3_128'}:{digest.hexdigest()}"


class Hashes:
    """Content hashes of the files of a run: each file is hashed once.

    Parameters
    ----------
    paths : iterable of Path or None
        Files to hash in the background while other work goes on; None is left out. Others are hashed when
        they are asked for.
    sha256 : bool
        Use SHA-256 instead of the faster default.

    Notes
    -----
    A file whose size, modification time or inode has changed since is hashed again.
    """

    def __init__(self, paths: Iterable[Path | None] = (), sha256: bool = False) -> None:
        self._sha256 = sha256
        self._wanted = [Path(path) for path in paths if path is not None]
        self._done: dict[Path, tuple[InputStates, str | OSError]] = {}
        self._later: dict[Path, tuple[tuple[int, ...], str]] = {}
        self._versions: dict[str, str] = {}
        # No daemon, which can crash while the interpreter is taken down: see content_hash for how it ends.
        self._thread = threading.Thread(target=self._work, name="hashes")
        if self._wanted:
            self._thread.start()

    def _work(self) -> None:
        _lower_priority()
        for path in self._wanted:
            before = InputStates.of([path])
            try:
                self._done[path] = before, content_hash(path, self._sha256)
            except OSError as fault:
                self._done[path] = before, fault
        if threading.main_thread().is_alive():
            self._versions = versions()

    def versions(self) -> dict[str, str]:
        """Return the versions of what computes, looked up after the files were hashed."""
        self._join()
        self._versions = self._versions or versions()
        return self._versions

    def _join(self) -> None:
        """Wait for the files that are hashed in the background."""
        if self._wanted:
            self._thread.join()

    def of(self, path: Path) -> str:
        """Return the hash of a file, waiting for it when it is not ready yet.

        Raises
        ------
        OSError
            The file could not be read.
        """
        path = Path(path)
        if path not in self._wanted:
            return self._hash_once(path)
        self._join()
        before, value = self._done[path]
        if before != InputStates.of([path]):
            return self._hash_once(path)
        if isinstance(value, OSError):
            raise value
        return value

    def _hash_once(self, path: Path) -> str:
        stat = path.stat()
        state = (stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns)
        known = self._later.get(path)
        if known is None or known[0] != state:
            known = (state, content_hash(path, self._sha256))
            self._later[path] = known
        return known[1]


def _lower_priority() -> None:
    """Let the other threads run first, where the system ranks threads one by one (Linux)."""
    if not sys.platform.startswith("linux"):
        return
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)


def input_record(
    path: Path,
    sha256: bool = False,
    hashes: Hashes | None = None,
    document: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Describe one input: name, size in bytes, modification time (UTC, ISO 8601) and content hash.

    A mass.json has its ``document_hash`` as well; ``document`` is its content where that is in memory.
    """
    path = Path(path)
    stat = path.stat()
    size = sum(file.stat().st_size for file in files_within(path)) if path.is_dir() else stat.st_size
    modified = datetime.fromtimestamp(stat.st_mtime, UTC).isoformat(timespec="seconds")
    content = content_hash(path, sha256) if hashes is None else hashes.of(path)
    entry = {"file": path.name, "size_bytes": size, "modified": modified, "hash": content}
    if document is None and path.suffix.lower() == ".json":
        with suppress(OSError, ValueError, RecursionError):
            document = json.loads(path.read_text(encoding="utf-8"))
    if isinstance(document, Mapping) and "frames" in document:
        entry["document_hash"] = document_hash(document)
    return entry


def document_hash(document: Mapping[str, Any]) -> str:
    """Return ``algorithm:hex`` of the numbers of a mass.json that other results rely on.

    Parameters
    ----------
    document : mapping
        JSON-able. Date, command and whatever else does not move another result are left out.
    """
    return _hash_of_json({key: document[key] for key in _RELIED_ON if key in document})


def frames_hash(document: Mapping[str, Any]) -> str:
    """Return ``algorithm:hex`` of the frames of a mass.json, which is all that a motion takes from it.

    Unlike `document_hash` it is the same for another density, and for frames that were asked for elsewhere.
    """
    frames = document.get("frames", {})
    return _hash_of_json({key: frames.get(key) for key in _FRAMES})


def _hash_of_json(content: Mapping[str, Any]) -> str:
    import xxhash

    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return f"xxh3_128:{xxhash.xxh3_128_hexdigest(text.encode())}"


def versions() -> dict[str, str]:
    """Return the versions of Python, of stapeskit and of the packages its numbers come from."""
    entries = {"python": platform.python_version()}
    for name in _PACKAGES:
        version = _installed_versions().get(name) or _version_in_metadata(name)
        if version is not None:
            entries[name] = version
    return entries


@cache
def _installed_versions() -> dict[str, str]:
    """Return versions by package, from the folders that installers leave beside them (PEP 491)."""
    found: dict[str, str] = {}
    for folder in sys.path:
        with suppress(OSError, TypeError, ValueError):
            where = os.fsdecode(folder) or "."
            for entry in os.listdir(where):
                if entry.endswith(".dist-info"):
                    name, _, version = entry.removesuffix(".dist-info").partition("-")
                    name = name.lower().replace("_", "-")
                    # an upgrade that was broken off leaves folders that hold nothing
                    if name in _PACKAGES and os.path.isfile(os.path.join(where, entry, "METADATA")):
                        found.setdefault(name, version)
    return found


def _version_in_metadata(name: str) -> str | None:
    """Return what Python's search finds, which takes twenty times as long; None where it is not installed."""
    from importlib import metadata

    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def record(
    inputs: Mapping[str, Path | Mapping[str, Any] | None],
    parameters: Mapping[str, Any],
    calibrated: Mapping[str, str],
    command: Sequence[str] | None = None,
    sha256: bool = False,
    hashes: Hashes | None = None,
) -> dict[str, Any]:
    """Write the ``provenance`` block of a result.

    Parameters
    ----------
    inputs : mapping of str to Path, mapping or None
        Files by their role, or for what is in memory the entry itself; None is left out.
    parameters : mapping
        What the user chose and what was chosen for them, JSON-able.
    calibrated : mapping of str to str
        Which calibrated numbers the result depends on (`CalibratedNumbers.version`); empty: none.
    command : sequence of str, optional
        Defaults to the running command line, the program by its name alone.
    sha256 : bool
        Force SHA-256 as the content hash.
    hashes : Hashes, optional
        Content hashes that were begun before; then ``sha256`` is what they were begun with.
    """
    line = [Path(sys.argv[0]).name, *sys.argv[1:]] if command is None else list(command)
    packages = versions() if hashes is None else hashes.versions()
    return {
        "inputs": {
            role: dict(source) if isinstance(source, Mapping) else input_record(source, sha256, hashes)
            for role, source in inputs.items()
            if source is not None
        },
        "versions": {**packages, **calibrated},
        "parameters": dict(parameters),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": " ".join(line),
    }
