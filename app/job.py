"""A running step, in a process of its own: its progress, how to stop it, its messages."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

TITLES = {
    "found": "Measuring the stapes",
    "cut": "Measuring the corrected cut",
    "points": "Looking at the measurement",
    "fit": "Fitting stiffness and damping",
}


@dataclass
class Job:
    """A step of `app.work`, begun when this is made.

    Attributes
    ----------
    step : str
        Of `TITLES`.
    stage, share : str, float or None
        What is at work, and the part of it that is done.
    notices : list of (code, text)
        Warnings.
    """

    step: str
    study: Path
    stage: str = "starting"
    share: float | None = None
    notices: list[tuple[str, str]] = field(default_factory=list)
    began: float = field(default_factory=time.monotonic)
    stopped: bool = False

    def __post_init__(self) -> None:
        self._stage_began = self.began
        self._errors: list[str] = []
        self._process = subprocess.Popen(
            [sys.executable, "-m", "app.work", self.step, str(self.study)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parents[1],
        )
        self._threads = [threading.Thread(target=one, daemon=True) for one in (self._read, self._read_errors)]
        for thread in self._threads:
            thread.start()

    def _read(self) -> None:
        for line in self._process.stdout or ():
            try:
                word = json.loads(line)
            except ValueError:
                continue
            if "code" in word:
                self.notices.append((word["code"], word["text"]))
            else:
                if word["stage"] != self.stage:
                    self._stage_began = time.monotonic()
                self.stage, self.share = word["stage"], word["share"]

    def _read_errors(self) -> None:
        self._errors.extend(self._process.stderr or ())

    @property
    def running(self) -> bool:
        """Whether it is still at work."""
        return self._process.poll() is None

    @property
    def seconds(self) -> float:
        """Since it began."""
        return time.monotonic() - self.began

    @property
    def progress(self) -> str:
        """Title, stage, share and time left in one line."""
        text = f"{TITLES[self.step]}: {self.stage}, {self.seconds:.0f} s"
        if self.share is not None and 0.02 < self.share < 1.0:
            passed = time.monotonic() - self._stage_began
            left = passed * (1.0 - self.share) / self.share
            text += f", {100.0 * self.share:.0f} %, about {left:.0f} s left"
        return text

    def stop(self) -> None:
        """End it; what finished stages have written stays."""
        self.stopped = True
        self._process.terminate()

    def wait(self) -> None:
        """Wait for its end."""
        self._process.wait()

    def fault(self) -> str:
        """Return what it said at its end: empty when all went well, never a traceback."""
        code = self._process.wait()
        for thread in self._threads:
            thread.join(timeout=5.0)
        for pipe in (self._process.stdout, self._process.stderr):
            if pipe is not None:
                pipe.close()
        if code == 0:
            return ""
        if self.stopped:
            return "Stopped; what was there before is unchanged."
        if code == 2 and self._errors:
            return "".join(self._errors).strip()
        self.log.write_text("".join(self._errors), encoding="utf-8")
        return (
            f"stapeskit failed in this step (exit code {code}). This is a bug, not your input: please report "
            f"{self.log.name}, which lies in {self.log.parent}."
        )

    @property
    def log(self) -> Path:
        """Where the lines of an unexpected failure are kept."""
        folder = self.study.with_name(f"{self.study.stem}_app")
        folder.mkdir(exist_ok=True)
        return folder / "failure.txt"
