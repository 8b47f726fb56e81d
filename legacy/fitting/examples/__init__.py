"""The paper and its beam experiment, recomputed with the library."""
