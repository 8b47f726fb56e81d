"""One study of several, run as ``python -m pipeline.runners.child_process STUDY OUT [--force]``.

Progress goes to standard error, one line a stage; the end is one JSON object on standard output. The process
ends when the one that started it does, so that a study never runs twice at a time.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
import traceback
from pathlib import Path
from typing import Any

from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.process import listen

_PARENT_CHECK_S = 0.1  # how long an orphan may live; a study takes seconds before it writes
_PATIENCE_S = 0.3  # less than that of the process that waits for this one


def end_with_parent() -> None:
    """Ask this process to leave when its parent is gone."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_PARENT_CHECK_S)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


def run_child(words: list[str]) -> dict[str, Any]:
    """Run a study and return how it ended: ``code``, and its ``name`` or, when it failed, ``fault``."""
    from legacy.pipeline.scan2kd import run_study
    from legacy.pipeline.stage_progress import Progress

    try:
        result = run_study(Path(words[0]), Path(words[1]), "--force" in words, Progress())
    except StapeskitError as fault:
        return {"code": 2, "fault": str(fault)}
    except KeyboardInterrupt:
        return {"code": 130, "fault": "interrupted; nothing was written"}
    except MemoryError:
        return {
            "code": 2,
            "fault": "not enough memory; use fewer --jobs or crop the scan with box_mm in [scan]",
        }
    except Exception:
        return {"code": 1, "fault": traceback.format_exc()}
    return {"code": 0, "name": result.name}


if __name__ == "__main__":
    listen("scan2kd", _PATIENCE_S)
    end_with_parent()
    arguments = sys.argv[1:]
    sys.argv = ["scan2kd", *(Path(word).name for word in arguments[:1])]  # the command in the provenance
    sys.stdout.write(json.dumps(run_child(arguments)) + "\n")
