"""Self-contained HTML pages, numbers with their units, drawings."""
