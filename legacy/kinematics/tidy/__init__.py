"""The tidy vibrometer table and the table of points."""
