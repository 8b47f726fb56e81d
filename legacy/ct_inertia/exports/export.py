"""Choose formats by name, write them, and state the units and coordinates of each."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.export_formats import EXPORTS, FORMATS
from legacy.ct_inertia.exports.body import body_of

if TYPE_CHECKING:
    from legacy.ct_inertia.ct2mass import MassMeasurement
    from legacy.ct_inertia.surface.surface import Surface


def parse_formats(text: str) -> tuple[str, ...]:
    """Read a comma list of formats, in the order of FORMATS; ``all`` selects every one.

    Raises
    ------
    CtInertiaError
        A name is unknown, or the list is empty.
    """
    names = {part.strip().lower() for part in text.split(",") if part.strip()}
    if names == {"all"}:
        return FORMATS
    wrong = sorted(names - set(FORMATS))
    if wrong or not names:
        raise CtInertiaError.of(
            "{export}",
            f"a list out of {', '.join(FORMATS)}, or all",
            ", ".join(wrong) or "nothing",
            next_step="Write for example {export} stl,mjcf",
        )
    return tuple(name for name in FORMATS if name in names)


def export(
    result: MassMeasurement,
    folder: Path | str,
    formats: str | Iterable[str] = "all",
    stapes: Surface | None = None,
) -> list[str]:
    """Write a result in the formats of other programs.

    The mass, centre and inertia are those of the stapes with everything added to it (``--add-mass``).

    Parameters
    ----------
    result : MassMeasurement
    folder : Path or str
        Made when missing.
    formats : str or iterable of str
        Names out of FORMATS, or ``all``.
    stapes : Surface, optional
        A lighter surface to write in place of the measured one; it changes no number.

    Returns
    -------
    list of str
        Names of the files, each once.

    Raises
    ------
    CtInertiaError
        An unknown format.
    """
    chosen = parse_formats(formats if isinstance(formats, str) else ",".join(formats))
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    body = body_of(result, stapes)
    names: list[str] = []
    for name in chosen:
        write: Callable[[Any, Path], list[str]] = _module(name).write
        names += [file for file in write(body, folder) if file not in names]
    return names


def files_of(formats: Iterable[str]) -> tuple[str, ...]:
    """Return the files that exports in these formats may write."""
    return tuple(dict.fromkeys(name for format_name in formats for name in EXPORTS[format_name].files))


def units_of(formats: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return units and coordinates of each format, for the JSON."""
    return {name: dict(_module(name).UNITS) for name in formats}


def _module(name: str) -> Any:
    return import_module(f"legacy.ct_inertia.exports.{EXPORTS[name].module}")
