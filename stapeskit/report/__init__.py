"""Pages of results: units for people, blocks of a page, figures, the three-dimensional view."""
