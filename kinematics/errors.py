"""The faults a user can cause, and the one sentence form in which they are told."""

from __future__ import annotations

from collections.abc import Iterable


class StapeskitError(ValueError):
    """Base of every error that the user's input can cause; the commands end with exit code 2 on it."""


class KinematicsError(StapeskitError):
    """A fault in frames, vibrometer tables, registration or motion files."""


def sentence(thing: str, expected: str, got: object, where: str = "", next_step: str = "") -> str:
    """Write one fault as ``<thing> must be <expected>; got <value> (where). <next step>.``

    Parameters
    ----------
    thing, expected : str
        What is wrong and what it must be.
    got : object
        The value found; shown as given.
    where : str
        File, row or field; left out when empty.
    next_step : str
        What the user can do; left out when empty.
    """
    place = f" ({where})" if where else ""
    stop = "" if next_step.endswith("?") else "."
    step = f" {next_step.rstrip('.')}{stop}" if next_step else ""
    return f"{thing} must be {expected}; got {got}{place}.{step}"


def raise_all(error: type[StapeskitError], faults: Iterable[str], most: int = 20) -> None:
    """Raise one error that lists every fault of a file, or return when there is none.

    Parameters
    ----------
    error : type
        The room's exception class.
    faults : iterable of str
        Finished sentences.
    most : int
        How many are written out before the rest is counted.

    Raises
    ------
    StapeskitError
        The given class, with one fault a line, when there is at least one fault.
    """
    listed = list(faults)
    if not listed:
        return
    shown = listed[:most]
    if len(listed) > most:
        shown.append(f"... and {len(listed) - most} more faults of this kind.")
    raise error("\n".join(shown))
