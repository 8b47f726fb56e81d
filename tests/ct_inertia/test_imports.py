"""What a run without a report does not load: the start of a process is most of a short run."""

from __future__ import annotations

import subprocess
import sys

from tests.ct_inertia.ears import ear

HEAVY = ("matplotlib", "pyvista", "pymeshlab", "jinja2", "SimpleITK", "trimesh", "pandas", "rich", "networkx")
CODE = f"""
import sys
from legacy.ct_inertia.cli import work
work(sys.argv[1:])
print([name for name in {HEAVY!r} if name in sys.modules])
"""


def test_a_run_without_report_loads_no_picture_or_mesh_library(tmp_path):
    import tifffile

    tifffile.imwrite(tmp_path / "s.tif", ear(h=0.05, seed=3).volume.array)
    words = f"{tmp_path / 's.tif'} --spacing 0.05 --mass-mg 3 --density 1900 --no-report"
    words += " --export stl,obj,glb,mjcf,urdf,abaqus"
    done = subprocess.run(
        [sys.executable, "-c", CODE, *words.split(), "--out", str(tmp_path / "o")],
        capture_output=True,
        text=True,
    )
    assert done.stdout.strip() == "[]", done.stderr
