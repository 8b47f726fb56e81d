"""The page of a motion: tables, figures, the moving bodies."""
