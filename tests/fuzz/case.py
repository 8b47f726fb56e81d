"""One damaged input, and what may become of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

MEGABYTE = 1 << 20


@dataclass(frozen=True)
class Case:
    """Files and what reads them.

    Attributes
    ----------
    name : str
        What was damaged and how, for the report.
    files : mapping of str to bytes
        Contents by their path in the case's folder; a name that ends in ``/`` is an empty folder.
    arguments : tuple of str
        The target (`tests.fuzz.targets.TARGETS`) and its words; the case's folder is the working folder.
    declared : int
        Bytes that the content truly takes when it is unpacked, where that is more than the files.
    """

    name: str
    files: Mapping[str, bytes] = field(repr=False)
    arguments: tuple[str, ...]
    declared: int = 0

    @property
    def memory(self) -> int:
        """Return how many bytes reading may take: twice what was declared, and 300 MB."""
        size = max(self.declared, sum(map(len, self.files.values())))
        return 2 * size + 300 * MEGABYTE


@dataclass(frozen=True)
class Finding:
    """A case that ended otherwise than well or with a refusal.

    Attributes
    ----------
    kind : str
        ``error`` (not a StapeskitError), ``hang``, ``crash``, ``memory``, ``message`` (a refusal that is too
        long), ``left`` (something stayed behind) or ``input`` (an input was changed).
    signature : str
        What cases of one cause share.
    place : str
        Maker, seed, block and number; `python -m tests.fuzz --replay PLACE` runs it again.
    name : str
        Name of the case.
    text : str
        The traceback.
    """

    kind: str
    signature: str
    place: str
    name: str
    text: str
