"""The model: mass matrix, damping law, dynamic stiffness, lines and their equations."""
