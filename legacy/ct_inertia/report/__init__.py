"""The report of a mass matrix: sections, evidence, pictures."""
