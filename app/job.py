"""Run one step in a child process: read its progress and messages, and stop it."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from app.study_file import StudyFile

TITLES = {
    "found": "Measuring the stapes",
    "cut": "Measuring the corrected cut",
    "points": "Looking at the measurement",
    "fit": "Fitting stiffness and damping",
}


class Job:
    """A step of `app.work`, begun when this is made.

    Attributes
    ----------
    step : str
        Of `TITLES`.
    stage, share : str, float or None
        What is at work, and the part of it that is done.
    notices : dict of str to str
        Warnings by code.
    """

    def __init__(self, step: str, study: StudyFile) -> None:
        self.step, self.stage = step, "starting"
        self.share: float | None = None
        self.notices: dict[str, str] = {}
        self._began = self._stage_began = time.monotonic()
        self._stopped = False
        self._log = study.kept / "failure.txt"
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed when it was read, in `fault`
        self._said = ""
        self._process = subprocess.Popen(
            [sys.executable, "-m", "app.work", step, str(study.path)],
            stdout=subprocess.PIPE,
            stderr=self._errors,
            cwd=Path(__file__).parents[1],
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        for line in self._process.stdout or ():
            try:
                word = json.loads(line)
            except ValueError:
                continue
            if "code" in word:
                self.notices[word["code"]] = word["text"]
            else:
                if word["stage"] != self.stage:
                    self._stage_began = time.monotonic()
                self.stage, self.share = word["stage"], word["share"]

    @property
    def running(self) -> bool:
        """Whether it is still at work."""
        return self._process.poll() is None

    @property
    def seconds(self) -> float:
        """Since it began."""
        return time.monotonic() - self._began

    @property
    def progress(self) -> str:
        """Title, stage, share and time left in one line."""
        text = f"{TITLES[self.step]}: {self.stage}, {self.seconds:.0f} s"
        if self.share is not None and 0.02 < self.share < 1.0:
            left = (time.monotonic() - self._stage_began) * (1.0 - self.share) / self.share
            text += f", {100.0 * self.share:.0f} %, about {left:.0f} s left"
        return text

    @property
    def done(self) -> str:
        """Say that it has ended."""
        return f"{TITLES[self.step]}: done in {self.seconds:.0f} s."

    def stop(self) -> None:
        """End it; what finished stages have written stays."""
        self._stopped = True
        self._process.terminate()

    def fault(self) -> str:
        """Wait for its end and return what it said: empty when all went well, never a traceback."""
        code = self._process.wait()
        self._reader.join()
        if self._process.stdout is not None:
            self._process.stdout.close()
        if not self._errors.closed:
            with self._errors:
                self._errors.seek(0)
                self._said = self._errors.read().decode(errors="replace").strip()
        if code == 0:
            return ""
        if self._stopped or code == 130:
            return "Stopped; what was there before is unchanged."
        if code == 2:
            return self._said
        self._log.parent.mkdir(exist_ok=True)
        self._log.write_text(self._said, encoding="utf-8")
        return (
            f"stapeskit failed in this step (exit code {code}). This is a bug, not your input: please report "
            f"{self._log.name}, which lies in {self._log.parent}."
        )
