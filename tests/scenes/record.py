"""Write bars.json anew: what the commands of today state, and which warnings they give.

python -m tests.scenes.record [SCENE ...]
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

from tests.scenes import chain
from tests.scenes.scenes import SCENES

BARS = Path(__file__).with_name("bars.json")


def main(names: list[str]) -> None:
    """Run the scenes named, or all, and print what was found."""
    known = json.loads(BARS.read_text()) if BARS.exists() else {}
    for name in names or SCENES:
        with tempfile.TemporaryDirectory() as folder:
            start = time.process_time()
            found = chain.run(SCENES[name], Path(folder))
            seconds = time.process_time() - start
        words = [f"{name}: {seconds:.1f} s"]
        if found.mass is not None:
            words.append(f"mass {chain.worst_parameter(found):.1f}")
        if found.motion is not None:
            words.append(f"motion {chain.worst_motion(found):.1f}")
        if found.kd is not None:
            words.append("fit {:.1f} < {:.1f}".format(*chain.fit_distance(found)))
        words.append(found.refused or str({k: sorted(v) for k, v in found.codes().items() if v}))
        print("; ".join(words), flush=True)
        known[name] = found.stated()
    BARS.write_text(json.dumps({name: known[name] for name in SCENES if name in known}, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
