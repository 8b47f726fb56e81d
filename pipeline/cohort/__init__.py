"""Many ears: a table, whether they differ, and how stiffness and damping follow the inertia."""
