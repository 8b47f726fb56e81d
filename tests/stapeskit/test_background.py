"""Work in the background: results and faults come back; the memory choices do no harm."""

import gc
import os
import threading
import weakref

import numpy as np
import pytest

from legacy.stapeskit.background import Later
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.memory import hold_little_memory, keep_algebra_to_one_thread
from legacy.stapeskit.option_names import as_keyword, named, use_vocabulary


def test_options_are_named_as_the_caller_names_them():
    with use_vocabulary(as_keyword):
        later = Later(named, "plate_fiducials")
    assert later.result() == "plate_fiducials"


def test_results_come_back_and_the_caller_goes_on():
    started, go_on = threading.Event(), threading.Event()

    def work(a, b):
        started.set()
        assert go_on.wait(10.0)
        return a + b

    later = Later(work, 2, 3)
    assert started.wait(10.0)
    go_on.set()
    assert later.result() == 5
    assert later.result() == 5


def test_a_fault_is_raised_where_the_result_is_wanted():
    def work():
        raise StapeskitError("the scan must be whole; got half of it.")

    later = Later(work)
    for _ in range(2):
        with pytest.raises(StapeskitError, match="half of it"):
            later.result()


def test_memory_choices_leave_arrays_as_they_are():
    hold_little_memory()
    arrays = [np.full(n, 7, dtype=np.uint8) for n in (10, 1 << 20, 1 << 25)]
    assert all(array.min() == array.max() == 7 for array in arrays)


def test_a_result_that_is_taken_is_held_no_longer():
    class Large:
        pass

    later = Later(Large)
    kept = weakref.ref(later.taken())
    gc.collect()
    assert kept() is None


@pytest.mark.parametrize(("before", "after"), [(None, "1"), ("4", "4")])
def test_threads_of_linear_algebra_are_the_users_choice(monkeypatch, before, after):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "0")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    if before is not None:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", before)
    keep_algebra_to_one_thread()
    assert os.environ["OPENBLAS_NUM_THREADS"] == after
