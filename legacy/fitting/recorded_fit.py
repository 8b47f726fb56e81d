"""From motion and mass to a fit with its record: the one way of command, study and notebook."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.montecarlo import monte_carlo
from legacy.fitting.options import KDOptions
from legacy.fitting.results import KDResult
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.option_values import WithSd
from legacy.stapeskit.results import extend_result
from legacy.stapeskit.warnings import Notice, unique

if TYPE_CHECKING:
    from legacy.stapeskit.records.mass_record import MassMatrix, MassRecord
    from legacy.stapeskit.records.motion import RigidMotion


def kd_of(
    motion: RigidMotion,
    mass: MassMatrix | Array,
    options: KDOptions,
    record: MassRecord | None = None,
    provenance: Mapping[str, Any] | None = None,
    files: tuple[Path, ...] = (),
    chain: Sequence[Notice] = (),
) -> KDResult:
    """Fit stiffness and damping, and keep with the fit what its record and its page need.

    Parameters
    ----------
    mass : MassMatrix or ndarray, (n, n)
        An array is in the order of ``options.dof``, SI.
    options : KDOptions
        With ``monte_carlo``, the scatter of so many refits is kept with the fit.
    record : MassRecord, optional
        Of the same stapes, for the outline of its footplate and the gap around it.
    provenance : mapping, optional
    files : tuple of Path
        Every file that was read.
    chain : sequence of Notice
        Warnings that come with the files.

    Raises
    ------
    FittingError
        What `fitting.fit_kd.fit_kd` refuses.
    """
    fit = fit_kd(motion, mass, options)
    fit = replace(fit, notices=unique([*chain, *fit.notices]))
    return extend_result(
        KDResult,
        fit,
        provenance={**(provenance or {}), **measured_files(motion)},
        footplate_outline_mm=footplate_outline(record),
        ligament_gap_mm=window_gap(record),
        scatter=monte_carlo(fit, options.monte_carlo) if options.monte_carlo else None,
        files=files,
    )


def measured_files(motion: RigidMotion) -> dict[str, Any]:
    """Return the content hashes of the vibrometer files behind a motion, ``measured`` in the provenance."""
    inputs = motion.provenance.get("inputs") or {}
    hashes = {
        role: entry["hash"]
        for role, entry in inputs.items()
        if role.split()[0] == "ldv" and isinstance(entry, Mapping) and "hash" in entry
    }
    return {"measured": hashes} if hashes else {}


def footplate_outline(record: MassRecord | None) -> Array | None:
    """Return the footplate's outline in footplate axes (points, 2 or 3), mm, when mass.json holds one."""
    findings = {} if record is None else record.raw.get("found") or {}
    raw = findings.get("footplate_outline_in_footplate_mm")
    if raw is None:
        return None
    outline = np.asarray(raw, dtype=float)
    good = outline.ndim == 2 and outline.shape[1] in (2, 3) and len(outline) > 2
    return outline if good and np.all(np.isfinite(outline)) else None


def window_gap(record: MassRecord | None) -> WithSd | None:
    """Return the width of the gap around the footplate, mm, when mass.json holds one.

    The harmonic mean where there is one: over an uneven gap a ligament is as stiff as with that width.
    """
    findings = {} if record is None else record.raw.get("found") or {}
    value = float(findings.get("gap_harmonic_mm") or findings.get("gap_mm") or 0.0)
    sd = float(findings.get("gap_sd_mm") or 0.0)
    return WithSd((value, sd or None)) if 0.0 < value < np.inf and sd >= 0.0 else None
