"""Stiffness and damping of the suspension of a rigid body from its motion and its mass matrix."""
