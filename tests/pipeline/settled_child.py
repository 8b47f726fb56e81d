"""`pipeline.runners.child` with the code taken as in these tests, so that finished stages are reused."""

import json
import sys

from pipeline import records
from pipeline.runners.child import run_child

if __name__ == "__main__":
    records.code_hash = lambda rooms: "code of " + " ".join(rooms)
    sys.stdout.write(json.dumps(run_child(sys.argv[1:])) + "\n")
