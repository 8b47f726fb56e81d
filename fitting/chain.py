"""Whether motion and mass files belong to one chain, and the warnings that come with them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from fitting.errors import FittingError
from stapeskit.faults import Fault
from stapeskit.provenance import content_hash
from stapeskit.records.mass_record import MassRecord
from stapeskit.records.motion import RigidMotion
from stapeskit.warnings import Notice


def check_chain(
    motion: RigidMotion, motion_file: Path, mass_file: Path, record: MassRecord | None, force: bool = False
) -> list[Notice]:
    """Compare the mass.json that the motion was computed with to the given one.

    Parameters
    ----------
    motion : RigidMotion
        Its provenance names the mass.json whose frames it used, with a content hash.
    motion_file, mass_file : Path
    record : MassRecord or None
        Of the mass file; None for a plain mass matrix, which belongs to no chain.
    force : bool
        Go on with another mass.json, with a warning.

    Returns
    -------
    list of Notice
        That the files do not belong together, and the warnings of mass.json with their source.

    Raises
    ------
    FittingError
        The motion was computed with another mass.json.
    """
    if record is None:
        return []
    travelling = [replace(notice, text=f"{mass_file.name}: {notice.text}") for notice in record.notices]
    used = _used(motion)
    if used is None:
        return travelling
    given = content_hash(mass_file, str(used["hash"]).startswith("sha256"))
    if given == used["hash"]:
        return travelling
    made = f"{used.get('file', 'mass.json')} of {used.get('modified', 'unknown date')} ({used['hash']})"
    got = f"{mass_file.name} with the content {given}"
    if not force:
        raise FittingError(
            Fault(
                "{mass}",
                f"the file whose frames {motion_file.name} was computed with, {made}",
                got,
                str(mass_file),
                f"Give that file, run points2dof again with {mass_file.name}, or force the fit by --force",
            )
        )
    text = f"{motion_file.name} was computed with the frames of {made}, not with {got} (--force)."
    return [Notice("other_mass_file", text), *travelling]


def _used(motion: RigidMotion) -> dict[str, Any] | None:
    """Return the record of the mass.json in the provenance of a motion; None where there is none."""
    inputs = motion.provenance.get("inputs")
    found = inputs.get("mass") if isinstance(inputs, dict) else None
    return found if isinstance(found, dict) and found.get("hash") else None
