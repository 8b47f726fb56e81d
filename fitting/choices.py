"""Names and words of what a fit can be asked for, free of numpy: the help of the command reads them."""

from __future__ import annotations

DAMPING = {
    "viscous": ("K + i w D", "force proportional to velocity"),
    "hysteretic": ("K + i D", "constant loss factor"),
    "fractional": ("K + (i w)^{a:.4g} D", "spring-pot, its exponent estimated"),
    "relaxation": ("K + i w D / (1 + i w {a:.3g} s)", "standard linear solid, its time estimated"),
}
"""Formula, with {a} for an unknown, and meaning of each law of `laws.LAWS`."""

MASS_SIGNS = {
    "tensor": "elements of the inertia tensor",
    "positive": "products of inertia, + integral x z dm",
}
"""What the mixed rotational entries of a plain matrix can be."""

UNKNOWNS = (
    *("delay", "phase", "gain", "fluid", "head_mass", "centre_x", "centre_y", "centre_z", "inertia"),
    *("mirrored", "drift", "level"),
)
"""Names of the entries of `causes.UNKNOWNS`, which a user may free or fix."""
