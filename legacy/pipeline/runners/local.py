"""Studies on this machine, several at a time."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait

from legacy.pipeline.runners import Where
from legacy.pipeline.runners.study_process import End, Task, run_task

# Pause between two checks: short against a study, long against a check.
_POLL_S = 0.1


def run(
    tasks: Sequence[Task],
    where: Where,
    tell: Callable[[str, str], None],
    ended: Callable[[str, End], None],
) -> None:
    """Keep ``where.jobs`` studies at work until all have ended, as `pipeline.runners.Run`."""
    stop = threading.Event()

    def run_one(task: Task) -> End:
        if stop.is_set():
            return End(130, fault="interrupted")

        def say(line: str) -> None:
            if not stop.is_set():  # an interruption is reported once, for all studies
                tell(task.name, line)

        return run_task(task, say, stop.is_set)

    with ThreadPoolExecutor(where.jobs) as pool:
        waiting: dict[Future[End], str] = {pool.submit(run_one, task): task.name for task in tasks}
        try:
            while waiting:
                finished, _ = wait(waiting, _POLL_S, FIRST_COMPLETED)
                for future in finished:
                    ended(waiting.pop(future), future.result())
        finally:
            stop.set()
