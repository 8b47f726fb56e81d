"""The rooms of version 0.2, each until its successor at the top level holds."""
