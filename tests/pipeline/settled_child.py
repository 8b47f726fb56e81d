"""`pipeline.runners.child_process` with the code hash of these tests, so that finished stages are reused."""

import json
import sys

from legacy.pipeline import stage_records
from legacy.pipeline.runners.child_process import run_child

if __name__ == "__main__":
    stage_records.code_hash = lambda rooms: "code of " + " ".join(rooms)
    sys.stdout.write(json.dumps(run_child(sys.argv[1:])) + "\n")
