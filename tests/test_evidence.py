"""The tables of the evidence are those that the scripts printed, and every kept result is on a page."""

import re
import signal
import subprocess
import sys

import pytest

from tests.test_doc_tables import PAGES
from tools.evidence import BLOCK, RESULTS, commands, result_file, timed, with_results


@pytest.mark.parametrize("page", [name for name, text in PAGES.items() if BLOCK.search(text)])
def test_the_blocks_of_a_page_are_the_kept_results(page):
    assert with_results(PAGES[page]) == PAGES[page], "run make evidence ARGS=WORD: figures are not typed"


def test_every_kept_result_is_on_one_page():
    shown = [result_file(command) for text in PAGES.values() for command in commands(text)]
    assert sorted(shown) == sorted(RESULTS.glob("*.json"))


def test_the_lines_of_a_block_follow_from_its_result_alone():
    page = next(text for text in PAGES.values() if BLOCK.search(text))
    edited = BLOCK.sub(lambda match: match[0].replace("| ", "| 9", 1), page)
    assert edited != page
    assert with_results(edited) == with_results(page)
    assert re.search(r"\*`python benchmarks/[^`]+`, \d{4}-\d\d-\d\d", page)


def test_time_is_counted_where_the_signal_of_ended_children_is_ignored():
    before = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        text, spent = timed([sys.executable, "-c", "print(sum(range(6_000_000)))"])
        with pytest.raises(subprocess.CalledProcessError):
            timed([sys.executable, "-c", "raise SystemExit(3)"])
    finally:
        signal.signal(signal.SIGCHLD, before)
    assert text == "17999997000000\n"
    assert spent > 0.01
