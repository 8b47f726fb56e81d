"""Many lines packed into few that hold all there is to know about static faults."""
