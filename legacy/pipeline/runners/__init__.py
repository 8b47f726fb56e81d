"""Where the studies of a cohort run, one place a file: in processes of this machine, or on a cluster.

A runner is a module of this folder with a function ``run(tasks, where, tell, ended)``, and one entry of
`RUNNERS`; ``scan2kd --scheduler``, its help and the contract test follow from it. What it refuses (another
version, no shared storage) is tried on the workers: `dask_cluster` shows how.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from legacy.pipeline.runners.study_process import End, Task

HERE = "local"


@dataclass(frozen=True)
class Where:
    """Where studies shall run.

    Attributes
    ----------
    jobs : int
        How many run at a time on this machine.
    address : str
        Of the scheduler of a cluster; empty on this machine.
    shared : Path
        An existing folder that every machine must see under the same path.
    """

    jobs: int = 1
    address: str = ""
    shared: Path = Path()


class Run(Protocol):
    """The function ``run`` of a runner."""

    def __call__(
        self,
        tasks: Sequence[Task],
        where: Where,
        tell: Callable[[str, str], None],
        ended: Callable[[str, End], None],
    ) -> None:
        """Run studies until all have ended; give them up when interrupted.

        Parameters
        ----------
        tell : callable
            Gets the name of a study (empty for a line about all of them) and a line of its progress.
        ended : callable
            Gets the name of a study and its end, one at a time.
        """


@dataclass(frozen=True)
class Runner:
    """An entry: what it is, after the words "address of" in the help, and the schemes of addresses.

    ``tcp`` is the scheme of tcp://HOST:PORT.
    """

    summary: str
    schemes: tuple[str, ...] = ()


RUNNERS: dict[str, Runner] = {
    HERE: Runner("processes of this machine"),
    "dask_cluster": Runner(
        "a dask scheduler, whose workers run the studies", ("tcp", "tls", "ws", "wss", "ucx", "")
    ),
}
"""By the name of the module; an address without a scheme goes to the entry with an empty one."""


def runner_of(address: str) -> Run:
    """Return the function that runs studies at an address; empty: on this machine.

    Raises
    ------
    PipelineError
        No runner takes addresses of that scheme.
    """
    name = HERE
    if address:
        scheme = address.partition("://")[0] if "://" in address else ""
        known = {scheme: name for name, runner in RUNNERS.items() for scheme in runner.schemes}
        if scheme not in known:
            from legacy.pipeline.errors import PipelineError

            wanted = f"an address that begins with {', '.join(f'{word}://' for word in known if word)}"
            raise PipelineError.of("{scheduler}", wanted, address)
        name = known[scheme]
    run: Run = import_module(f"legacy.pipeline.runners.{name}").run
    return run
