"""Operations on masks and fields of voxels, and grids of blocks of voxels."""
