"""Whether motion and mass files belong to one chain, and the warnings that come with them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from legacy.fitting.errors import FittingError
from legacy.stapeskit.option_names import named
from legacy.stapeskit.provenance import FRAMES_HASH, content_hash, document_hash, frames_hash
from legacy.stapeskit.records.mass_record import MassRecord
from legacy.stapeskit.records.motion import RigidMotion
from legacy.stapeskit.warnings import Notice


def check_chain(
    motion: RigidMotion,
    motion_name: str,
    record: MassRecord | None,
    mass_file: Path | None = None,
    force: bool = False,
) -> list[Notice]:
    """Compare the mass.json that the motion was computed with to the given one.

    Parameters
    ----------
    motion : RigidMotion
        Its provenance names the mass.json whose frames it used, with a content hash.
    motion_name : str
        Name of its file, or what it is.
    record : MassRecord or None
        The given mass; None for a plain mass matrix, which belongs to no chain.
    mass_file : Path or None
        Its file; None for a mass in memory.
    force : bool
        Continue with another mass.json, with a warning.

    Returns
    -------
    list of Notice
        That the files do not belong together, and the warnings of mass.json with their source.

    Raises
    ------
    FittingError
        The motion was computed with another mass.json. A file that differs only in the date and the command
        that made it is the same.
    """
    if record is None:
        return []
    name = "mass" if mass_file is None else mass_file.name
    travelling = [replace(notice, text=f"mass: {notice.text}") for notice in record.notices]
    used = _mass_record(motion)
    if used is None:
        origin, other_hash = "the mass.json of its study", _other_frames(motion, record)
    else:
        origin = f"{used.get('file', 'mass.json')} of {used.get('modified', 'unknown date')} ({used['hash']})"
        other_hash = _other_hash(used, record, mass_file)
    if other_hash is None:
        return travelling
    got = f"{name} with the content {other_hash}"
    if not force:
        raise FittingError.of(
            "{mass}",
            f"the file whose frames {motion_name} was computed with, {origin}",
            got,
            "" if mass_file is None else str(mass_file),
            f"Give that file, run points2dof again with {name}, or use the given one by {{force}}",
        )
    text = f"{motion_name} was computed with the frames of {origin}, not with {got} ({named('force')})."
    return [Notice("other_mass_file", text), *travelling]


def _other_frames(motion: RigidMotion, record: MassRecord) -> str | None:
    """Return the hash of the frames of the given mass where a motion of a study names others, else None."""
    own = frames_hash(record.raw)
    return None if motion.provenance.get(FRAMES_HASH) in (None, own) else own


def _other_hash(used: dict[str, Any], record: MassRecord, mass_file: Path | None) -> str | None:
    """Return the hash of the given mass where it differs from the mass of the motion, else None."""
    document = used.get("document_hash")
    own = document_hash(record.raw)
    if mass_file is None:
        return None if document in (None, own) else own
    content = content_hash(mass_file, str(used["hash"]).startswith("sha256"))
    return None if content == used["hash"] or document == own else content


def _mass_record(motion: RigidMotion) -> dict[str, Any] | None:
    """Return the record of the mass.json in the provenance of a motion; None where there is none."""
    inputs = motion.provenance.get("inputs")
    record = inputs.get("mass") if isinstance(inputs, dict) else None
    return record if isinstance(record, dict) and record.get("hash") else None
