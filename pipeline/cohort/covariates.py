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
class Covariates:
    """The covariates of a cohort: a number is scaled, a text has a column for each group but the first.

    Attributes
    ----------
    groups : dict of str to tuple of str
        By name: values of a text; none of a number.
    columns : ndarray, (n, c)
        Of the ears, centred, so that a law holds at their means.
    centre, scale : ndarray, (c,)
        Mean of each column over the ears; standard deviation of a number over the ears, 1 for a text.
    """

    groups: Mapping[str, tuple[str, ...]]
    columns: Array
    centre: Array
    scale: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the covariates."""
        return tuple(self.groups)

    def of_ear(self, about: Mapping[str, Any]) -> Array:
        """Return the columns (c,) of a further ear.

        Raises
        ------
        StapeskitError
            A value is missing, or of another kind than those of the cohort.
        """
        for name, groups in self.groups.items():
            value, wanted = about.get(name), f"one of {', '.join(groups)}" if groups else "a number"
            if str(value) not in groups if groups else not _is_number(value):
                raise StapeskitError.of(f"the covariate {name}", wanted, value)
        return (_row(self.groups, about) - self.centre) / self.scale


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
    known, faults, groups = [described(ear) for ear in ears], list[Fault](), dict[str, tuple[str, ...]]()
    for name in dict.fromkeys(names):
        values = {ear.folder: about.get(name) for ear, about in zip(ears, known, strict=True)}
        numeric, kinds = (
            {*map(_is_number, values.values())},
            sorted({str(value) for value in values.values()}),
        )
        fault = _fault(f"the covariate {name}", name, values, kinds, numeric)
        faults += [] if fault is None else [fault]
        groups[name] = () if True in numeric else tuple(kinds)
    raise_all(faults)
    raw = np.array([_row(groups, about) for about in known], dtype=float).reshape(len(ears), -1)
    is_number = np.array([not own for own in groups.values() for _ in (own[1:] or ("",))], dtype=bool)
    spread = raw.std(axis=0, ddof=1) if len(groups) else np.ones(0)
    centre, scale = raw.mean(axis=0), np.where(is_number, spread, 1.0)
    columns = (raw - centre) / scale
    if np.linalg.matrix_rank(columns, tol=1e-9) < columns.shape[1]:
        step = "Leave one of them out"
        raise StapeskitError.of("the covariates", "independent of each other", ", ".join(groups), "", step)
    return Covariates(groups, columns, centre, scale)


def _row(groups: Mapping[str, tuple[str, ...]], about: Mapping[str, Any]) -> Array:
    """Return the entries of one ear, neither centred nor scaled."""
    own = [
        [str(about[name]) == one for one in of[1:]] if of else [about[name]] for name, of in groups.items()
    ]
    return np.array([entry for entries in own for entry in entries], dtype=float)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _fault(
    thing: str, name: str, values: Mapping[str, Any], kinds: Sequence[str], numeric: set[bool]
) -> Fault | None:
    """Return why a covariate cannot be used."""
    missing = [ear for ear, value in values.items() if value in (None, "")]
    if missing:
        step = f"Add {name} to [study] or [study.covariates] of these ears, or leave the covariate out"
        return Fault(thing, "given for every ear", f"none for {', '.join(missing)}", "", step)
    if len(numeric) > 1:
        return Fault(thing, "a number in every ear or a text in every ear", "both")
    if len(kinds) < 2:
        return Fault(thing, "different in some ears", f"{kinds[0]} in all", "", "Leave the covariate out")
    if True not in numeric and len(kinds) > len(values) // 2:
        step = "A text must name groups of ears; a quantity must be a number"
        return Fault(thing, "the same in groups of ears", f"{len(kinds)} values", "", step)
    return None
