"""Wide tables: one row a frequency, one or two columns a beam."""
