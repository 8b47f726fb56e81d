"""Grey values on a grid: blocks, coarse views, masks, distances, a working copy."""
