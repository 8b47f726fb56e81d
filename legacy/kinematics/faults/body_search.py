"""Search one body in one run for faults, and choose the motion in which they are looked for."""

from __future__ import annotations

from dataclasses import replace

from legacy.kinematics.faults.catalogue import OF_MANY
from legacy.kinematics.faults.diagnose import diagnose, most_findings
from legacy.kinematics.faults.diagnosis import Diagnosis
from legacy.kinematics.faults.findings import Finding
from legacy.kinematics.faults.laser_scatter import LaserScatter
from legacy.kinematics.fit.body_noise import fit_with_noise
from legacy.kinematics.fit.neglected_motion import extended_beams
from legacy.kinematics.fit.reference_noise import bound_record_noise
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.measurement import BodyChannels, Measurement


def search_body(
    placed: Measurement,
    run: int,
    body: BodyChannels,
    fit: LineFit,
    known: bool,
    lasers: LaserScatter | None = None,
    most: int | None = None,
) -> tuple[Diagnosis, LineFit]:
    """Search one body in one run for faults, and return the fit in which they were looked for.

    Notes
    -----
    Where records have the noise of a reference to themselves, a fault counts only while the motion of least
    variance shows one, and is named by the usual fit: the culprit is left out and the motion found anew.
    """
    basis = extended_beams(body, fit.beams.dof).basis
    bound = bound_record_noise(placed, run, body, basis)
    if bound is None or not known:
        return diagnose(placed, body, fit, known, lasers=lasers, most=most), fit
    usual = fit_with_noise(placed, run, bound[0], fit.beams, fit.robust)[0]

    def search_without(without: list[int], out: list[int]) -> Diagnosis:
        """Search without some channels, in a motion that may hold nothing of others."""
        moved = bound_record_noise(placed, run, body, basis, without=without, left=out)
        again = usual if moved is None else fit_with_noise(placed, run, moved[1], fit.beams, fit.robust)[0]
        return diagnose(placed, body, again, known, out, lasers)

    findings: list[Finding] = []
    first = last = search_without([], [])
    most = most_findings(body)
    while last.findings:
        out = sorted({channel for finding in findings for channel in finding.channels})
        named = diagnose(placed, body, usual, known, out, lasers)
        found = (named.findings or last.findings)[0]
        if found.kind == "flexible" or found.owner in OF_MANY or len(findings) >= most:
            whole = named if named.findings else last
            return replace(whole, findings=(*findings, *whole.findings[:1])), usual
        findings.append(found)
        out = sorted({*out, *found.channels})
        last = search_without(out, out)
    return replace(last, findings=tuple(findings), kept=first.kept), usual
