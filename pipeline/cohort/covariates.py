"""Covariates of a cohort (age, sex, laboratory, ...) as centred columns, which laws are adjusted for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.cohort.ears import Ear
from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, raise_all


@dataclass(frozen=True)
class Coding:
    """How one covariate becomes columns.

    Attributes
    ----------
    centre, scale : float
        Mean and standard deviation over the ears, of a number.
    groups : tuple of str
        Values of a text; the first is the reference and has no column. Empty for a number.
    shares : tuple of float
        Share of the ears in each group with a column, which centres it.
    """

    name: str
    centre: float = 0.0
    scale: float = 1.0
    groups: tuple[str, ...] = ()
    shares: tuple[float, ...] = ()

    def columns(self, value: Any) -> list[float]:
        """Return the entries of one ear.

        Raises
        ------
        StapeskitError
            The value is of another kind than those of the cohort.
        """
        if not self.groups:
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise StapeskitError.of(f"the covariate {self.name}", "a number", value)
            return [(float(value) - self.centre) / self.scale]
        if str(value) not in self.groups:
            raise StapeskitError.of(f"the covariate {self.name}", f"one of {', '.join(self.groups)}", value)
        pairs = zip(self.groups[1:], self.shares, strict=True)
        return [float(str(value) == group) - share for group, share in pairs]


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
        """Return the columns (c,) of a further ear.

        Raises
        ------
        StapeskitError
            A covariate is missing, or has a value that the cohort does not have.
        """
        missing = [name for name in self.names if about.get(name) in (None, "")]
        raise_all(
            Fault(f"the covariate {name}", "given for the ear to be predicted", "none") for name in missing
        )
        return np.array([entry for coding in self.codings for entry in coding.columns(about[coding.name])])


def no_covariates(ears: int) -> Covariates:
    """Return covariates without any column."""
    return Covariates((), np.zeros((ears, 0)))


def described(ear: Ear) -> dict[str, Any]:
    """Return what is known of an ear by name, its side included."""
    return {**({"side": ear.side} if ear.side else {}), **ear.about}


def covariates_of(ears: Sequence[Ear], names: Sequence[str]) -> Covariates:
    """Return the covariates of the ears as centred columns.

    Parameters
    ----------
    names : sequence of str
        Numbers are scaled to a standard deviation of 1; texts have a column for each value but the first.

    Raises
    ------
    StapeskitError
        An ear lacks a covariate, a covariate is the same in all ears, mixes numbers with texts or has another
        value in nearly every ear, or one follows from the others: all of it in one error.
    """
    faults: list[Fault] = []
    known = [described(ear) for ear in ears]
    codings = []
    for name in dict.fromkeys(names):
        found = _coding(name, [about.get(name) for about in known], [ear.name for ear in ears])
        if isinstance(found, Fault):
            faults.append(found)
        else:
            codings.append(found)
    raise_all(faults)
    rows = [[entry for coding in codings for entry in coding.columns(about[coding.name])] for about in known]
    columns = np.array(rows, dtype=float).reshape(len(ears), -1)
    if np.linalg.matrix_rank(columns, tol=1e-9) < columns.shape[1]:
        listed = ", ".join(coding.name for coding in codings)
        step = "Leave one of them out"
        raise StapeskitError.of("the covariates", "independent of each other", listed, "", step)
    return Covariates(tuple(codings), columns)


def _coding(name: str, values: Sequence[Any], ears: Sequence[str]) -> Coding | Fault:
    """Return how a covariate is coded, or why it cannot be."""
    thing = f"the covariate {name}"
    missing = [ear for ear, value in zip(ears, values, strict=True) if value in (None, "")]
    if missing:
        step = f"Add {name} to [study] or [study.covariates] of these ears, or leave the covariate out"
        return Fault(thing, "given for every ear", f"none for {', '.join(missing)}", "", step)
    numeric = [isinstance(value, int | float) and not isinstance(value, bool) for value in values]
    if any(numeric) and not all(numeric):
        return Fault(thing, "a number in every ear or a text in every ear", "both")
    texts = [str(value) for value in values]
    groups = tuple(sorted(set(texts)))
    if len(groups) < 2:
        step = "Leave the covariate out"
        return Fault(thing, "different in some ears", f"{groups[0]} in all", "", step)
    if all(numeric):
        numbers = np.array(values, dtype=float)
        return Coding(name, float(numbers.mean()), float(numbers.std(ddof=1)))
    if len(groups) > len(values) // 2:
        step = "A text must name groups of ears; a quantity must be a number"
        return Fault(thing, "the same in groups of ears", f"{len(groups)} values", "", step)
    return Coding(name, groups=groups, shares=tuple(texts.count(g) / len(texts) for g in groups[1:]))
