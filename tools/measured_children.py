"""Save the coverage of sandboxed children before each answer: they are killed, and would save nothing.

A plugin of pytest, for `make coverage`.
"""

from __future__ import annotations

from typing import Any

import coverage

from stapeskit import sandbox

_send = sandbox._send


def _send_and_save(pipe: Any, outcome: object) -> None:
    if measured := coverage.Coverage.current():
        measured.save()
    _send(pipe, outcome)


sandbox._send = _send_and_save
