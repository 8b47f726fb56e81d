"""Covariates of a cohort (age, sex, laboratory, ...) as centred columns, which laws are adjusted for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.cohort.ears import Ear
from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, raise_all


@dataclass(frozen=True)
class Coding:
    """How one covariate becomes columns: a number scaled, a text one column for each group but the first.

    Attributes
    ----------
    groups : tuple of str
        Values of a text.
    centre : ndarray, (columns,)
        Mean of each column over the ears.
    scale : float
        Standard deviation of a number over the ears.
    """

    name: str
    groups: tuple[str, ...] = ()
    centre: Array | float = 0.0
    scale: float = 1.0

    def columns(self, value: Any) -> Array:
        """Return the entries of one ear.

        Raises
        ------
        StapeskitError
            The value is missing, or of another kind than those of the cohort.
        """
        wanted = f"one of {', '.join(self.groups)}" if self.groups else "a number"
        if str(value) not in self.groups if self.groups else not _is_number(value):
            raise StapeskitError.of(f"the covariate {self.name}", wanted, value)
        own = [str(value) == group for group in self.groups[1:]] if self.groups else [value]
        return (np.array(own, dtype=float) - self.centre) / self.scale


@dataclass(frozen=True)
class Covariates:
    """The covariates of a cohort, centred, so that a law holds at their means; ``columns`` is (n, c)."""

    codings: tuple[Coding, ...]
    columns: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the covariates."""
        return tuple(coding.name for coding in self.codings)

    def of_ear(self, about: Mapping[str, Any]) -> Array:
        """Return the columns (c,) of a further ear; errors are those of `Coding.columns`."""
        return np.array([entry for one in self.codings for entry in one.columns(about.get(one.name))])


def described(ear: Ear) -> dict[str, Any]:
    """Return what is known of an ear by name, its side included."""
    return {**({"side": ear.side} if ear.side else {}), **ear.about}


def covariates_of(ears: Sequence[Ear], names: Sequence[str] = ()) -> Covariates:
    """Return the covariates of the ears as centred columns.

    Raises
    ------
    StapeskitError
        An ear lacks a covariate, a covariate is the same in all ears, mixes numbers with texts or has another
        value in nearly every ear, or one follows from the others: all of it in one error.
    """
    known = [described(ear) for ear in ears]
    made = [_coding(name, {ear.folder: about.get(name) for ear, about in zip(ears, known, strict=True)})
            for name in dict.fromkeys(names)]  # fmt: skip
    raise_all([one for one in made if isinstance(one, Fault)])
    codings = tuple(one for one in made if isinstance(one, Coding))
    rows = [[entry for one in codings for entry in one.columns(about[one.name])] for about in known]
    columns = np.array(rows, dtype=float).reshape(len(ears), -1)
    if np.linalg.matrix_rank(columns, tol=1e-9) < columns.shape[1]:
        listed, step = ", ".join(coding.name for coding in codings), "Leave one of them out"
        raise StapeskitError.of("the covariates", "independent of each other", listed, "", step)
    return Covariates(codings, columns)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _coding(name: str, values: Mapping[str, Any]) -> Coding | Fault:
    """Return how a covariate is coded, or why it cannot be."""
    thing = f"the covariate {name}"
    missing = [ear for ear, value in values.items() if value in (None, "")]
    if missing:
        step = f"Add {name} to [study] or [study.covariates] of these ears, or leave the covariate out"
        return Fault(thing, "given for every ear", f"none for {', '.join(missing)}", "", step)
    numeric = {_is_number(value) for value in values.values()}
    if len(numeric) > 1:
        return Fault(thing, "a number in every ear or a text in every ear", "both")
    texts = [str(value) for value in values.values()]
    groups = tuple(sorted(set(texts)))
    if len(groups) < 2:
        return Fault(thing, "different in some ears", f"{groups[0]} in all", "", "Leave the covariate out")
    if True not in numeric and len(groups) > len(texts) // 2:
        step = "A text must name groups of ears; a quantity must be a number"
        return Fault(thing, "the same in groups of ears", f"{len(groups)} values", "", step)
    plain = Coding(name) if True in numeric else Coding(name, groups)
    columns = np.array([plain.columns(value) for value in values.values()])
    scale = float(columns.std(ddof=1)) if True in numeric else 1.0
    return replace(plain, centre=columns.mean(axis=0), scale=scale)
