"""`tests.pipeline.settled_child`, but for a study called ``heavy``, which takes 800 MiB."""

import json
import sys
import time
from pathlib import Path

from legacy.pipeline import stage_records
from legacy.pipeline.runners.child_process import end_with_parent, run_child

if __name__ == "__main__":
    end_with_parent()
    if Path(sys.argv[1]).parent.name == "heavy":
        held = b"x" * (800 << 20)
        time.sleep(60.0)
    stage_records.code_hash = lambda rooms: "code of " + " ".join(rooms)
    sys.stdout.write(json.dumps(run_child(sys.argv[1:])) + "\n")
