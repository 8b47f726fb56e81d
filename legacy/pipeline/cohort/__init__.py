"""Many ears: how stiffness and damping follow the inertia and the size of the stapes."""
