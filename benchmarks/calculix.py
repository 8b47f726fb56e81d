"""CalculiX reads the Abaqus export: the modes of a stapes on springs beside those of K and M.

    python benchmarks/calculix.py      needs ccx (Debian: calculix-ccx)

Springs of a ligament stand on the footplate's translation along y and its rotations about x and z. The three
frequencies of CalculiX are compared with the generalised eigenvalues of K and the reduced M.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.linalg import eigh

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

STIFFNESS = np.array([1700.0, 2.0e-3, 6.0e-4])  # N/m, N m/rad, N m/rad
_SPRINGS = """*ELEMENT, TYPE=SPRING1, ELSET=K_Y
910001, 900001
*SPRING, ELSET=K_Y
2
{0:.12e}
*ELEMENT, TYPE=SPRING1, ELSET=K_ALPHA
910002, 900002
*SPRING, ELSET=K_ALPHA
1
{1:.12e}
*ELEMENT, TYPE=SPRING1, ELSET=K_GAMMA
910003, 900002
*SPRING, ELSET=K_GAMMA
3
{2:.12e}
{3}*BOUNDARY
900001, 1, 1
900001, 3, 3
900002, 2, 2
*STEP
*FREQUENCY
3
*NODE FILE
U
*END STEP
"""


def _oscillators(count: int = 20) -> str:
    """Return masses on stiff springs, far above: the solver of eigenvalues wants more unknowns than three."""
    nodes = range(920000, 920000 + count)
    blocks = {
        "*NODE, NSET=OTHERS": [f"{node}, 50., 0., 0." for node in nodes],
        "*ELEMENT, TYPE=MASS, ELSET=OTHER_MASS": [f"{node + 10000}, {node}" for node in nodes],
        "*MASS, ELSET=OTHER_MASS": ["1.e-9"],
        "*ELEMENT, TYPE=SPRING1, ELSET=OTHER_K": [f"{node + 20000}, {node}" for node in nodes],
        "*SPRING, ELSET=OTHER_K": ["1", "1.e6"],
        "*BOUNDARY": ["OTHERS, 2, 3"],
    }
    return "".join("\n".join([key, *lines]) + "\n" for key, lines in blocks.items())


def modes(folder: Path) -> np.ndarray:
    """Run CalculiX on the export in a folder with springs; return the frequencies, Hz."""
    text = (folder / "stapes.inp").read_text(encoding="utf-8")
    newtons_mm = STIFFNESS * np.array([1e-3, 1e3, 1e3])  # N/mm, N mm/rad
    model = text + _SPRINGS.format(*newtons_mm, _oscillators())
    (folder / "modes.inp").write_text(model, encoding="utf-8")
    done = subprocess.run(["ccx", "modes"], cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode or "*ERROR" in done.stdout:
        raise SystemExit(done.stdout[-3000:])
    lines = (folder / "modes.dat").read_text(encoding="utf-8").splitlines()
    rows = [line.split() for line in lines if re.match(r"\s+\d+\s+[0-9.]+E", line)]
    return np.array([float(row[3]) for row in rows[:3]])


def main() -> None:
    """Print both sets of frequencies and leave with 1 when they differ by more than 1 %."""
    from legacy.ct_inertia.ct2mass import ct2mass
    from legacy.ct_inertia.exports import export
    from legacy.ct_inertia.options import MassOptions
    from legacy.ct_inertia.surface.surface import write_surface
    from tests.ct_inertia.shapes import stapes

    if shutil.which("ccx") is None:
        raise SystemExit("CalculiX (ccx) is not installed.")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write_surface(folder / "stapes.ply", stapes(0.08))
        result = ct2mass(MassOptions(folder / "stapes.ply", density=(1900.0, None), anterior=(1.0, 0.0, 0.0)))
        export(result, folder, "abaqus")
        frequencies = modes(folder)
    reduced = result.matrix.matrix[np.ix_([1, 3, 5], [1, 3, 5])]
    expected = np.sqrt(eigh(np.diag(STIFFNESS), reduced, eigvals_only=True)) / (2.0 * np.pi)
    for number, (own, other) in enumerate(zip(frequencies, expected, strict=True), start=1):
        print(
            f"mode {number}: CalculiX {own:.4f} Hz, K and M {other:.4f} Hz, {1e2 * (own / other - 1):+.1e} %"
        )
    raise SystemExit(int(np.max(np.abs(frequencies / expected - 1.0)) > 0.01))


if __name__ == "__main__":
    main()
