"""Which source makes the uncertainty of every entry of K and D."""

import json
import sys
from pathlib import Path

from matplotlib.figure import Figure

results = Path(sys.argv[1] if len(sys.argv) > 1 else "results")
picture = Path(sys.argv[2] if len(sys.argv) > 2 else "budget.png")

kd = json.loads((results / "kd.json").read_text(encoding="utf-8"))
names, shares = kd["parameters"], kd["budget_share_of_variance"]
figure = Figure(figsize=(8, 4), layout="constrained")
axes = figure.subplots()
below = [0.0] * len(names)
for source, row in shares.items():
    part = [100.0 * max(row[name], 0.0) for name in names]
    if max(part) > 1.0:
        axes.bar(names, part, bottom=below, label=source)
        below = [low + more for low, more in zip(below, part, strict=True)]
axes.set_ylabel("share of the variance (%)")
axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
figure.savefig(picture, dpi=80)
largest = max(shares, key=lambda source: shares[source]["K11"])
print(f"largest source of K(y): {largest}, {100 * shares[largest]['K11']:.0f} % of the variance")
