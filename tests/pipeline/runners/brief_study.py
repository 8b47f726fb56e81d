"""A study in a tenth of a second: ``python -m tests.pipeline.runners.brief_study STUDY OUT``.

The study file holds how the study goes: ``seconds``, ``after`` (a file beside it that must be there first),
``fails`` (a word of run_child's), ``mebibytes``. The folder gets result.txt, whole or not at all, from the
text of the study file alone.
"""

import json
import os
import signal
import sys
import time
import tomllib
from pathlib import Path

from legacy.pipeline.runners.child_process import end_with_parent


def main():
    end_with_parent()
    study, folder = Path(sys.argv[1]), Path(sys.argv[2])
    text = study.read_text()
    plan = tomllib.loads(text)
    if (folder / "result.txt").exists():
        sys.stderr.write("unchanged, reused\n")
        return {"code": 0, "name": "reused"}
    sys.stderr.write("scan 0.1 s\n")
    sys.stderr.flush()
    held = b"x" * (plan.get("mebibytes", 0) << 20)
    started = folder.parent / f"started-{study.stem}-{os.getpid()}"
    started.touch()
    time.sleep(plan.get("seconds", 0.0))
    while "after" in plan and not (study.parent / plan["after"]).exists():
        time.sleep(0.02)
    if plan.get("fails") == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if plan.get("fails") == "crash":
        os.abort()
    if plan.get("fails") == "input":
        return {"code": 2, "fault": "its scan holds no stapes."}
    folder.mkdir(exist_ok=True)
    (folder / "new").write_text(text[::-1])
    os.replace(folder / "new", folder / "result.txt")
    del held
    return {"code": 0, "name": study.stem}


if __name__ == "__main__":
    sys.stdout.write(json.dumps(main()) + "\n")
