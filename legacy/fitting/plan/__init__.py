"""Before a measurement: the standard deviations to expect."""
