"""Files that a mass measurement writes."""
