"""A page of the app in headless Chromium, and what a person does on it."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

from app.launch import app_command

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SHOTS = os.environ.get("STAPESKIT_SHOTS")
"""Folder for pictures of every step."""

_GL = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
_QUIET = ["--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run"]


class Server:
    """The app as `stapeskit app` starts it, without a browser of its own."""

    def __init__(self, folder: Path) -> None:
        self.lines: list[str] = []
        self.process = subprocess.Popen(
            app_command(folder, ["--headless", "--port", str(_free_port())]),
            cwd=Path(__file__).parents[2],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.address = self._address(120.0)

    def _read(self) -> None:
        self.lines.extend(self.process.stdout or ())

    def _address(self, limit_s: float) -> str:
        end = time.monotonic() + limit_s
        while time.monotonic() < end and self.process.poll() is None:
            if found := re.search(r"http://\S+access_token=\S+", "".join(self.lines)):
                return found.group(0).replace("localhost", "127.0.0.1")
            time.sleep(0.05)
        raise TimeoutError("".join(self.lines))

    def close(self) -> None:
        """End it."""
        self.process.terminate()
        self.process.wait(30.0)
        self._reader.join(10.0)
        if self.process.stdout is not None:
            self.process.stdout.close()

    @property
    def said(self) -> str:
        """Everything that it printed."""
        return "".join(self.lines)


def _free_port() -> int:
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Page:
    """One tab."""

    def __init__(self, playwright, address: str, size=(1000, 900)) -> None:
        self.browser = playwright.chromium.launch(
            executable_path=CHROMIUM, headless=True, args=[*_GL, *_QUIET]
        )
        self.asked_elsewhere: list[str] = []
        context = self.browser.new_context(viewport={"width": size[0], "height": size[1]})
        context.route("**/*", self._only_here)
        context.set_default_timeout(90_000)
        self.tab = context.new_page()
        self.tab.goto(address)
        self.tab.wait_for_selector("canvas")

    def _only_here(self, route) -> None:
        if route.request.url.startswith(("http://127.0.0.1", "data:", "blob:")):
            route.continue_()
        else:
            self.asked_elsewhere.append(route.request.url)
            route.abort()

    def see(self, text: str):
        """Return the first visible element with a text; /.../ is a regular expression."""
        return self.tab.locator(f"text={text} >> visible=true").first

    def press(self, text: str) -> None:
        """Click a control."""
        self.see(text).click()
        self.settle()

    def wait(self, text: str, limit_s: float = 600.0) -> None:
        """Wait for a text."""
        self.see(text).wait_for(timeout=1000.0 * limit_s)

    def settle(self, ms: int = 700) -> None:
        """Let the page come to rest."""
        self.tab.wait_for_timeout(ms)

    def write(self, label: str, value: str) -> None:
        """Fill in a field."""
        field = self.tab.get_by_label(label).locator("visible=true").first
        field.fill(value)
        field.press("Tab")
        self.settle()

    def shot(self, name: str) -> None:
        """Keep a picture of the page."""
        if SHOTS:
            self.tab.screenshot(path=str(Path(SHOTS) / f"{name}.png"), timeout=240_000)

    @property
    def crosshair(self) -> np.ndarray:
        """Where the page says that the crosshair is, scan mm."""
        text = self.see("/scan -?[0-9.]+, /").inner_text()
        return np.array([float(value) for value in re.findall(r"-?\d+\.\d+", text)])

    def canvas(self, at) -> tuple[float, float]:
        """Return the pixel of a place in the canvas, given as fractions of its width and height."""
        box = self.tab.locator("canvas").first.bounding_box()
        return box["x"] + at[0] * box["width"], box["y"] + at[1] * box["height"]

    def click(self, at) -> np.ndarray:
        """Click a place of the canvas and return where the crosshair is then."""
        self.tab.mouse.click(*self.canvas(at))
        self.settle(1500)
        return self.crosshair

    def drag(self, start, stop, steps: int = 6) -> None:
        """Draw with the mouse."""
        (x0, y0), (x1, y1) = self.canvas(start), self.canvas(stop)
        self.tab.mouse.move(x0, y0)
        self.tab.mouse.down()
        for k in range(1, steps + 1):
            self.tab.mouse.move(x0 + (x1 - x0) * k / steps, y0 + (y1 - y0) * k / steps)
        self.tab.mouse.up()
        self.settle(2500)


class Tile:
    """A slice in the canvas: which place of the canvas is which scan coordinate.

    Three clicks tell the plane; a fourth place follows.
    """

    def __init__(self, page: Page, at, apart: float = 0.06) -> None:
        self.at = np.array(at)
        self.origin = page.click(at)
        self.right = (page.click((at[0] + apart, at[1])) - self.origin) / apart
        self.down = (page.click((at[0], at[1] + apart)) - self.origin) / apart

    def place(self, scan_mm) -> np.ndarray:
        """Return where a point shows, fractions of the canvas."""
        axes = np.stack([self.right, self.down], axis=1)
        return self.at + np.linalg.lstsq(axes, np.asarray(scan_mm) - self.origin, rcond=None)[0]


def command_line(*words: str, folder: Path) -> subprocess.CompletedProcess:
    """Run a command of the project in a folder."""
    code = f"import sys; from {words[0]}.cli import main; sys.argv[1:] = {list(words[1:])!r}; main()"
    return subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True)
