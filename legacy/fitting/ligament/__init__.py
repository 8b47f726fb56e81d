"""The ligament in its own plane: one likelihood of K, D, in-plane coupling and shared errors."""
