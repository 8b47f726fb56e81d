"""Detection, identification and adaptation of faults: which channel, point, laser or body is at fault.

Score tests of every kind of fault at every place, corrected for their number, detect; the most significant
suspects are fitted and weighed by their evidence; the culprit is left out, or corrected where all beams are
concerned, and the search repeated, so that one culprit is not blamed on its neighbours (Baarda 1968;
Teunissen 2018, doi:10.1007/s00190-017-1045-7). With several culprits each is judged again at the end with the
others gone.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from legacy.kinematics.faults.diagnosis import Diagnosis
from legacy.kinematics.faults.estimated_weights import equalise_noise
from legacy.kinematics.faults.findings import Finding, apply_finding, correct_findings, is_redundant
from legacy.kinematics.faults.flexible_body import no_structure
from legacy.kinematics.faults.laser_scatter import LaserScatter
from legacy.kinematics.faults.noise_size import channel_noise
from legacy.kinematics.faults.nuisance import (
    MOST_SDS,
    Nuisance,
    estimate_nuisance,
    information_of,
    likeliest_size,
)
from legacy.kinematics.faults.packed_readings import MOST_CHANNELS, Assumed, Packed, Source, initial
from legacy.kinematics.faults.point_noise import with_point_noise
from legacy.kinematics.faults.score_information import SHIFTS, State
from legacy.kinematics.faults.search import FALSE_ALARM, NOISE_ALONE, Search
from legacy.kinematics.fit.neglected_motion import extended_beams
from legacy.kinematics.fit.reference_noise import holds_record_noise
from legacy.kinematics.fit.rigid_fit import LineFit, refit
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.stapeskit.arrays import Array

# Share of the alarm probability of a finding next to others, by judgement: what remains holds the errors of
# their estimates. Alarms of clean files do not depend on it.
NEXT = 0.1
# Share of the energy of noise below which a misfit is rounding.
_ROUNDING = 1e-9
# From so many residual directions on, a misfit of one channel alone is that channel's.
_MANY = 30
# Scattered positions: fewest points, sizes that are sought (m, and levers), and how much more than stated.
_LEAST_POINTS, _SMALLEST_M, _OF_LEVER, _MORE = 4, 1e-7, 0.2, 1.5
# Up to so many points their errors are compared jointly: the memory goes with the square.
_MOST_POINTS = 1000
# Channels up to which all pairs are compared (180 000 pairs, 2 s). Pairs that are tried, and the share of the
# misfit that a pair must explain.
_MOST_PAIRED, _TRIED, _EXPLAINED = 600, 3, 0.9
# What each parameter of a single fault, and the choice of its place, costs of log likelihood next to these.
_PER_PARAMETER = 5.0


def too_large(body: BodyChannels, known: bool) -> bool:
    """Return whether a body has too many channels to be searched for faults.

    With stated noise and exact positions there is no limit.
    """
    exact = not np.any(np.nan_to_num(body.position_sd_mm) > 0.0)
    return len(body.points) > MOST_CHANNELS and not (known and exact)


def most_findings(body: BodyChannels) -> int:
    """Return the number of faults of one body beyond which it is said to bend."""
    return max(2, len(set(body.points)) // 3)


def diagnose(
    placed: Measurement,
    body: BodyChannels,
    fit: LineFit,
    known: bool,
    without: list[int] | None = None,
    lasers: LaserScatter | None = None,
    most: int | None = None,
) -> Diagnosis:
    """Search one body in one run for faults, with all degrees of freedom that its beams observe.

    Parameters
    ----------
    placed : Measurement
    body : BodyChannels
    fit : LineFit
        Of the degrees of freedom that are wanted.
    known : bool
        The noise is stated.
    without : list of int, optional
        Channels whose fault is known already.
    lasers : LaserScatter, optional
        Errors next to which faults are sought; none by default.
    most : int, optional
        0 or 1: as soon as there are plainly more faults than that the body is said to bend, and nothing else
        is sought. None: every fault is sought.

    Notes
    -----
    Nothing is searched with fewer than two lines, without noise, or in a body that is `too_large`.
    """
    lines = int(np.sum(np.isfinite(fit.q[:, 0].real)))
    if lines < 2 or fit.is_rounding() or too_large(body, known):
        return _nothing(fit)
    whole = refit(extended_beams(body, fit.beams.dof), fit) if len(fit.beams.dof) < 6 else fit
    data = initial(Source.of(whole, body, placed.freq_hz, known, placed.line_spread), body)
    if without:
        data = data.under(data.assumed.without(without))
    alarm = FALSE_ALARM / len(placed.runs) / len(placed.bodies)
    prior = np.nan_to_num(body.position_sd_mm) * 1e-3
    mixes = not holds_record_noise(placed, body)
    return _Diagnose(body, prior, known, mixes, alarm, lasers).run(data, most)


def _nothing(fit: LineFit) -> Diagnosis:
    """Return the diagnosis of data that are too few to search."""
    count = len(fit.beams.rows)
    used = np.sum(np.isfinite(fit.sd), axis=1)
    return Diagnosis((), np.ones(count), 1.0, no_structure(count), used, np.zeros((count, 3)))


class _Diagnose:
    """Searches of one body under the same priors."""

    def __init__(
        self,
        body: BodyChannels,
        prior: Array,
        known: bool,
        mixes: bool,
        alarm: float,
        lasers: LaserScatter | None,
    ) -> None:
        self.prior, self.known, self.mixes, self.alarm, self.lasers = prior, known, mixes, alarm, lasers
        self.layout = (body.reported_positions_mm, body.file_from_here)
        self.most = most_findings(body)

    def searched(self, data: Packed, share: float = 1.0, prior: Array | None = None) -> Search:
        """Search data; ``share`` of the alarm probability."""
        prior = self.prior if prior is None else prior
        alarm = share * self.alarm
        return Search(self._freed(data), prior, self.layout, self.known, alarm, self.lasers)

    def _freed(self, data: Packed) -> Packed:
        """Return data freed of the most probable errors of lasers.

        Lines that are gathered have one frequency for many: of an error that varies with it they leave what
        no rigid motion explains. Errors beyond belief are undone only if they leave nothing but noise:
        another fault makes them.
        """
        if self.lasers is None or not data.rest.size:
            return data
        near = estimate_nuisance(data, Nuisance.of(data, self.prior, self.lasers))
        freed = near.without_laser_errors(self.lasers)
        if np.max(np.abs(list(near.laser_errors(self.lasers).values()))) < MOST_SDS:
            return freed
        state = State.of(freed)
        level = 1.0 if self.known else channel_noise(state).level
        noise = level * float(np.sum(state.free())) * state.z.shape[2]
        if state.energy < NOISE_ALONE * noise:
            return freed
        return data.under(replace(data.assumed, lasers=(), laser_errors=np.zeros(0)))

    def prepared(self, data: Packed, share: float = 1.0) -> Search:
        """Search data with the noise that residuals show, where it is unknown or shared within points."""
        if not self.known:
            data = self._freed(data)
            data = equalise_noise(data, Nuisance.of(data, self.prior, self.lasers))
        search = self.searched(data, share)
        white = with_point_noise(search.state, search.noise) if self.mixes else search.data
        return search if white is search.data else self.searched(white, share)

    def after(self, data: Packed, culprit: Finding, findings: list[Finding]) -> Search:
        """Search again without a finding, with the noise estimated without the faulty channels."""
        left = apply_finding(data, culprit)
        if culprit.kind == "noise" or (self.known and left.whiten is None):
            return self.searched(left, NEXT)
        return self.prepared(left.under(self._as_stated(left.assumed, findings)), NEXT)

    def _as_stated(self, assumed: Assumed, findings: list[Finding]) -> Assumed:
        """Return assumptions without what residuals with a culprit showed of the noise."""
        if self.known:
            return replace(assumed, correlation=None)
        loud = np.where(np.isfinite(assumed.loud), 1.0, np.inf)
        for finding in findings:
            if finding.kind == "noise":
                loud[finding.channels] *= finding.size
        return replace(assumed, loud=loud, level=np.ones(1), correlation=None)

    def run(self, data: Packed, most: int | None) -> Diagnosis:
        """Search round after round, the culprit left out each time, until nothing is found."""
        first = search = self.prepared(data)
        if most is not None and first.more_than(most):
            return _diagnosis([first.flexible()], first, first)
        findings: list[Finding] = []
        kept = 1.0
        while (culprit := search.best()) is not None:
            if culprit.kind == "flexible":
                culprit = self._single(search.data, culprit, findings)
            if culprit.kind == "flexible" or len(findings) >= self.most:
                alone = not findings and culprit.kind == "flexible"
                return self._many(first, search, findings, culprit if alone else first.flexible())
            findings.append(culprit)
            search = self.after(search.data, culprit, findings)
            if len(findings) == 1 and culprit.owner != "body":
                kept = search.excess() / max(first.excess(), _ROUNDING * first.noise_energy, 1e-300)
        if len(findings) > 1:
            # The first was estimated beside the others.
            findings = self._again(_as_quiet(first.data, search.data, findings), findings)
        if findings and first.structure.significant:
            hidden = self._find_hidden(first, findings)
            if hidden is None:
                return self._many(first, search, findings, first.flexible())
            findings += hidden
        spread = self._find_scattered(first, findings) if len(findings) > 1 else None
        return _diagnosis([spread], first, first) if spread else _diagnosis(findings, first, search, kept)

    def _single(self, data: Packed, bending: Finding, findings: list[Finding]) -> Finding:
        """Return a fault at one place that with a few others leaves nothing, instead of a body that bends."""
        for other in bending.rivals:
            if other.fault is not None and self._ends_clean(data, [*findings, other]):
                return other
        return bending

    def _ends_clean(self, data: Packed, findings: list[Finding]) -> bool:
        """Return whether the last of the findings leaves nothing, or a few faults that leave nothing."""
        search = self.after(data, findings[-1], findings)
        while not search.clean():
            culprit = search.best()
            if culprit is None or culprit.kind == "flexible" or len(findings) >= self.most:
                return False
            findings = [*findings, culprit]
            search = self.after(search.data, culprit, findings)
        return True

    def _many(self, first: Search, last: Search, findings: list[Finding], otherwise: Finding) -> Diagnosis:
        """Return what explains a misfit at many places."""
        spread = self._find_scattered(first, findings)
        pair = None if spread is not None else self._find_masked(first)
        if pair is not None:
            return _diagnosis(pair[0], first, pair[1], 0.0)
        return _diagnosis([spread or otherwise], first, last)

    def _again(self, data: Packed, findings: list[Finding]) -> list[Finding]:
        """Test every finding again without the others."""
        confirmed: list[Finding] = []
        for number, finding in enumerate(findings):
            others = data
            for other in [*confirmed, *findings[number + 1 :]]:
                others = apply_finding(others, other)
            again = self.searched(others).best()
            if again is not None:
                both_whole = (again.owner == "body") == (finding.owner == "body")
                same = set(again.channels) & set(finding.channels) and again.kind != "flexible"
                confirmed.append(again if same and both_whole else finding)
        return confirmed or findings

    def _find_hidden(self, first: Search, findings: list[Finding]) -> list[Finding] | None:
        """Return faults of the channels that were left out already; None where the body bends.

        Notes
        -----
        To leave a channel out removes whatever it holds. With few channels a motion that is not rigid shows
        in one or two of them, and a factor that fits it partly is no explanation: undone by their estimates
        all findings must leave nothing. A single channel among many is believed. At channels that are left
        out a second fault does not show, but it does where the first is undone.
        """
        if len(findings) == 1 == len(findings[0].channels) and first.freedom >= _MANY:
            return []
        hidden: list[Finding] = []
        left_out = {channel for finding in findings for channel in finding.channels}
        while len(findings) + len(hidden) <= self.most:
            search = self._undone(first, [*findings, *hidden])
            if search.clean():
                return hidden
            culprit = search.best()
            if culprit is None or culprit.fault is None or not left_out.issuperset(culprit.channels):
                return None
            hidden.append(culprit)
        return None

    def _undone(self, first: Search, findings: list[Finding]) -> Search:
        """Search again with findings undone by their estimates, all channels kept."""
        undone = correct_findings(first.data, findings)
        return self.prepared(undone.under(self._as_stated(undone.assumed, findings)), NEXT)

    def _find_scattered(self, first: Search, findings: list[Finding]) -> Finding | None:
        """Return the finding that positions are off by more than stated, if it explains more."""
        if not _LEAST_POINTS <= len(first.points) <= _MOST_POINTS or first.freedom < 0.5:
            return None
        lever = first.data.source.beams.lever_m
        score, information = information_of(first.given, list(first.points.values()), SHIFTS)
        sizes = np.geomspace(_SMALLEST_M, _OF_LEVER * lever, 80)
        size, gain = likeliest_size(score / first.noise_variance, information / first.noise_variance, sizes)
        if not _MORE * float(np.max(self.prior, initial=0.0)) < size < lever:
            return None
        named = [(finding.drop, finding.fault.size) for finding in findings if finding.fault is not None]
        if gain < sum(drop / first.noise_variance - _PER_PARAMETER * (1 + size) for drop, size in named):
            return None
        if not self.searched(first.data, prior=np.full(len(self.prior), size)).clean():
            return None
        text = f"positions of all points off by about {size * 1e3:.2g} mm (standard deviation per axis)"
        p = min((finding.p_value for finding in [*findings, first.flexible()]), default=1.0)
        return Finding("position", list(first.live), p, size=size, text=text)

    def _find_masked(self, first: Search) -> tuple[list[Finding], Search] | None:
        """Return the faults of two channels that hide each other, and the search without them.

        Notes
        -----
        Faults that drift are left: two of them have enough parameters to pass for a body that bends.
        """
        if len(first.live) > _MOST_PAIRED or not first.exact:
            return None
        points = first.data.points
        pairs = [pair for pair in combinations(first.live, 2) if points[pair[0]] != points[pair[1]]]
        falls = first.given.left_out(np.array(pairs, dtype=np.intp).reshape(-1, 2))
        for k in np.argsort(-falls)[:_TRIED]:
            pair = list(pairs[k])
            if falls[k] <= _EXPLAINED * first.excess() or not is_redundant(first.data, pair):
                continue
            last, *alone = (
                self.searched(first.data.under(first.data.assumed.without(out)))
                for out in (pair, pair[1:], pair[:1])
            )
            if not last.clean():
                continue
            faults = [fault for search in alone if (fault := search.best()) is not None]
            named = [fault.channels for fault in faults if fault.fault is not None and fault.kind != "drift"]
            if named == [pair[:1], pair[1:]] and self._undone(first, faults).clean():
                return faults, last
        return None


def _as_quiet(data: Packed, left: Packed, findings: list[Finding]) -> Packed:
    """Return data with the noise that was found without the culprits."""
    loud = np.where(np.isfinite(left.assumed.loud), left.assumed.loud, data.assumed.loud)
    for finding in findings:
        if finding.kind == "noise":
            loud[finding.channels] = data.assumed.loud[finding.channels]
    assumed = replace(data.assumed, loud=loud, level=left.assumed.level, correlation=left.assumed.correlation)
    return data.under(assumed)


def _diagnosis(findings: list[Finding], first: Search, last: Search, kept: float = 1.0) -> Diagnosis:
    whole = any(finding.kind == "flexible" for finding in findings)
    shown = first if whole else last
    energy = first.energy.copy()
    energy[shown.live] = shown.energy[shown.live]
    return Diagnosis(
        tuple(findings),
        energy,
        last.level,
        shown.structure,
        np.round(first.columns).astype(np.int64),
        shown.offsets_m,
        1.0 if whole else kept,
        first.data.source.course,
    )
