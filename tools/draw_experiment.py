"""Draw docs/experiment.svg, what is measured and how: python tools/draw_experiment.py"""

from __future__ import annotations

from pathlib import Path

from svg import BEAM, BLUE, BONE, EDGE, GREEN, INK, PLASTIC, RED, SOFT, STEEL, Drawing, stapes

TARGET = Path(__file__).resolve().parents[1] / "docs" / "experiment.svg"


def main() -> None:
    """Draw the sample on the shaker, the beams, the scan of the same sample, and what follows from both."""
    drawing = Drawing(940, 500, "A stapes in its window on a plate on a shaker, seen by a laser vibrometer")
    shaker(drawing)
    sample(drawing)
    beams(drawing)
    scan(drawing)
    TARGET.write_text(drawing.svg(), encoding="utf-8")


def shaker(drawing: Drawing) -> None:
    """Draw the shaker and the plastic plate on it."""
    drawing.path("M190 452h200v34h-200z", STEEL, SOFT)
    drawing.path("M270 430h40v22h-40z", STEEL, SOFT)
    drawing.path("M140 406h300v24h-300z", PLASTIC, SOFT)
    drawing.line((166, 486, 166, 440), INK, 2.5, head=True)
    drawing.line((166, 446, 166, 490), INK, 2.5, head=True)
    drawing.text(290, 475, "shaker", anchor="middle")
    drawing.text(290, 424, "plastic plate", anchor="middle")


def sample(drawing: Drawing) -> None:
    """Draw the bone around the oval window, the ligament and the stapes."""
    for side in (-1, 1):
        inner, outer = 290 + side * 99, 290 + side * 150
        drawing.path(
            f"M{inner} 322V372L{290 + side * 70} 406H{outer}V336Q{outer} 322 {inner} 322Z", BONE, EDGE, 2
        )
        edge = 290 + side * 79
        zigzag = "".join(f"L{edge + side * step} {350 - (6 if step % 4 else -6)}" for step in range(2, 20, 3))
        drawing.path(f"M{edge} 350{zigzag}L{inner} 350", "none", BLUE, 1.8)
    stapes(drawing, 290, 356, 58)
    drawing.text(169, 380, "bone", anchor="middle")
    drawing.line((122, 318, 200, 348), BLUE, 1)
    drawing.text(14, 292, "annular ligament:\nstiffness K,\ndamping D", BLUE)
    drawing.text(14, 214, "stapes:\nmass matrix M")
    drawing.line((124, 219, 216, 240), EDGE, 1)
    drawing.text(446, 112, "incus\nremoved", SOFT)
    drawing.line((441, 110, 335, 104), SOFT, 1)
    drawing.path(
        "M252 128C246 96 270 74 300 82C322 66 344 92 330 116", "none", SOFT, 1.4, 'stroke-dasharray="5 4"'
    )
    drawing.text(456, 372, "inner ear open\nor closed: you\nwrite it down", SOFT)
    drawing.line((453, 378, 296, 388), SOFT, 1)
    drawing.line((290, 358, 290, 262), GREEN, 3, head=True)
    drawing.line((290, 358, 344, 358), RED, 3, head=True)
    drawing.text(299, 272, "y", GREEN, bold=True)
    drawing.text(350, 377, "x", RED, bold=True)


def beams(drawing: Drawing) -> None:
    """Draw the vibrometer and its beams onto stapes and bone."""
    for place, hit in (((150, 44), (268, 168)), ((290, 30), (286, 167)), ((430, 44), (306, 168))):
        drawing.line((*place, *hit), BEAM, 1.6, more='opacity="0.85"')
    for place, hit in (((430, 44), (404, 321)), ((150, 44), (180, 321))):
        drawing.line((*place, *hit), BEAM, 1.2, more='stroke-dasharray="7 4" opacity="0.8"')
    for x in (150, 290, 430):
        drawing.path(f"M{x - 30} 12h60v26h-60z", "#3c4856", INK)
    for x, y in ((268, 168), (286, 167), (306, 168), (404, 321), (180, 321)):
        drawing.dot(x, y, BEAM)
    drawing.text(470, 28, "laser vibrometer: velocity of", BEAM)
    drawing.text(470, 47, "points on the stapes and on the bone", BEAM)


def scan(drawing: Drawing) -> None:
    """Draw the scan of the same sample and the chain of results."""
    x = 640
    for number in range(4):
        drawing.path(f"M{x + 9 * number} {118 - 9 * number}h92v92h-92z", "#2b333d", "#8a95a1")
    stapes(drawing, x + 27 + 46, 176, 22)
    drawing.path(f"M{x + 33} 168h12v12h-12zM{x + 103} 168h10v12h-10zM{x + 33} 186h82v6h-82z", BONE, EDGE, 1)
    drawing.text(630, 236, "micro-CT of the same sample and plate", INK)
    drawing.text(630, 255, "(the plate ties scan and vibrometer)", SOFT)
    steps = (
        ("ct2mass", "scan → mass matrix M, frames"),
        ("points2dof", "beams → motion of stapes and bone"),
        ("dof2kd", "both → K and D, with uncertainty"),
    )
    for row, (name, words) in enumerate(steps):
        y = 300 + 54 * row
        drawing.path(f"M640 {y}h284v42h-284z", "#eef3f7", "#8fa3b5", 1.2)
        drawing.text(652, y + 18, name, BLUE, bold=True)
        drawing.text(652, y + 36, words)
    drawing.text(640, 482, "scan2kd runs all three and writes a report", SOFT)


if __name__ == "__main__":
    main()
