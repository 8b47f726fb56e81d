"""Mass, centre of mass and inertia of the stapes, by every way to a mass."""
