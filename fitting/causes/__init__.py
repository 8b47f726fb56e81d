"""What may be wrong with a measurement or its model: one catalogue, its scores, and the naming of a cause."""
