"""Studies on the workers of a dask.distributed cluster, which share the storage with this machine.

A study is one task, a function of a study file into a folder: a worker that dies costs the time of one ear,
since another one runs it again. Clusters with a scheduler of their own use docs/cluster/Snakefile.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from pipeline.several import End, Runner, run_one
from stapeskit.faults import StapeskitError

# Seconds that a scheduler has to answer.
_CONNECT_S = 10.0


def run_on_dask(address: str, figures: Path | None = None) -> Runner:
    """Return the runner that uses the workers of a dask scheduler at ``HOST:PORT``, as `run_here`."""

    def run(studies: Mapping[str, Path], out: Path, force: bool, ended: Callable[[str, End], None]) -> None:
        try:
            from distributed import Client, as_completed
        except ImportError as error:
            step = "Run pip install distributed"
            raise StapeskitError.of(
                "dask.distributed", "installed for --scheduler", error, "", step
            ) from error
        try:
            client = Client(address, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            step = "Start one with: dask scheduler; and workers with: dask worker ADDRESS --nthreads 1"
            expected = "the address HOST:PORT of a dask scheduler that answers"
            raise StapeskitError.of("--scheduler", expected, address, "", step) from error
        with client:
            names = list(studies)
            columns = ([str(studies[name]) for name in names], [str(out / name) for name in names])
            orders = ([force] * len(names), [figures] * len(names))
            futures = client.map(_run_order, *columns, *orders, pure=False)
            known = dict(zip(futures, names, strict=True))
            for future in as_completed(futures, loop=client.loop):
                if future.status == "finished":
                    ended(known[future], future.result())
                else:
                    reason = f"its workers died, most often because memory ran out ({future.exception()})"
                    ended(known[future], End(2, f"{reason}. Run it again."))

    return run


def _run_order(study: str, out: str, force: bool, figures: Path | None) -> End:
    """Run a study on this worker."""
    if not Path(study).is_file():
        return End(
            2, f"the worker does not see {study}: workers must share the storage of studies and results."
        )
    return run_one(Path(study), Path(out), force, figures)
