"""Files of measuring systems: each reader returns Recordings, `assemble` makes the measurement of them."""
