"""The command ``stapeskit app``: who may reach the page, and what is said without the extra."""

from __future__ import annotations

import asyncio
import importlib.util
import os
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from app import launch
from pipeline.stapeskit_command import work
from stapeskit.faults import StapeskitError


def test_without_the_extra_one_sentence_names_the_command_that_installs_it(monkeypatch, tmp_path):
    known = importlib.util.find_spec
    monkeypatch.setattr(launch, "find_spec", lambda name: None if name == "marimo" else known(name))
    with pytest.raises(StapeskitError) as raised:
        work(["app", str(tmp_path)])
    (fault,) = raised.value.faults
    assert fault.thing == "the packages of the app"
    assert "[app]" in fault.next_step


def test_the_server_binds_to_this_machine_with_a_token_and_shows_no_tracebacks(monkeypatch, tmp_path):
    monkeypatch.setattr(launch, "find_spec", lambda _: True)
    words = launch.app_command(tmp_path)
    assert words[words.index("--host") + 1] == "127.0.0.1"
    assert {"--token", "--no-show-tracebacks"} <= set(words)
    assert Path(words[words.index("run") + 1]).is_file()
    assert words[-2:] == ["--folder", str(tmp_path)]


def answer(address: str) -> tuple[int, str]:
    """Return the code of the answer and the path where it came from in the end."""
    try:
        with urllib.request.build_opener(urllib.request.HTTPCookieProcessor()).open(address) as reply:
            return reply.status, urlsplit(reply.url).path
    except urllib.error.HTTPError as error:
        with error:
            return error.code, urlsplit(error.url).path


def test_a_page_without_the_token_reaches_neither_page_nor_kernel_and_ctrl_c_ends_it(tmp_path):
    pytest.importorskip("marimo")
    pytest.importorskip("ipyniivue")
    client = pytest.importorskip("websockets.asyncio.client")
    from websockets.exceptions import InvalidStatus

    from tests.app.driven import Server

    server = Server(tmp_path)
    try:
        base, token = server.address.split("?access_token=")
        base = base.rstrip("/")
        assert answer(f"{base}/?access_token={token}") == (200, "/")
        assert answer(f"{base}/api/status")[0] in (401, 403)
        assert answer(f"{base}/")[1] == "/auth/login"

        async def knock(address: str) -> int:
            origin = "http://elsewhere.example"
            try:
                async with client.connect(address, additional_headers={"Origin": origin}):
                    return 101
            except InvalidStatus as error:
                return error.response.status_code

        socket = base.replace("http", "ws") + "/ws?session_id=s_123456"
        assert asyncio.run(knock(socket)) in (401, 403)
        assert asyncio.run(knock(f"{socket}&access_token=wrong")) in (401, 403)
        os.kill(server.process.pid, signal.SIGINT)
        server.process.wait(30.0)
    finally:
        server.close()
    assert "Traceback" not in server.said


def test_every_cell_of_the_page_runs():
    """Without a browser: what a cell imports and reads from tables of options is there."""
    root = Path(__file__).parents[2]
    command = [sys.executable, str(root / "app" / "page.py")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=root, check=False)
    assert done.returncode == 0, done.stderr


def test_threads_are_set_before_numpy_is_loaded_so_that_last_digits_agree():
    """As in the commands, whose help loads no library that computes: tests/ground/test_command.py."""
    asked = "import sys, app.steps; sys.exit('numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", asked], cwd=Path(__file__).parents[2], check=False)
    assert done.returncode == 0
