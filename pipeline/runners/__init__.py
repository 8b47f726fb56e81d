"""Where the studies of a cohort run: in processes of this machine, or on the workers of a cluster."""
