"""Studies on the workers of a dask.distributed cluster, which share the storage with this machine.

A study is one task, a pure function of a study file into a folder: a worker that dies has its studies run
again by another one, and nothing of what it had not finished is left. Results are the same bit for bit as on
one machine, because workers with other code or other versions of packages refuse to work.
"""

from __future__ import annotations

import re
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from legacy.pipeline.errors import PipelineError
from legacy.pipeline.runners import Where
from legacy.pipeline.runners.study_process import AGAIN, End, Task, run_task

# Patience with a scheduler that does not answer, and pause between two looks.
_CONNECT_S = 10.0
_POLL_S = 0.05
_ADDRESS = re.compile(r"(\w+://)?[^/\s]+:\d+(/.*)?")
_ROOMS = ("stapeskit", "ct_inertia", "kinematics", "fitting", "pipeline")
_EXTRA = "stapeskit[cluster]"


@dataclass(frozen=True)
class _Order:
    """What a worker gets: a study, versions that must agree with the client, and where progress goes."""

    task: Task
    versions: Mapping[str, str]
    mark: Path
    topic: str


def run(
    tasks: Sequence[Task],
    where: Where,
    tell: Callable[[str, str], None],
    ended: Callable[[str, End], None],
) -> None:
    """Run studies on the workers of the scheduler ``where.address``, as `pipeline.runners.Run`.

    Raises
    ------
    PipelineError
        dask.distributed is not installed, or no scheduler answers.
    """
    client = _connect(where.address)
    token = uuid.uuid4().hex[:12]
    mark = where.shared / f"cluster-{token}"
    mark.touch()
    topic = f"stapeskit-{token}"
    try:
        client.subscribe_topic(topic, lambda event: tell(*event[1]))
        if not client.scheduler_info()["workers"]:
            tell("", f"the scheduler {where.address} has no workers yet; waiting for them")
        versions = _versions()
        orders = [_Order(task, versions, mark, topic) for task in tasks]
        futures = {
            client.submit(run_order, order, key=f"stapeskit-{token}-{order.task.name}", pure=False): order
            for order in orders
        }
        _report_ends(client, {future: order.task.name for future, order in futures.items()}, ended)
    finally:
        mark.unlink(missing_ok=True)
        client.close(timeout=2)


def _connect(address: str) -> Any:
    try:
        from distributed import Client
    except ImportError as fault:
        step = f"pip install '{_EXTRA}'"
        raise PipelineError.of("dask.distributed", "installed for {scheduler}", fault, "", step) from fault
    step = "Start one with: dask scheduler; and workers with: dask worker ADDRESS --nthreads 1"
    if not _ADDRESS.fullmatch(
        address
    ):  # a client would seek in vain, and complain of it when it is thrown away
        raise PipelineError.of("{scheduler}", "the address HOST:PORT of a dask scheduler", address, "", step)
    try:
        return Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as fault:
        reason = str(fault).splitlines()[0]
        raise PipelineError.of(
            "{scheduler}", "the address of a dask scheduler that answers", reason, "", step
        ) from fault


def _report_ends(client: Any, futures: dict[Any, str], ended: Callable[[str, End], None]) -> None:
    """Report each study as it ends; give the others up when this process is interrupted."""
    waiting = dict(futures)
    try:
        while waiting:
            disconnected = client.status not in ("running", "connecting")
            for future in [job for job in waiting if disconnected or job.status != "pending"]:
                ended(waiting[future], _end_of(future, disconnected))
                del waiting[future]
            time.sleep(_POLL_S)
    except BaseException:
        client.cancel(list(waiting), force=True)
        raise


def _end_of(future: Any, disconnected: bool) -> End:
    """Return how the study of a future ended."""
    from distributed import KilledWorker

    if future.status == "finished":
        end: End = future.result()
        return end
    if future.status != "error" or disconnected:
        return End(2, fault=f"the scheduler was lost before this ear was finished. {AGAIN}.")
    fault = future.exception()
    if isinstance(fault, KilledWorker):
        worker = getattr(fault.last_worker, "address", fault.last_worker)
        text = f"its workers died each time, the last at {worker}, most often because memory ran out"
        return End(2, fault=f"{text}. Start workers with more memory. {AGAIN}.")
    return End(1, fault=f"{type(fault).__name__}: {fault}")


def run_order(order: _Order) -> End:
    """Run a study on this worker."""
    from distributed import get_worker

    worker = get_worker()
    refusal = _refusal(order)
    if refusal:
        return End(2, fault=f"the worker {worker.address} {refusal}.")
    key = worker.get_current_task()

    def stopped() -> bool:
        state = worker.state.tasks.get(key)
        return state is None or state.state not in ("executing", "long-running")

    def tell(line: str) -> None:
        worker.log_event(order.topic, (order.task.name, line))

    limit = worker.memory_manager.memory_limit
    return run_task(order.task, tell, stopped, limit / worker.state.nthreads if limit else None)


def _refusal(order: _Order) -> str:
    """Return why this worker cannot give the result that is asked for; empty where it can."""
    for path in (order.mark, order.task.study):
        if not path.exists():
            return f"does not see {path}: workers must share the storage of studies and results"
    mine = _versions()
    others = [name for name, number in order.versions.items() if mine.get(name) != number]
    if others:
        return f"has another version of {', '.join(others)} than the machine that asks; install the same"
    return ""


def _versions() -> dict[str, str]:
    """Return the versions of code and packages on which numbers depend."""
    from legacy.pipeline.stage_records import code_hash
    from legacy.stapeskit.provenance import versions

    return {**versions(), "the code of stapeskit": code_hash(_ROOMS)}
