"""From mass matrix and rigid-body motion to stiffness and damping of the annular ligament."""
