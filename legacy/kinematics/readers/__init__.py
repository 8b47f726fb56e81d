"""Files of measuring systems: each reader returns Recordings, of which one measurement is made."""
