"""Act on findings: correct the measurement by their estimates, or leave their channels out."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from legacy.kinematics.faults.catalogue import KINDS, Fault
from legacy.kinematics.faults.diagnosis import Diagnosis
from legacy.kinematics.faults.findings import Finding, channel_list, describe
from legacy.kinematics.fit.beams import observability
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.warnings import Notice

Key = tuple[int, int]
CORRECTED, LEFT_OUT, RAISED = "corrected", "left out", "its sd raised"
# Weakest observability of the motion that the channels that stay must keep; channels more than motions.
_OBSERVED, _SPARE = 1e-3, 2


@dataclass(frozen=True)
class Correction:
    """What is done about one finding.

    Attributes
    ----------
    run, body : int
        Where it was found; geometry is corrected in all runs.
    channels : list of int
    action : str
        CORRECTED, LEFT_OUT or RAISED.
    verdict, estimate : str
        Of the finding, in words.
    finding : Finding
    before : BodyChannels, optional
        The body before its geometry is corrected.
    factor : ndarray, (p + 1, freq), complex
        By what the readings are divided, and its relative derivatives; empty for geometry.
    """

    run: int
    body: int
    channels: list[int]
    action: str
    verdict: str
    estimate: str
    finding: Finding
    before: BodyChannels | None = None
    factor: ComplexArray = field(default_factory=lambda: np.zeros((0, 0), dtype=complex))

    @property
    def fault(self) -> Fault | None:
        """The fault of the catalogue that is corrected."""
        return self.finding.fault if self.action == CORRECTED else None

    @property
    def parameters(self) -> Array:
        """Its size (p,); empty for what has none."""
        return np.zeros(0) if self.fault is None else self.finding.parameters

    @property
    def covariance(self) -> Array:
        """Of the parameters, (p, p)."""
        return self.finding.covariance

    def as_json(self, measurement: Measurement) -> dict[str, Any]:
        """Return what was done by the names of the files; readings were divided by the factor, where any."""
        body = measurement.bodies[self.body]
        return {
            "run": measurement.runs[self.run],
            "body": body.body,
            "points": list(dict.fromkeys(body.points[c] for c in self.channels)),
            "verdict": self.verdict,
            "estimate": self.estimate,
            "action": self.action,
        }

    def corrected(self, measurement: Measurement) -> Measurement:
        """Return a measurement after the correction."""
        body = self._body(measurement, measurement.bodies[self.body])
        bodies = measurement.bodies
        return replace(measurement, bodies=(*bodies[: self.body], body, *bodies[self.body + 1 :]))

    def _body(self, measurement: Measurement, body: BodyChannels) -> BodyChannels:
        finding, fault, own = self.finding, self.fault, self.channels
        if self.action == RAISED:
            return _louder(measurement, body, self.run, own, finding.size)
        if finding.remedied is not None:
            sd = finding.remedied.sd
            return body.with_run(
                self.run, finding.remedied.displacement[self.run], None if sd is None else sd[self.run]
            )
        value, spread = body.displacement[self.run].copy(), None
        if self.action == LEFT_OUT:
            value[own] = np.nan
            return body.with_run(self.run, value)
        if len(self.factor):
            value[own] /= self.factor[0]
            if body.sd is not None:
                spread = np.array(body.sd[self.run])
                spread[own] /= np.abs(self.factor[0])
            return body.with_run(self.run, value, spread)
        if fault is None:
            return replace(body, position_sd_mm=np.fmax(body.position_sd_mm, 1e3 * finding.size))
        arms, directions = fault.geometry(body.positions_mm * 1e-3, body.directions, self.parameters)
        sd_mm = body.position_sd_mm.copy()
        if fault.kind == "position":
            sd_mm[own] = np.nan  # the error that is left is that of the estimate
        return replace(body, positions_mm=arms * 1e3, directions=directions, position_sd_mm=sd_mm)


def _louder(
    measurement: Measurement, body: BodyChannels, run: int, channels: list[int], factor: float
) -> BodyChannels:
    """Return a body with the noise of channels raised; unstated noise is relative then."""
    rate = (2.0 * np.pi * measurement.freq_hz) ** measurement.order
    sd = np.array(np.broadcast_to(1.0 / rate, body.displacement.shape) if body.sd is None else body.sd)
    sd[run, channels] *= factor
    return replace(body, sd=sd, relative=body.relative or body.sd is None)


def corrections_of(
    placed: Measurement,
    fits: dict[Key, LineFit],
    diagnoses: dict[Key, Diagnosis],
    before: Iterable[Correction] = (),
) -> list[Correction]:
    """Return what is done about each finding that can be acted on.

    Fits and diagnoses by (run, body), of ``placed`` as it was searched; what was corrected ``before`` and is
    found again in the same channels is left out.

    Notes
    -----
    A fault is corrected where the data determine its size and tell it from other faults. Otherwise its
    channels are left out, where the others still determine the motion. Of the same change of geometry
    found in several runs the mean is used, weighted by the information. Readings without a cause are those of
    all channels: what is done to single ones follows.
    """
    seen = {(earlier.body, channel) for earlier in before for channel in earlier.channels}
    corrections: list[Correction] = []
    for (run, number), diagnosis in sorted(diagnoses.items()):
        fit = fits[run, number]
        for finding in diagnosis.findings:
            again = any((number, channel) in seen for channel in finding.channels)
            correction = _correction(placed, fit, (run, number), finding, again)
            if correction is None:
                continue
            same = [k for k, chosen in enumerate(corrections) if _same_geometry(chosen, correction)]
            if same:
                corrections[same[0]] = _pool(corrections[same[0]], correction)
            elif not any(_overlap(chosen, correction) for chosen in corrections):
                corrections.append(correction)
    return sorted(corrections, key=lambda correction: correction.finding.remedied is None)


def _general(finding: Finding) -> Finding | None:
    """Return, of kinds of fault at one place that contain each other, the one that contains all."""
    suspects = (finding, *finding.rivals)
    if not finding.rivals or any(s.kind not in KINDS or s.channels != finding.channels for s in suspects):
        return None
    every = {tangent for suspect in suspects for tangent in KINDS[suspect.kind].tangents}
    return next(
        (replace(suspect, rivals=()) for suspect in suspects if every <= {*KINDS[suspect.kind].tangents}),
        None,
    )


def _overlap(first: Correction, second: Correction) -> bool:
    """Return whether two corrections concern the same channels, in one run or through the geometry."""
    if first.body != second.body or not set(first.channels) & set(second.channels):
        return False
    both_values = first.run != second.run and all(c.fault is None or len(c.factor) for c in (first, second))
    return not both_values and first.finding.remedied is None and second.finding.remedied is None


def _same_geometry(first: Correction, second: Correction) -> bool:
    one, two = first.fault, second.fault
    if one is None or two is None or len(first.factor):
        return False
    return (first.body, one.kind, first.channels) == (second.body, two.kind, second.channels)


def _pool(first: Correction, second: Correction) -> Correction:
    """Return the mean of two estimates of one error, weighted by their information."""
    if not len(first.parameters):
        return first
    inverse = partial(np.linalg.pinv, rcond=1e-12, hermitian=True)
    one, two = inverse(first.covariance), inverse(second.covariance)
    covariance = inverse(one + two)
    mean = covariance @ (one @ first.parameters + two @ second.parameters)
    return replace(first, finding=replace(first.finding, parameters=mean, covariance=covariance))


def _correction(
    placed: Measurement, fit: LineFit, key: Key, finding: Finding, again: bool
) -> Correction | None:
    run, number = key
    body = placed.bodies[number]
    verdict, estimate = describe(finding, body)
    corrected = Correction(run, number, list(finding.channels), CORRECTED, verdict, estimate, finding)
    if finding.remedied is not None or (
        finding.kind == "position" and finding.fault is None and finding.size > 0.0
    ):
        return None if again and finding.remedied is None else corrected
    if finding.kind == "flexible" or finding.code:
        return None
    if finding.kind == "noise" and not again:
        return replace(corrected, action=RAISED)
    factor = finding.factor_at(placed.freq_hz)
    determined = _is_determined(finding, fit.beams.lever_m, factor)
    if finding.fault is None or finding.rivals or again or not determined:
        out = sorted({c for suspect in (finding, *finding.rivals) for c in suspect.channels})
        if _spares(body, fit, out):
            return replace(corrected, action=LEFT_OUT, channels=out)
        general = None if again else _general(finding)
        return None if general is None else _correction(placed, fit, key, general, again)
    covariance = finding.covariance
    stated = np.nan_to_num(body.position_sd_mm[finding.channels[0]]) * 1e-3
    if finding.kind == "position" and stated > 0.0:
        # Next to the fault the stated error of the point itself is free within its prior, and adds that.
        values, vectors = np.linalg.eigh(covariance - stated**2 * np.eye(len(covariance)))
        covariance = (vectors * np.maximum(values, 0.0)) @ vectors.T
    finding = replace(finding, covariance=covariance)
    return replace(corrected, finding=finding, before=body, factor=factor)


def _is_determined(finding: Finding, lever_m: float, factor: ComplexArray) -> bool:
    """Return whether the size of a fault is known better than by what is common.

    Readings that are divided by a factor (p + 1, freq) next to zero hold its error many times.
    """
    if finding.fault is None or not finding.fault.size:
        return True
    scale = finding.fault.scale(lever_m) * (
        max(float(np.min(np.abs(factor[0]))), 1e-100) if len(factor) else 1.0
    )
    scaled = finding.covariance / np.outer(scale, scale)
    return bool(np.max(np.linalg.eigvalsh(scaled)) < 1.0)


def _spares(body: BodyChannels, fit: LineFit, out: list[int]) -> bool:
    """Return whether the other channels determine the motion with some redundancy."""
    rest = [c for c in range(len(body.points)) if c not in set(out) and fit.solution.used[c] > 0]
    dof = fit.beams.dof
    if len(rest) < len(dof) + _SPARE:
        return False
    return bool(observability(body.positions_mm[rest] * 1e-3, body.directions[rest], dof)[-1] > _OBSERVED)


def shown(corrections: Iterable[Correction], diagnoses: dict[Key, Diagnosis]) -> dict[Key, Diagnosis]:
    """Return diagnoses that name what was corrected, too, as it was found."""
    named = dict(diagnoses)
    for correction in corrections:
        key = (correction.run, correction.body)
        words = f"{correction.estimate}; {correction.action}"
        step = f"Correct the file: this run went on with it {correction.action}"
        finding = replace(
            correction.finding, kind=correction.verdict, fault=None, rivals=(), text=words, step=step
        )
        named[key] = replace(named[key], findings=(finding, *named[key].findings))
    return named


def correction_notices(placed: Measurement, corrections: Iterable[Correction]) -> list[Notice]:
    """Return one warning for each correction."""
    notices = []
    for correction in corrections:
        body = placed.bodies[correction.body]
        where = f" in run {placed.runs[correction.run]}" if len(placed.runs) > 1 else ""
        whole = len(correction.channels) == len(body.points)
        names = f"body {body.body}" if whole else channel_list(correction.channels, body)
        text = f"{names}{where}: {correction.verdict}, {correction.estimate}; {correction.action}."
        notices.append(Notice("corrected", text))
    return notices
