"""Records that travel between the rooms: mass.json, dof.csv with dof.h5, kd.json."""
