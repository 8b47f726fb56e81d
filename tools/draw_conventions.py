"""Draw docs/conventions.svg, every frame and sign on one drawing: python tools/draw_conventions.py"""

from __future__ import annotations

from pathlib import Path

from svg import BEAM, BLUE, EDGE, GREEN, INK, PLASTIC, RED, SOFT, Drawing, stapes

from legacy.ct_inertia.frames.footplate_face import FACE_ANGLE_DEG

TARGET = Path(__file__).resolve().parents[1] / "docs" / "conventions.svg"


def main() -> None:
    """Draw footplate, plate, scan and beam, one panel each."""
    drawing = Drawing(960, 640, "Footplate frame, plate frame, scan coordinates, beams and signs")
    for x, y, words in (
        (20, 30, "Footplate frame: left ear, seen from superior"),
        (500, 30, "Plate frame"),
        (20, 372, "Scan coordinates, mm"),
        (500, 372, "Beams and signs"),
    ):
        drawing.text(x, y, words, INK, bold=True)
    drawing.line((480, 12, 480, 628), "#d5dbe2", 1)
    drawing.line((12, 348, 948, 348), "#d5dbe2", 1)
    footplate(drawing)
    plate(drawing)
    scan(drawing)
    beam(drawing)
    TARGET.write_text(drawing.svg(), encoding="utf-8")


def footplate(drawing: Drawing) -> None:
    """Draw the stapes with its axes."""
    x, y = 190, 290
    stapes(drawing, x, y, 62)
    drawing.line((x, y, x, 130), GREEN, 3, head=True)
    drawing.line((x, y, x + 130, y), RED, 3, head=True)
    drawing.path(f"M{x - 9} {y}a9 9 0 1 0 18 0a9 9 0 1 0 -18 0", "#fff", BLUE, 2.5)
    drawing.dot(x, y, BLUE)
    drawing.text(x + 8, 128, "y lateral, towards the head", GREEN)
    drawing.text(x + 100, y + 24, "x anterior, long axis", RED)
    drawing.text(x - 12, y + 30, "z superior\n(right ear: inferior)", BLUE, "end")
    cone = f"within {FACE_ANGLE_DEG:g}° of −y"
    drawing.text(20, 60, f"origin: centroid of the\nmedial face (normals\n{cone})", SOFT)
    drawing.line((100, 112, x - 8, y - 6), SOFT, 1)
    drawing.path(f"M{x + 62} {y - 10}A62 62 0 0 0 {x + 20} {y - 58}", "none", BLUE, 2)
    drawing.line((x + 24, y - 57, x + 18, y - 59), BLUE, 2, head=True)
    drawing.text(x + 58, y - 46, "gamma", BLUE)
    drawing.text(
        300, 172, "small rotations,\nright-handed:\nalpha about x,\nbeta about y,\ngamma about z", INK
    )
    drawing.text(300, 62, "v(p) = v₀ + ω × (p − p₀)", INK)
    drawing.text(300, 84, "order: x y z\nalpha beta gamma", SOFT)


def plate(drawing: Drawing) -> None:
    """Draw the plate with its axes and the transforms."""
    drawing.path("M530 262L770 262L850 206L610 206Z", PLASTIC, SOFT)
    drawing.path("M530 262V282H770L850 226V206L770 262Z", "#a9c3d3", SOFT)
    drawing.line((690, 234, 690, 110), GREEN, 3, head=True)
    drawing.line((690, 234, 800, 234), RED, 3, head=True)
    drawing.line((690, 234, 634, 272), BLUE, 3, head=True)
    drawing.text(700, 116, "y out of the face,\ntowards the stapes", GREEN)
    drawing.text(862, 226, "x longest\nedge", RED)
    drawing.text(612, 254, "z", BLUE)
    drawing.text(500, 60, "origin: centroid of the visible face", SOFT)
    drawing.text(500, 312, "a_from_b (4×4, mm) maps b to a:\np_scan = scan_from_plate · p_plate", INK)


def scan(drawing: Drawing) -> None:
    """Draw voxels with their index."""
    for row in range(4):
        for column in range(5):
            drawing.path(f"M{70 + 46 * column} {430 + 46 * row}h46v46h-46z", "#f3f5f8", "#aab4bf", 1)
            drawing.dot(93 + 46 * column, 453 + 46 * row, "#6f7b88", 2.5)
    drawing.dot(93, 453, BEAM, 5)
    drawing.line((93, 453, 340, 453), RED, 2.5, head=True)
    drawing.line((93, 453, 93, 618), GREEN, 2.5, head=True)
    drawing.text(346, 458, "x", RED, bold=True)
    drawing.text(74, 626, "y", GREEN, "end", bold=True)
    drawing.text(70, 404, "index (0, 0, 0): centre of the first voxel = origin", BEAM)
    drawing.text(
        318, 500, "p = origin +\ndirection ·\n(index · spacing)\nLPS if the file\nknows anatomy", INK
    )
    drawing.text(110, 634, "image arrays: [z, y, x]; options: x, y, z", SOFT)


def beam(drawing: Drawing) -> None:
    """Draw a beam on a surface."""
    drawing.path("M520 590Q600 540 690 572T860 566V612H520Z", "#e6d3ad", EDGE)
    drawing.line((676, 566, 818, 436), BEAM, 3, head=True)
    drawing.path("M818 398l40 34-16 20-40-34z", "#3c4856", INK)
    drawing.dot(676, 566, BEAM, 5)
    drawing.line((676, 566, 640, 500), GREEN, 3, head=True)
    drawing.text(600, 496, "v", GREEN, bold=True)
    drawing.text(770, 510, "dir (unit length),\ntowards the laser head", BEAM)
    drawing.text(500, 402, "reading = v · dir, + towards the head", INK)
    drawing.text(500, 432, "e^(+iωt), peak amplitudes", INK)
    drawing.text(500, 452, "v = iω q, phase in degrees", INK)
    drawing.text(500, 632, "SI in results; mm where images and meshes meet people", SOFT)


if __name__ == "__main__":
    main()
