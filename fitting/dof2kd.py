"""From motion and mass to stiffness and damping: the function `stapeskit.dof2kd`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fitting.checks import result_notices
from fitting.data import data_of
from fitting.kd import fit_kd
from fitting.mass import has_products, inertia_of, read_mass_csv, with_tensor_signs
from fitting.options import KDOptions
from fitting.result import KDFit
from fitting.suspicions import suspicions
from fitting.verdict import follow_from_misreading
from stapeskit.arrays import Array
from stapeskit.command import no_progress
from stapeskit.faults import StapeskitError
from stapeskit.options import with_options
from stapeskit.provenance import document_hash, frames_hash, record
from stapeskit.records.mass_file import HasMass, MassInput, read_mass
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.records.mass_record import MassRecord
from stapeskit.records.motion_file import RigidMotion, read_motion
from stapeskit.warnings import Notice, once

if TYPE_CHECKING:
    from stapeskit.command import Progress


@dataclass(frozen=True)
class MassSource:
    """A mass as it was given."""

    mass: MassMatrix | Array
    record: MassRecord | None = None  # the whole mass.json, where it is one
    file: Path | None = None
    notices: tuple[Notice, ...] = ()  # what was assumed of it
    source: Path | Mapping[str, Any] | None = None  # for the provenance


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

    Parameters
    ----------
    command : sequence of str, optional
        For the provenance; None: the command line of this process.
    report : callable
        Gets the step at work.
    """
    file = Path(motion) if isinstance(motion, str | os.PathLike) else None
    report("reading motion and mass")
    if mass is None:  # a result of points2dof keeps the mass whose frames it used
        own = getattr(motion, "mass", None)
        mass = find_mass(file) if own is None else own
    source = mass_source(mass, options)
    moved: RigidMotion = read_motion(file) if file is not None else getattr(motion, "motion", motion)
    provenance = record({"motion": file, "mass": source.source}, options.given(), command)
    report("fitting stiffness and damping")
    name = "the motion" if file is None else file.name
    return fit_of(moved, source, options, provenance, name, force, confirmed, report)


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


def mass_source(mass: Any, options: KDOptions) -> MassSource:
    """Read the mass matrix from a result of ct2mass, a mass.json, a plain CSV or an array.

    Raises
    ------
    StapeskitError
        It is none of them, or its file is at fault.
    """
    path = Path(mass) if isinstance(mass, str | os.PathLike) else None
    if path is not None and path.suffix.lower() != ".json":
        return replace(_plain(read_mass_csv(path, options.dof), options), file=path, source=path)
    if path is not None or isinstance(mass, HasMass | MassRecord):
        known = read_mass(mass)
        return MassSource(known.mass_matrix, known, known.file, source=known.provenance_input)
    if isinstance(mass, MassMatrix):
        return MassSource(mass)
    try:
        matrix = np.asarray(mass, dtype=float)
    except (TypeError, ValueError):
        wanted = "a file, a result of ct2mass or a matrix in SI"
        raise StapeskitError.of("the mass", wanted, type(mass).__name__) from None
    return _plain(matrix, options)


def _plain(matrix: Array, options: KDOptions) -> MassSource:
    """Return a plain matrix with elements of the inertia tensor, and a warning where that is assumed."""
    size = len(options.dof)
    if matrix.shape not in ((size, size), (6, 6)):
        want, got = f"{size} x {size} or 6 x 6", " x ".join(map(str, matrix.shape)) or "one number"
        step = f"Give M in the order of --dof, {','.join(options.dof)}, or of all six"
        raise StapeskitError.of("the mass matrix", want, got, "", step)
    if not has_products(matrix, options.dof):
        return MassSource(matrix)
    if options.mass_sign != "assumed":
        return MassSource(with_tensor_signs(matrix, options.dof, options.mass_sign))
    text = (
        "The mixed rotational entries of M were taken as elements of the inertia tensor, -integral of x z "
        "dm; with products of inertia of the other sign give --mass-sign positive, else --mass-sign tensor."
    )
    return MassSource(matrix, notices=(Notice("file_read", text),))


def check_chain(
    motion: RigidMotion, motion_name: str, source: MassSource, force: bool = False
) -> list[Notice]:
    """Compare the mass.json that a motion was computed with to the given one; return what travels.

    Raises
    ------
    StapeskitError
        The motion was computed with another mass.json, unless ``force``.
    """
    known = source.record
    if known is None:
        return []
    travelling = [replace(notice, text=f"mass: {notice.text}") for notice in known.notices]
    own, given = document_hash(known.raw), "the given mass" if source.file is None else source.file.name
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
        got, where = f"{given} with the content {own}", "" if source.file is None else str(source.file)
        step = f"Give that file, run points2dof again with {given}, or use the given one by --force"
        raise StapeskitError.of("--mass", wanted, got, where, step)
    text = f"{motion_name} was computed with the frames of {origin}, not with {given} ({own}; --force)."
    return [Notice("other_mass_file", text), *travelling]


def fit_of(
    motion: RigidMotion,
    source: MassSource,
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
    chain = check_chain(motion, motion_name, source, force)
    inertia = inertia_of(source.mass, options.dof)
    bodies = options.structure, options.base
    data = data_of(motion, inertia, options.dof, *bodies, options.band_hz, options.exclude_hz)
    raw = {} if source.record is None else source.record.raw
    try:
        known = (*chain, *source.notices, *motion.notices, *suspicions(data, options.damping))
        misread = follow_from_misreading(known, confirmed)
        fit = fit_kd(data, inertia, options, causes="cause_found" not in misread)
        made_from = {**_measured_files(motion), "motion_provenance": dict(motion.provenance)}
        fit = replace(
            fit,
            notices=known,
            provenance={**provenance, **made_from},
            outline_mm=_outline_of(raw),
            side=str((raw.get("frames") or {}).get("side") or ""),
            files=() if source.file is None else (source.file,),
            confirmed=tuple(confirmed),
        )
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


def _outline_of(raw: Mapping[str, Any]) -> Array | None:
    """Return x and z of the footplate's outline (points, 2), mm, in its axes; None without one."""
    found = (raw.get("found") or {}).get("footplate_outline_in_footplate_mm")
    outline = np.asarray([] if found is None else found, dtype=float)
    good = outline.ndim == 2 and outline.shape[1] in (2, 3) and len(outline) > 2
    return outline[:, [0, -1]] if good and np.all(np.isfinite(outline)) else None
