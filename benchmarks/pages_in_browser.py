"""Look at a report in headless Chromium at three widths: pages_in_browser.py demo/report.html

Prints the messages of the console and how much the picture in three dimensions varies (a blank one does not),
and keeps the pictures beside the page. Needs chromium; run it on pages of this program only.
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

WIDTHS = {400: 2600, 900: 2000, 1600: 1500}
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
        wrong = len(messages) + (bone < 2000)
        failed += wrong
        print(f"{width:5d} px: {len(messages)} messages, {bone} pixels of bone{'  FAILED' if wrong else ''}")
        for line in messages:
            print(f"         {line[:160]}")
    return failed


if __name__ == "__main__":
    sys.exit(main())
