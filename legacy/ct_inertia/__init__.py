"""From a micro-CT volume or a surface to the generalized mass matrix of the stapes."""
