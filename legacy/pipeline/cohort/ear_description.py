"""The description of an ear in its study file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from legacy.pipeline.study import About


def about_of(table: About) -> dict[str, Any]:
    """Return what ``[study]`` says of an ear, its covariates among the other columns."""
    names = ("side", "ear", "subject", "age", "sex", "group")
    stated = {name: getattr(table, name) for name in names}
    known = {name: value for name, value in stated.items() if value not in (None, "")}
    return {**known, **table.covariates}
