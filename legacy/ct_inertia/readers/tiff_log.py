"""Raise the damage that tifffile only logs."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.readers.refusals import not_readable

_WORDS = ("invalid", "truncat", "corrupt", "failed to", "unexpected", "does not match", "missing data")


class _Listener(logging.Handler):
    """Collect the messages about damage."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.damage: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage().lower()
        if any(word in text for word in _WORDS):
            self.damage.append(text)


@contextmanager
def listening(path: Path, kind: str) -> Iterator[None]:
    """Read with tifffile: whatever it raises or logs about damage becomes one sentence.

    Raises
    ------
    CtInertiaError
        The file is damaged, by an exception or by the log of tifffile.
    """
    listener = _Listener()
    logger = logging.getLogger("tifffile")
    logger.addHandler(listener)
    propagate, logger.propagate = logger.propagate, False
    try:
        yield
    except CtInertiaError as fault:
        if listener.damage:
            raise _damage_error(path, kind) from fault
        raise
    except Exception as fault:
        raise not_readable(path, kind, fault) from fault
    finally:
        logger.removeHandler(listener)
        logger.propagate = propagate
    if listener.damage:
        raise _damage_error(path, kind)


def _damage_error(path: Path, kind: str) -> CtInertiaError:
    return CtInertiaError.of(
        f"the {kind}",
        "complete",
        f"a truncated or damaged file of {path.stat().st_size} bytes",
        path.name,
        "Copy or export it again",
    )
