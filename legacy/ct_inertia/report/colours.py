"""The colours of all pictures of this room: distinct for readers with deuteranopia, too."""

from __future__ import annotations

from legacy.ct_inertia.bodies import OTHER_BONE, PLATE, STAPES

# Number of the cut in pictures, beside those of the bodies; no label volume has it.
CUT = 9
# Okabe and Ito's palette, with blue for the cut.
BODY_COLOURS = {STAPES: "#e69f00", PLATE: "#56b4e9", OTHER_BONE: "#cc79a7", CUT: "#1040ff"}
AXIS_COLOURS = ("#d55e00", "#00a878", "#1f4fa3")
