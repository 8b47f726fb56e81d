"""From motion and mass to stiffness and damping: the function `stapeskit.dof2kd`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fitting.checks import result_notices
from fitting.data import data_of
from fitting.kd import fit_kd
from fitting.mass import Inertia, inertia_of
from fitting.options import KDOptions
from fitting.result import KDFit
from fitting.suspicions import suspicions
from fitting.verdict import follow_from_misreading
from stapeskit.command import no_progress
from stapeskit.faults import StapeskitError
from stapeskit.options import with_options
from stapeskit.provenance import document_hash, frames_hash, record
from stapeskit.records.mass_file import MassInput
from stapeskit.records.motion_file import RigidMotion, read_motion
from stapeskit.warnings import Notice, once

if TYPE_CHECKING:
    from stapeskit.command import Progress


@with_options(KDOptions)
def dof2kd(
    motion: Any,
    *,
    mass: MassInput | ArrayLike | None = None,
    force: bool = False,
    confirmed: Sequence[str] = (),
    **options: Any,
) -> KDFit:
    """Estimate stiffness and damping from motion and mass.

    Parameters
    ----------
    motion : path, RigidMotion or result of points2dof
    mass : path or result of ct2mass, MassMatrix, or array_like, (n, n)
        An array is in the order of ``dof``, SI, about the footplate centre in footplate axes. Left out: that
        of the result of points2dof, or the mass.json next to the file of the motion.
    force : bool
        Use a mass that is not the one whose frames the motion was computed with, with a warning.
    confirmed : sequence of str
        Codes of warnings that were checked: they do not lower the verdict.

    Raises
    ------
    StapeskitError
        An option is unknown (the nearest is named), or options or files are at fault; all of it together.

    Examples
    --------
    >>> fit = dof2kd(motion, mass=mass, band=(400, 5000))  # doctest: +SKIP
    """
    return fit_files(
        motion, mass, KDOptions.of(**options), force=force, confirmed=confirmed, command=["stapeskit.dof2kd"]
    )


def fit_files(
    motion: Any,
    mass: MassInput | ArrayLike | None,
    options: KDOptions,
    *,
    force: bool = False,
    confirmed: Sequence[str] = (),
    command: Sequence[str] | None = None,
    report: Progress = no_progress,
) -> KDFit:
    """Read motion and mass, where they are files, and fit; see `dof2kd`.

    ``command`` is for the provenance, None that of this process; ``report`` gets the step at work.
    """
    file = Path(motion) if isinstance(motion, str | os.PathLike) else None
    report("reading motion and mass")
    if mass is None:  # a result of points2dof keeps the mass whose frames it used
        own = getattr(motion, "mass", None)
        mass = find_mass(file) if own is None else own
    inertia = inertia_of(mass, options.dof, options.mass_sign)
    moved: RigidMotion = read_motion(file) if file is not None else getattr(motion, "motion", motion)
    provenance = record({"motion": file, "mass": inertia.source}, options.given(), command)
    report("fitting stiffness and damping")
    name = "the motion" if file is None else file.name
    return fit_of(moved, inertia, options, provenance, name, force, confirmed, report)


def find_mass(motion: Path | None) -> Path:
    """Return the mass.json next to a motion, or the only one of a folder ``*_mass`` there.

    Raises
    ------
    StapeskitError
        There is none, or more than one.
    """
    found: list[Path] = []
    if motion is not None:
        folder = Path(motion).absolute().parent
        own = folder / "mass.json"
        found = [own] if own.is_file() else sorted(folder.glob("*_mass/mass.json"))
    if len(found) != 1:
        got = "nothing" if not found else ", ".join(str(path.relative_to(folder)) for path in found)
        step = (
            "Name the one that belongs to the motion"
            if found
            else ("ct2mass writes mass.json; a plain M.csv serves as well")
        )
        raise StapeskitError.of("--mass", "a mass.json, or one next to the motion", got, "", step)
    return found[0]


def check_chain(motion: RigidMotion, motion_name: str, mass: Inertia, force: bool = False) -> list[Notice]:
    """Compare the mass.json that a motion was computed with to the given one; return what travels.

    Raises
    ------
    StapeskitError
        The motion was computed with another mass.json, unless ``force``.
    """
    known = mass.record
    if known is None:
        return []
    travelling = [replace(notice, text=f"mass: {notice.text}") for notice in known.notices]
    own, given = document_hash(known.raw), "the given mass" if mass.file is None else mass.file.name
    used = (motion.provenance.get("inputs") or {}).get("mass") or {}
    if used.get("document_hash"):
        same = used["document_hash"] == own
        origin = f"{used.get('file', 'mass.json')} of {used.get('modified', 'unknown date')}"
    else:
        same = motion.provenance.get("frames_hash") in (None, frames_hash(known.raw))
        origin = "the mass.json of its study"
    if same:
        return travelling
    if not force:
        wanted = f"the file whose frames {motion_name} was computed with, {origin}"
        got, where = f"{given} with the content {own}", "" if mass.file is None else str(mass.file)
        step = f"Give that file, run points2dof again with {given}, or use the given one by --force"
        raise StapeskitError.of("--mass", wanted, got, where, step)
    text = f"{motion_name} was computed with the frames of {origin}, not with {given} ({own}; --force)."
    return [Notice("other_mass_file", text), *travelling]


def fit_of(
    motion: RigidMotion,
    inertia: Inertia,
    options: KDOptions,
    provenance: Mapping[str, Any],
    motion_name: str = "the motion",
    force: bool = False,
    confirmed: Sequence[str] = (),
    report: Progress = no_progress,
) -> KDFit:
    """Fit, and keep with the fit what its record and page need: the one way of command, study, notebook.

    Raises
    ------
    StapeskitError
        Motion, mass and options do not fit together, or the data cannot determine the unknowns at all.
    """
    chain = check_chain(motion, motion_name, inertia, force)
    bodies = options.structure, options.base
    data = data_of(motion, inertia, options.dof, *bodies, options.band_hz, options.exclude_hz)
    try:
        known = (*chain, *inertia.notices, *motion.notices, *suspicions(data, options))
        misread = follow_from_misreading(known, confirmed)
        fit = fit_kd(data, inertia, options, causes="cause_found" not in misread)
        made_from = {**provenance, **_measured_files(motion), "motion_provenance": dict(motion.provenance)}
        fit = replace(fit, notices=known, provenance=made_from, confirmed=tuple(confirmed))
        more = (notice for notice in result_notices(fit) if notice.code not in misread)
        fit = replace(fit, notices=once([*known, *more]))
    except np.linalg.LinAlgError:
        wanted = "of sizes from which stiffness and damping follow"
        got = "equations without a finite solution"
        step = "Look for columns or bodies in each other's place, wrong units, lines far beyond the others"
        raise StapeskitError.of("motion and mass", wanted, got, "", step) from None
    if options.monte_carlo:
        from fitting.montecarlo import scatter

        fit = replace(fit, scatter=scatter(fit, options.monte_carlo, report=report))
    return fit


def _measured_files(motion: RigidMotion) -> dict[str, Any]:
    """Return the content hashes of the vibrometer files behind a motion."""
    inputs = motion.provenance.get("inputs") or {}
    hashes = {role: entry["hash"] for role, entry in inputs.items()
              if role.split()[0] == "ldv" and isinstance(entry, Mapping) and "hash" in entry}  # fmt: skip
    return {"measured": hashes} if hashes else {}
