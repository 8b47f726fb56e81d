"""Look at a report in headless Chromium at several widths: pages_in_browser.py demo/report.html

Prints the messages of the console, how much the picture in three dimensions varies (a blank one does not) and
how far the page is wider than the window, and keeps the pictures beside the page. Needs chromium; run it on
pages of this program only.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

WIDTHS = {400: 2600, 900: 2000, 1200: 2000, 1600: 1500}
# What a copy of the page writes into its own root: by how many pixels it is wider than the window.
_MEASURE = """<script>addEventListener("load", () => {
  const root = document.documentElement;
  root.dataset.over = root.scrollWidth - root.clientWidth;
});</script>"""
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
    "--enable-logging=stderr",
    "--virtual-time-budget=4000",
)


def overflow(browser: str, page: Path, width: int, height: int) -> int:
    """Return by how many pixels a page is wider than the window, from a copy without its content policy."""
    text = re.sub(r"<meta[^>]*Content-Security-Policy[^>]*>", "", page.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "page.html"
        copy.write_text(text.replace("</head>", f"{_MEASURE}</head>", 1), encoding="utf-8")
        words = [f"--user-data-dir={folder}/profile", f"--window-size={width},{height}", "--dump-dom"]
        done = subprocess.run(
            [browser, *FLAGS, *words, copy.as_uri()], capture_output=True, text=True, timeout=180, check=False
        )
    told = re.search(r'data-over="(-?\d+)"', done.stdout)
    return int(told[1]) if told else -1


def main() -> int:
    """Open the page at every width; return how many checks failed."""
    page = Path(sys.argv[1]).resolve()
    browser = shutil.which("chromium") or shutil.which("google-chrome") or shutil.which("chrome")
    if browser is None:
        print("chromium is not installed")
        return 1
    failed = 0
    for width, height in WIDTHS.items():
        picture = page.with_name(f"{page.stem}_{width}.png")
        with tempfile.TemporaryDirectory() as profile:
            words = [
                f"--user-data-dir={profile}",
                f"--window-size={width},{height}",
                f"--screenshot={picture}",
            ]
            done = subprocess.run(
                [browser, *FLAGS, *words, page.as_uri()],
                capture_output=True,
                text=True,
                timeout=180,
                check=False,
            )
        messages = [line for line in re.findall(r"CONSOLE.*", done.stderr) if "ReadPixels" not in line]
        colours = np.asarray(Image.open(picture).convert("RGB"), dtype=float)
        # bone is the one large area with clearly more red than blue
        bone = int(np.sum(colours[..., 0] - colours[..., 2] > 40.0))
        over = overflow(browser, page, width, height)
        wrong = len(messages) + (bone < 2000) + (over != 0)
        failed += wrong
        end = "  FAILED" if wrong else ""
        print(f"{width:5d} px: {len(messages)} messages, {bone} pixels of bone, {over} px too wide{end}")
        for line in messages:
            print(f"         {line[:160]}")
    return failed


if __name__ == "__main__":
    sys.exit(main())
