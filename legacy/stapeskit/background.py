"""Work that goes on in the background while the caller does something else."""

from __future__ import annotations

import contextvars
import sys
import threading
from collections.abc import Callable
from typing import Any, Generic, TypeVar

Result = TypeVar("Result")
# A tenth of the default.
_TURN_S = 0.0005


def take_short_turns() -> None:
    """Let threads that run Python take turns ten times as often as they do by default.

    A thread that works in numpy needs the interpreter for a moment between two steps, and waits a whole turn
    of any thread that imports modules meanwhile. A command calls it before it starts threads.
    """
    sys.setswitchinterval(_TURN_S)


class Later(Generic[Result]):
    """A call that runs on another thread, in the caller's context (its vocabulary of option names).

    Parameters
    ----------
    *arguments
        What to call it with.
    """

    def __init__(self, work: Callable[..., Result], *arguments: Any) -> None:
        self._found: list[Result] = []
        self._fault: BaseException | None = None
        context = contextvars.copy_context()
        self._thread = threading.Thread(
            target=context.run, args=(self._run, work, arguments), name=work.__name__
        )
        self._thread.start()

    def _run(self, work: Callable[..., Result], arguments: tuple[Any, ...]) -> None:
        try:
            self._found.append(work(*arguments))
        except BaseException as fault:
            self._fault = fault

    def result(self) -> Result:
        """Return what the call returned, waiting for it; raise what it raised."""
        self._thread.join()
        if self._fault is not None:
            raise self._fault
        return self._found[0]

    def taken(self) -> Result:
        """Return what ``result`` does and hold it no longer, so that its memory can be freed."""
        value = self.result()
        self._found = []
        return value
