"""Find the stapes and the plate in a scan or in a label volume."""
