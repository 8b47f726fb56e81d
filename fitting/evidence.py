"""Which unknown of the table the data call for: scores, refits of a few, odds against none.

Odds are Laplace's (MacKay 1992, doi:10.1162/neco.1992.4.3.415): fall of chi2, less what the prior width of
the unknown costs, times its chance. Unknowns that are one error at different places share the chance, and
their odds are summed. Between damping laws, whose D have different units, the criterion of Schwarz (1978) is
used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import chdtri, log_ndtr, logsumexp

from fitting import entries
from fitting.data import Data
from fitting.laws import LAWS
from fitting.likelihood import LOAD, Likelihood
from fitting.solve import Fit, bic, fit, minimise, start_of, with_covariance
from fitting.unknowns import UNKNOWNS, Parts, Unknown, candidates
from stapeskit.arrays import Array

_SHORTLIST = 5  # refits of a search
_LEAST_ODDS = -4.0  # log odds of a score below which a refit changes nothing: a weight below 2 %
_LAW_CHANCE = 0.02  # that another damping law than the stated one holds
_BY_CHANCE = 1e-3  # p-value of a load above which it is not significant
_HOPELESS = 2.0  # times chi2 that another law leaves after a few steps, to be given up
LOOK_ALIKE = 3.0
"""Log odds within which explanations cannot be distinguished, none being one of them: e^3 = 20."""


@dataclass(frozen=True)
class Score:
    """An unknown to first order at a fit without it: size, sd and log odds against none.

    ``share`` is the part of the log odds that the other places of its family add.
    """

    unknown: Unknown
    value: float
    sd: float
    log_odds: float
    share: float = 0.0


@dataclass(frozen=True)
class Alternative:
    """A refit with one more unknown, or under another damping law."""

    value: float  # size of the unknown in its unit; for a law that of its own unknown
    sd: float  # size of the unknown in its unit; for a law that of its own unknown
    log_odds: float  # against the fit without it
    found: Fit = field(repr=False)
    unknown: Unknown | None = None  # none for a damping law

    @property
    def name(self) -> str:
        """Name of the unknown, or ``law_`` and that of the law."""
        return f"law_{self.found.law.name}" if self.unknown is None else self.unknown.name

    @property
    def title(self) -> str:
        """What it is, as written within a sentence."""
        return f"{self.found.law.name} damping" if self.unknown is None else self.unknown.title

    @property
    def unit(self) -> str:
        """Unit of its value."""
        return ("s" if self.found.law.kind.is_time else "") if self.unknown is None else self.unknown.unit

    @property
    def determined(self) -> bool:
        """Whether its size is above its standard deviation, and one that it can have."""
        one_sided = self.unknown is not None and self.unknown.positive
        return self.unknown is None or (self.value if one_sided else abs(self.value)) > self.sd


@dataclass(frozen=True)
class Search:
    """Scores of every unknown, the best of each family, and refits of the likeliest, best first."""

    scores: tuple[Score, ...] = ()
    alternatives: tuple[Alternative, ...] = ()

    @property
    def weights(self) -> Array:
        """Posterior probabilities of the alternatives; what they lack to one is that nothing is wrong."""
        odds = np.array([0.0, *(other.log_odds for other in self.alternatives)])
        return np.asarray(np.exp(odds - logsumexp(odds))[1:])

    @property
    def best(self) -> Alternative | None:
        """The likeliest alternative where it is clearly likelier than none."""
        likely = [other for other in self.alternatives if other.determined]
        return likely[0] if likely and likely[0].log_odds > LOOK_ALIKE else None

    @property
    def look_alikes(self) -> tuple[Alternative, ...]:
        """Alternatives that the data cannot distinguish from the best."""
        best = self.best
        if best is None:
            return ()
        least = max(best.log_odds - LOOK_ALIKE, 0.0)
        return tuple(other for other in self.alternatives if other is not best and other.log_odds > least)


def search(found: Fit, laws: bool = True) -> Search:
    """Score every unknown and refit with the likeliest; in a misfit also with those that may be large.

    Other damping ``laws`` are among the causes where the law was stated and not compared.
    """
    present = {unknown.name: unknown for unknown in found.likelihood.model.unknowns}
    table = [unknown for unknown in candidates(found.data) if unknown.name not in present]
    table += [UNKNOWNS[name].beyond(own.held) for name, own in present.items() if own.held is not None]
    *scores, power, relaxing = screen(found, [*table, *_LAW_SCORES])
    listed = _of_families(scores)
    misfit = not found.explained
    by_law = laws and (misfit or max(power.log_odds, relaxing.log_odds) > 0.0)
    likely = [score for score in listed if score.log_odds > _LEAST_ODDS][:_SHORTLIST]
    large = [score for score in listed if score not in likely and _may_be_large(score.unknown)]
    alternatives = _other_laws(found) if by_law else []
    for score in (*likely, *(large if misfit else ())):
        explained = any(other.found.explained for other in alternatives)
        if explained and score in large:
            break
        other = _refit(found, score, explained)
        alternatives += [] if other is None else [other]
    return Search(tuple(listed), tuple(sorted(alternatives, key=lambda other: -other.log_odds)))


def _may_be_large(unknown: Unknown) -> bool:
    """Return whether an unknown may be as large as the body itself: a linear test says little then."""
    return bool(unknown.starts) or unknown.name in ("inertia", "mirrored")


def _power(value: float, parts: Parts, data: Data) -> None:
    parts.loss = parts.loss + value * parts.loss * np.log(1j * data.omega)


def _relaxing(value: float, parts: Parts, data: Data) -> None:
    parts.loss = parts.loss + value * data.omega**2


_LAW_SCORES = (Unknown("law_power", "", "", 0.5, _power), Unknown("law_relaxation", "", "", 0.3, _relaxing))
"""Damping of another power of the frequency, and one that relaxes, to first order."""


def screen(found: Fit, table: Sequence[Unknown]) -> list[Score]:
    """Return unknowns outside the model to first order: the efficient score of each."""
    _, free = found.likelihood.outside(found.theta, table)
    information = np.maximum(np.sum(free**2, axis=0), 1e-12)
    values = -(free.T @ found.likelihood.residuals(found.theta)) / information
    return [
        Score(unknown, value, sd, log_odds(value, sd, unknown))
        for unknown, value, sd in zip(table, values.tolist(), (information**-0.5).tolist(), strict=True)
    ]


def log_odds(value: float, sd: float, unknown: Unknown) -> float:
    """Return the log odds of an unknown with the likelihood (value, sd) against none: prior and chance."""
    wide, chance = sd**2 + unknown.sd**2, np.log(unknown.chance)
    if unknown.only is not None:
        return float(0.5 * (value**2 - (value - unknown.only) ** 2) / sd**2 + chance)
    odds = 0.5 * value**2 * (1.0 / sd**2 - 1.0 / wide) + 0.5 * np.log(sd**2 / wide) + chance
    if unknown.positive:  # the half of the prior that is there, and the half of the posterior
        odds += np.log(2.0) + log_ndtr(value * unknown.sd / (sd * np.sqrt(wide)))
    return float(odds)


def _of_families(scores: Sequence[Score]) -> list[Score]:
    """Return the best score of each family with the odds of all its places, likeliest first."""
    families: dict[str, list[Score]] = {}
    for score in sorted(scores, key=lambda score: -score.log_odds):
        families.setdefault(score.unknown.family or score.unknown.name, []).append(score)
    found = []
    for members in families.values():
        odds = np.array([member.log_odds for member in members])
        share = float(logsumexp(odds - odds[0]) - np.log(len(members)))
        found.append(replace(members[0], log_odds=members[0].log_odds + share, share=share))
    return sorted(found, key=lambda score: -score.log_odds)


def _refit(found: Fit, score: Score, explained: bool) -> Alternative | None:
    """Fit with an unknown; None where it does not settle.

    Where another unknown explains the data, sizes far from first order are not tried.
    """
    own, model = score.unknown, found.likelihood.model
    unknown = own if own.only is None else own.fixed(own.only)
    model = replace(model, unknowns=(*model.unknowns, unknown))
    place, size = found.at["extra"].stop, 1 + len(unknown.companions)
    first = 0.0 if own.only is not None else max(score.value, 0.0) if own.positive else score.value
    best = None
    for value in (first, *unknown.starts):
        theta = np.insert(found.theta, place, [value, *np.zeros(size - 1)])
        if best is not None:
            better = best.chi2 < found.chi2  # else it ended in a valley: what is more can only explain more
            if better and (explained or best.explained):
                break
            theta = start_of(Likelihood(found.data, model, found.noise), theta, 2)
        try:
            tried = fit(found.data, model, theta, found.noise, rough=True)
        except np.linalg.LinAlgError:
            continue
        best = tried if best is None or tried.chi2 < best.chi2 else best
    if best is None:
        return None
    value, level = float(best.theta[place]), max(1.0, best.level)
    posterior = _rough_covariance(best)[place : place + size, place : place + size]
    sd = float(np.sqrt(posterior[0, 0]))
    widths = np.log([part.sd for part in (unknown, *unknown.companions)]).sum()
    odds = 0.5 * (found.chi2 - best.chi2) / level + 0.5 * np.linalg.slogdet(posterior)[1] - widths
    odds += np.log(unknown.chance) + score.share
    if unknown.positive:
        odds += np.log(2.0) + float(log_ndtr(value / sd))
    if own.only is not None:
        value, sd = own.only, 0.0
    return Alternative(value, sd, float(odds), best, unknown)


def _rough_covariance(found: Fit) -> Array:
    """Return the covariance of theta where noise of the regressor is no matter."""
    information = found.likelihood.information(found.theta)
    size = np.sqrt(np.diag(information))
    inverse = np.linalg.pinv(information / np.outer(size, size), rcond=1e-14, hermitian=True)
    return np.asarray(inverse / np.outer(size, size) * max(1.0, found.level) / max(found.noise, 1.0))


def _other_laws(found: Fit) -> list[Alternative]:
    """Refit under the damping laws that were not asked for; their exponents count as unknowns."""
    alternatives = []
    for name in LAWS:
        model = replace(found.likelihood.model, law=name)
        if name == found.likelihood.model.law:
            continue
        likelihood = Likelihood(found.data, model, found.noise)
        own = likelihood.mean[likelihood.at["law"]]
        theta = np.concatenate([found.theta[found.at["entries"]], own, found.theta[found.at["law"].stop :]])
        try:
            theta, rough, _, _ = minimise(likelihood, start_of(likelihood, theta, 2), 1e-2, 8)
            if rough > _HOPELESS * found.chi2 / found.noise:
                continue
            other = fit(found.data, model, theta, found.noise, rough=True)
        except np.linalg.LinAlgError:
            continue
        if other.law.physical:
            alternatives.append(law_alternative(found, other, _LAW_CHANCE))
    return alternatives


def law_alternative(found: Fit, other: Fit, chance: float = 1.0) -> Alternative:
    """Return a fit under another law, with the odds of the criterion of Schwarz times its chance."""
    level = max(1.0, min(found.level, other.level))
    odds = 0.5 * (bic(found, level) - bic(other, level)) + np.log(chance)
    law, sd = other.law, 0.0
    if law.free:
        place = other.at["law"].start
        sd = float(np.sqrt(_rough_covariance(other)[place, place]))
        sd = sd / other.data.reference if law.kind.is_time else sd
    return Alternative(law.value, sd, float(odds), other)


def most_moved_by_load(found: Fit) -> tuple[int, float]:
    """Return the entry that moves most when other measured motion is a load, and its share (0: chance)."""
    other = fit(found.data, replace(found.likelihood.model, motion=LOAD), found.theta, found.noise)
    other = with_covariance(other)
    count = found.at["entries"].stop
    change = other.theta[:count] - found.theta[:count]
    statistic = change @ np.linalg.solve(other.covariance[:count, :count], change)
    if statistic < max(float(chdtri(count, _BY_CHANCE)), 2.0 * count):
        return 0, 0.0
    relative = change / entries.sizes(*entries.split(found.theta[:count], found.likelihood.n))
    place = int(np.argmax(np.abs(relative)))
    return place, float(relative[place])
