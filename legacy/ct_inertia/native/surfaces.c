/* Surfaces: the contour of a field, the pieces of a mesh, diffusion on it, convex hulls. */
#include "stapes.h"

/* Triangles of every way in which a level can pass between eight corners: their number, then the edges on which
 * their corners lie. Bit x + 2 y + 4 z of a case is set where a corner is not below the level. Edges 0-3 run along x
 * (y + 2 z), 4-7 along y (x + 2 z), 8-11 along z (x + 2 y). Marching cubes (Lorensen and Cline 1987,
 * doi:10.1145/37402.37422) with the cases of VTK's flying edges, so that both make the same triangles. */
static const int8_t CASES[256][16] = {
{0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0},
{1,0,4,8,0,0,0,0,0,0,0,0,0,0,0,0},
{1,0,9,5,0,0,0,0,0,0,0,0,0,0,0,0},
{2,5,4,8,9,5,8,0,0,0,0,0,0,0,0,0},
{1,4,1,10,0,0,0,0,0,0,0,0,0,0,0,0},
{2,0,1,10,8,0,10,0,0,0,0,0,0,0,0,0},
{2,5,0,9,1,10,4,0,0,0,0,0,0,0,0,0},
{3,5,1,10,5,10,9,9,10,8,0,0,0,0,0,0},
{1,5,11,1,0,0,0,0,0,0,0,0,0,0,0,0},
{2,0,4,8,5,11,1,0,0,0,0,0,0,0,0,0},
{2,9,11,1,0,9,1,0,0,0,0,0,0,0,0,0},
{3,1,4,8,1,8,11,11,8,9,0,0,0,0,0,0},
{2,4,5,11,10,4,11,0,0,0,0,0,0,0,0,0},
{3,0,5,11,0,11,8,8,11,10,0,0,0,0,0,0},
{3,4,0,9,4,9,10,10,9,11,0,0,0,0,0,0},
{2,9,11,8,11,10,8,0,0,0,0,0,0,0,0,0},
{1,2,8,6,0,0,0,0,0,0,0,0,0,0,0,0},
{2,2,0,4,6,2,4,0,0,0,0,0,0,0,0,0},
{2,0,9,5,8,6,2,0,0,0,0,0,0,0,0,0},
{3,2,9,5,2,5,6,6,5,4,0,0,0,0,0,0},
{2,8,6,2,4,1,10,0,0,0,0,0,0,0,0,0},
{3,10,6,2,10,2,1,1,2,0,0,0,0,0,0,0},
{3,9,5,0,8,6,2,1,10,4,0,0,0,0,0,0},
{4,2,10,6,9,10,2,9,1,10,9,5,1,0,0,0},
{2,5,11,1,8,6,2,0,0,0,0,0,0,0,0,0},
{3,4,6,2,4,2,0,5,11,1,0,0,0,0,0,0},
{3,9,11,1,9,1,0,8,6,2,0,0,0,0,0,0},
{4,1,9,11,1,6,9,1,4,6,6,2,9,0,0,0},
{3,4,5,11,4,11,10,6,2,8,0,0,0,0,0,0},
{4,5,11,10,5,10,2,5,2,0,6,2,10,0,0,0},
{4,2,8,6,9,10,0,9,11,10,10,4,0,0,0,0},
{3,2,10,6,2,9,10,9,11,10,0,0,0,0,0,0},
{1,9,2,7,0,0,0,0,0,0,0,0,0,0,0,0},
{2,9,2,7,0,4,8,0,0,0,0,0,0,0,0,0},
{2,0,2,7,5,0,7,0,0,0,0,0,0,0,0,0},
{3,8,2,7,8,7,4,4,7,5,0,0,0,0,0,0},
{2,9,2,7,1,10,4,0,0,0,0,0,0,0,0,0},
{3,0,1,10,0,10,8,2,7,9,0,0,0,0,0,0},
{3,0,2,7,0,7,5,1,10,4,0,0,0,0,0,0},
{4,1,7,5,1,8,7,1,10,8,2,7,8,0,0,0},
{2,5,11,1,9,2,7,0,0,0,0,0,0,0,0,0},
{3,4,8,0,5,11,1,2,7,9,0,0,0,0,0,0},
{3,7,11,1,7,1,2,2,1,0,0,0,0,0,0,0},
{4,1,7,11,4,7,1,4,2,7,4,8,2,0,0,0},
{3,11,10,4,11,4,5,9,2,7,0,0,0,0,0,0},
{4,2,7,9,0,5,8,8,5,11,8,11,10,0,0,0},
{4,7,0,2,7,10,0,7,11,10,10,4,0,0,0,0},
{3,7,8,2,7,11,8,11,10,8,0,0,0,0,0,0},
{2,9,8,6,7,9,6,0,0,0,0,0,0,0,0,0},
{3,9,0,4,9,4,7,7,4,6,0,0,0,0,0,0},
{3,0,8,6,0,6,5,5,6,7,0,0,0,0,0,0},
{2,5,4,7,4,6,7,0,0,0,0,0,0,0,0,0},
{3,6,7,9,6,9,8,4,1,10,0,0,0,0,0,0},
{4,9,6,7,9,1,6,9,0,1,1,10,6,0,0,0},
{4,1,10,4,0,8,5,5,8,6,5,6,7,0,0,0},
{3,10,5,1,10,6,5,6,7,5,0,0,0,0,0,0},
{3,9,8,6,9,6,7,11,1,5,0,0,0,0,0,0},
{4,11,1,5,9,0,7,7,0,4,7,4,6,0,0,0},
{4,8,1,0,8,7,1,8,6,7,11,1,7,0,0,0},
{3,1,7,11,1,4,7,4,6,7,0,0,0,0,0,0},
{4,9,8,7,8,6,7,11,4,5,11,10,4,0,0,0},
{5,7,0,6,7,9,0,6,0,10,5,11,0,10,0,11},
{5,10,0,11,10,4,0,11,0,7,8,6,0,7,0,6},
{2,10,7,11,6,7,10,0,0,0,0,0,0,0,0,0},
{1,6,10,3,0,0,0,0,0,0,0,0,0,0,0,0},
{2,4,8,0,10,3,6,0,0,0,0,0,0,0,0,0},
{2,0,9,5,10,3,6,0,0,0,0,0,0,0,0,0},
{3,8,9,5,8,5,4,10,3,6,0,0,0,0,0,0},
{2,6,4,1,3,6,1,0,0,0,0,0,0,0,0,0},
{3,6,8,0,6,0,3,3,0,1,0,0,0,0,0,0},
{3,1,3,6,1,6,4,0,9,5,0,0,0,0,0,0},
{4,5,1,3,5,3,8,5,8,9,8,3,6,0,0,0},
{2,11,1,5,3,6,10,0,0,0,0,0,0,0,0,0},
{3,5,11,1,4,8,0,3,6,10,0,0,0,0,0,0},
{3,1,0,9,1,9,11,3,6,10,0,0,0,0,0,0},
{4,3,6,10,1,4,11,11,4,8,11,8,9,0,0,0},
{3,11,3,6,11,6,5,5,6,4,0,0,0,0,0,0},
{4,11,3,6,5,11,6,5,6,8,5,8,0,0,0,0},
{4,0,6,4,0,11,6,0,9,11,3,6,11,0,0,0},
{3,6,11,3,6,8,11,8,9,11,0,0,0,0,0,0},
{2,3,2,8,10,3,8,0,0,0,0,0,0,0,0,0},
{3,4,10,3,4,3,0,0,3,2,0,0,0,0,0,0},
{3,8,10,3,8,3,2,9,5,0,0,0,0,0,0,0},
{4,9,3,2,9,4,3,9,5,4,10,3,4,0,0,0},
{3,8,4,1,8,1,2,2,1,3,0,0,0,0,0,0},
{2,0,1,2,2,1,3,0,0,0,0,0,0,0,0,0},
{4,5,0,9,1,2,4,1,3,2,2,8,4,0,0,0},
{3,5,2,9,5,1,2,1,3,2,0,0,0,0,0,0},
{3,3,2,8,3,8,10,1,5,11,0,0,0,0,0,0},
{4,5,11,1,4,10,0,0,10,3,0,3,2,0,0,0},
{4,2,8,10,2,10,3,0,9,1,1,9,11,0,0,0},
{5,11,4,9,11,1,4,9,4,2,10,3,4,2,4,3},
{4,8,4,5,8,5,3,8,3,2,3,5,11,0,0,0},
{3,11,0,5,11,3,0,3,2,0,0,0,0,0,0,0},
{5,2,4,3,2,8,4,3,4,11,0,9,4,11,4,9},
{2,11,2,9,3,2,11,0,0,0,0,0,0,0,0,0},
{2,2,7,9,6,10,3,0,0,0,0,0,0,0,0,0},
{3,0,4,8,2,7,9,10,3,6,0,0,0,0,0,0},
{3,7,5,0,7,0,2,6,10,3,0,0,0,0,0,0},
{4,10,3,6,8,2,4,4,2,7,4,7,5,0,0,0},
{3,6,4,1,6,1,3,7,9,2,0,0,0,0,0,0},
{4,9,2,7,0,3,8,0,1,3,3,6,8,0,0,0},
{4,4,1,3,4,3,6,5,0,7,7,0,2,0,0,0},
{5,3,8,1,3,6,8,1,8,5,2,7,8,5,8,7},
{3,9,2,7,11,1,5,6,10,3,0,0,0,0,0,0},
{4,3,6,10,5,11,1,0,4,8,2,7,9,0,0,0},
{4,6,10,3,7,11,2,2,11,1,2,1,0,0,0,0},
{5,4,8,2,4,2,7,4,7,1,11,1,7,10,3,6},
{4,9,2,7,11,3,5,5,3,6,5,6,4,0,0,0},
{5,5,11,3,5,3,6,5,6,0,8,0,6,9,2,7},
{5,2,11,0,2,7,11,0,11,4,3,6,11,4,11,6},
{4,6,11,3,6,8,11,7,11,2,2,11,8,0,0,0},
{3,3,7,9,3,9,10,10,9,8,0,0,0,0,0,0},
{4,4,10,3,0,4,3,0,3,7,0,7,9,0,0,0},
{4,0,8,10,0,10,7,0,7,5,7,10,3,0,0,0},
{3,3,4,10,3,7,4,7,5,4,0,0,0,0,0,0},
{4,7,9,8,7,8,1,7,1,3,4,1,8,0,0,0},
{3,9,3,7,9,0,3,0,1,3,0,0,0,0,0,0},
{5,5,8,7,5,0,8,7,8,3,4,1,8,3,8,1},
{2,5,3,7,1,3,5,0,0,0,0,0,0,0,0,0},
{4,5,11,1,9,10,7,9,8,10,10,3,7,0,0,0},
{5,0,4,10,0,10,3,0,3,9,7,9,3,5,11,1},
{5,10,7,8,10,3,7,8,7,0,11,1,7,0,7,1},
{4,3,4,10,3,7,4,1,4,11,11,4,7,0,0,0},
{5,5,3,4,5,11,3,4,3,8,7,9,3,8,3,9},
{4,11,0,5,11,3,0,9,0,7,7,0,3,0,0,0},
{2,0,8,4,7,11,3,0,0,0,0,0,0,0,0,0},
{1,11,3,7,0,0,0,0,0,0,0,0,0,0,0,0},
{1,11,7,3,0,0,0,0,0,0,0,0,0,0,0,0},
{2,0,4,8,7,3,11,0,0,0,0,0,0,0,0,0},
{2,9,5,0,7,3,11,0,0,0,0,0,0,0,0,0},
{3,5,4,8,5,8,9,7,3,11,0,0,0,0,0,0},
{2,1,10,4,11,7,3,0,0,0,0,0,0,0,0,0},
{3,10,8,0,10,0,1,11,7,3,0,0,0,0,0,0},
{3,0,9,5,1,10,4,7,3,11,0,0,0,0,0,0},
{4,7,3,11,5,1,9,9,1,10,9,10,8,0,0,0},
{2,5,7,3,1,5,3,0,0,0,0,0,0,0,0,0},
{3,5,7,3,5,3,1,4,8,0,0,0,0,0,0,0},
{3,9,7,3,9,3,0,0,3,1,0,0,0,0,0,0},
{4,7,8,9,7,1,8,7,3,1,4,8,1,0,0,0},
{3,3,10,4,3,4,7,7,4,5,0,0,0,0,0,0},
{4,0,10,8,0,7,10,0,5,7,7,3,10,0,0,0},
{4,4,3,10,0,3,4,0,7,3,0,9,7,0,0,0},
{3,3,9,7,3,10,9,10,8,9,0,0,0,0,0,0},
{2,7,3,11,2,8,6,0,0,0,0,0,0,0,0,0},
{3,2,0,4,2,4,6,3,11,7,0,0,0,0,0,0},
{3,5,0,9,7,3,11,8,6,2,0,0,0,0,0,0},
{4,11,7,3,5,6,9,5,4,6,6,2,9,0,0,0},
{3,4,1,10,6,2,8,11,7,3,0,0,0,0,0,0},
{4,7,3,11,2,1,6,2,0,1,1,10,6,0,0,0},
{4,0,9,5,2,8,6,1,10,4,7,3,11,0,0,0},
{5,9,5,1,9,1,10,9,10,2,6,2,10,7,3,11},
{3,3,1,5,3,5,7,2,8,6,0,0,0,0,0,0},
{4,5,7,1,7,3,1,4,2,0,4,6,2,0,0,0},
{4,8,6,2,9,7,0,0,7,3,0,3,1,0,0,0},
{5,6,9,4,6,2,9,4,9,1,7,3,9,1,9,3},
{4,8,6,2,4,7,10,4,5,7,7,3,10,0,0,0},
{5,7,10,5,7,3,10,5,10,0,6,2,10,0,10,2},
{5,0,9,7,0,7,3,0,3,4,10,4,3,8,6,2},
{4,3,9,7,3,10,9,2,9,6,6,9,10,0,0,0},
{2,11,9,2,3,11,2,0,0,0,0,0,0,0,0,0},
{3,2,3,11,2,11,9,0,4,8,0,0,0,0,0,0},
{3,11,5,0,11,0,3,3,0,2,0,0,0,0,0,0},
{4,8,5,4,8,3,5,8,2,3,3,11,5,0,0,0},
{3,11,9,2,11,2,3,10,4,1,0,0,0,0,0,0},
{4,0,1,8,1,10,8,2,11,9,2,3,11,0,0,0},
{4,4,1,10,0,3,5,0,2,3,3,11,5,0,0,0},
{5,3,5,2,3,11,5,2,5,8,1,10,5,8,5,10},
{3,5,9,2,5,2,1,1,2,3,0,0,0,0,0,0},
{4,4,8,0,5,9,1,1,9,2,1,2,3,0,0,0},
{2,0,2,1,2,3,1,0,0,0,0,0,0,0,0,0},
{3,8,1,4,8,2,1,2,3,1,0,0,0,0,0,0},
{4,9,2,3,9,3,4,9,4,5,10,4,3,0,0,0},
{5,8,5,10,8,0,5,10,5,3,9,2,5,3,5,2},
{3,4,3,10,4,0,3,0,2,3,0,0,0,0,0,0},
{2,3,8,2,10,8,3,0,0,0,0,0,0,0,0,0},
{3,6,3,11,6,11,8,8,11,9,0,0,0,0,0,0},
{4,0,4,6,0,6,11,0,11,9,3,11,6,0,0,0},
{4,11,6,3,5,6,11,5,8,6,5,0,8,0,0,0},
{3,11,6,3,11,5,6,5,4,6,0,0,0,0,0,0},
{4,1,10,4,11,8,3,11,9,8,8,6,3,0,0,0},
{5,1,6,0,1,10,6,0,6,9,3,11,6,9,6,11},
{5,5,0,8,5,8,6,5,6,11,3,11,6,1,10,4},
{4,10,5,1,10,6,5,11,5,3,3,5,6,0,0,0},
{4,5,3,1,5,8,3,5,9,8,8,6,3,0,0,0},
{5,1,9,3,1,5,9,3,9,6,0,4,9,6,9,4},
{3,6,0,8,6,3,0,3,1,0,0,0,0,0,0,0},
{2,6,1,4,3,1,6,0,0,0,0,0,0,0,0,0},
{5,8,3,9,8,6,3,9,3,5,10,4,3,5,3,4},
{2,0,5,9,10,6,3,0,0,0,0,0,0,0,0,0},
{4,6,0,8,6,3,0,4,0,10,10,0,3,0,0,0},
{1,6,3,10,0,0,0,0,0,0,0,0,0,0,0,0},
{2,10,11,7,6,10,7,0,0,0,0,0,0,0,0,0},
{3,10,11,7,10,7,6,8,0,4,0,0,0,0,0,0},
{3,7,6,10,7,10,11,5,0,9,0,0,0,0,0,0},
{4,11,7,6,11,6,10,9,5,8,8,5,4,0,0,0},
{3,1,11,7,1,7,4,4,7,6,0,0,0,0,0,0},
{4,8,0,1,8,1,7,8,7,6,11,7,1,0,0,0},
{4,9,5,0,7,4,11,7,6,4,4,1,11,0,0,0},
{5,9,1,8,9,5,1,8,1,6,11,7,1,6,1,7},
{3,10,1,5,10,5,6,6,5,7,0,0,0,0,0,0},
{4,0,4,8,5,6,1,5,7,6,6,10,1,0,0,0},
{4,9,7,6,9,6,1,9,1,0,1,6,10,0,0,0},
{5,6,1,7,6,10,1,7,1,9,4,8,1,9,1,8},
{2,5,7,4,4,7,6,0,0,0,0,0,0,0,0,0},
{3,0,6,8,0,5,6,5,7,6,0,0,0,0,0,0},
{3,9,4,0,9,7,4,7,6,4,0,0,0,0,0,0},
{2,9,6,8,7,6,9,0,0,0,0,0,0,0,0,0},
{3,7,2,8,7,8,11,11,8,10,0,0,0,0,0,0},
{4,7,2,0,7,0,10,7,10,11,10,0,4,0,0,0},
{4,0,9,5,8,11,2,8,10,11,11,7,2,0,0,0},
{5,11,2,10,11,7,2,10,2,4,9,5,2,4,2,5},
{4,1,11,7,4,1,7,4,7,2,4,2,8,0,0,0},
{3,7,1,11,7,2,1,2,0,1,0,0,0,0,0,0},
{5,4,1,11,4,11,7,4,7,8,2,8,7,0,9,5},
{4,7,1,11,7,2,1,5,1,9,9,1,2,0,0,0},
{4,1,5,7,1,7,8,1,8,10,2,8,7,0,0,0},
{5,0,10,2,0,4,10,2,10,7,1,5,10,7,10,5},
{5,0,7,1,0,9,7,1,7,10,2,8,7,10,7,8},
{2,9,7,2,1,4,10,0,0,0,0,0,0,0,0,0},
{3,8,7,2,8,4,7,4,5,7,0,0,0,0,0,0},
{2,0,7,2,5,7,0,0,0,0,0,0,0,0,0,0},
{4,8,7,2,8,4,7,9,7,0,0,7,4,0,0,0},
{1,9,7,2,0,0,0,0,0,0,0,0,0,0,0,0},
{3,2,6,10,2,10,9,9,10,11,0,0,0,0,0,0},
{4,0,4,8,2,6,9,9,6,10,9,10,11,0,0,0},
{4,5,10,11,5,2,10,5,0,2,6,10,2,0,0,0},
{5,4,2,5,4,8,2,5,2,11,6,10,2,11,2,10},
{4,1,11,9,1,9,6,1,6,4,6,9,2,0,0,0},
{5,9,6,11,9,2,6,11,6,1,8,0,6,1,6,0},
{5,4,11,6,4,1,11,6,11,2,5,0,11,2,11,0},
{2,5,1,11,8,2,6,0,0,0,0,0,0,0,0,0},
{4,2,6,10,9,2,10,9,10,1,9,1,5,0,0,0},
{5,9,2,6,9,6,10,9,10,5,1,5,10,0,4,8},
{3,10,2,6,10,1,2,1,0,2,0,0,0,0,0,0},
{4,10,2,6,10,1,2,8,2,4,4,2,1,0,0,0},
{3,2,5,9,2,6,5,6,4,5,0,0,0,0,0,0},
{4,2,5,9,2,6,5,0,5,8,8,5,6,0,0,0},
{2,2,4,0,6,4,2,0,0,0,0,0,0,0,0,0},
{1,2,6,8,0,0,0,0,0,0,0,0,0,0,0,0},
{2,9,8,11,11,8,10,0,0,0,0,0,0,0,0,0},
{3,4,9,0,4,10,9,10,11,9,0,0,0,0,0,0},
{3,0,11,5,0,8,11,8,10,11,0,0,0,0,0,0},
{2,4,11,5,10,11,4,0,0,0,0,0,0,0,0,0},
{3,1,8,4,1,11,8,11,9,8,0,0,0,0,0,0},
{2,9,1,11,0,1,9,0,0,0,0,0,0,0,0,0},
{4,1,8,4,1,11,8,0,8,5,5,8,11,0,0,0},
{1,5,1,11,0,0,0,0,0,0,0,0,0,0,0,0},
{3,5,10,1,5,9,10,9,8,10,0,0,0,0,0,0},
{4,4,9,0,4,10,9,5,9,1,1,9,10,0,0,0},
{2,0,10,1,8,10,0,0,0,0,0,0,0,0,0,0},
{1,4,10,1,0,0,0,0,0,0,0,0,0,0,0,0},
{2,5,8,4,9,8,5,0,0,0,0,0,0,0,0,0},
{1,0,5,9,0,0,0,0,0,0,0,0,0,0,0,0},
{1,0,8,4,0,0,0,0,0,0,0,0,0,0,0,0},
{0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0}};

typedef struct {
    double *points;
    int64_t *faces, n_points, n_faces, room_points, room_faces;
} Contour;

static int64_t add_point(Contour *c, double x, double y, double z)
{
    if (c->n_points == c->room_points) {
        const int64_t room = c->room_points ? 2 * c->room_points : 4096;
        double *more = realloc(c->points, (size_t)(3 * room) * sizeof *more);
        if (!more)
            return -1;
        c->points = more;
        c->room_points = room;
    }
    double *p = c->points + 3 * c->n_points;
    p[0] = x, p[1] = y, p[2] = z;
    return c->n_points++;
}

static int add_face(Contour *c, const int64_t *corner)
{
    if (c->n_faces == c->room_faces) {
        const int64_t room = c->room_faces ? 2 * c->room_faces : 8192;
        int64_t *more = realloc(c->faces, (size_t)(3 * room) * sizeof *more);
        if (!more)
            return -1;
        c->faces = more;
        c->room_faces = room;
    }
    memcpy(c->faces + 3 * c->n_faces++, corner, 3 * sizeof *corner);
    return 0;
}

static double crossing(float a, float b, double level) { return (level - (double)a) / ((double)b - (double)a); }

/* Which corners of a layer are not below the level. */
static void layer_signs(const float *at, int64_t count, float level, uint8_t *in)
{
    for (int64_t i = 0; i < count; i++)
        in[i] = at[i] >= level;
}

/* Points on the edges that begin in the corners of one layer: along x, y and z (towards the next layer, if any). */
static int layer_points(const float *at, const int64_t *shape, int64_t z, double level, const uint8_t *in,
                        const uint8_t *next, uint8_t *differ, int64_t *ids, Contour *c)
{
    const int64_t ny = shape[1], nx = shape[2], layer = ny * nx;
    for (int64_t y = 0; y < ny; y++, at += nx, in += nx, next += next ? nx : 0) {
        const uint8_t *below = y + 1 < ny ? in + nx : in, *above = next ? next : in;
        for (int64_t x = 0; x + 1 < nx; x++)
            differ[x] = (in[x] ^ in[x + 1]) | (in[x] ^ below[x]) << 1 | (in[x] ^ above[x]) << 2;
        differ[nx - 1] = (in[nx - 1] ^ below[nx - 1]) << 1 | (in[nx - 1] ^ above[nx - 1]) << 2;
        for (int64_t x = 0; x < nx; x++) {
            uint64_t word;
            if (x + 8 <= nx && (memcpy(&word, differ + x, 8), word == 0)) {
                x += 7;
                continue;
            }
            const int which = differ[x];
            const int64_t k = y * nx + x;
            if (which & 1 &&
                (ids[k] = add_point(c, (double)x + crossing(at[x], at[x + 1], level), (double)y, (double)z)) < 0)
                return -1;
            if (which & 2 && (ids[layer + k] = add_point(c, (double)x, (double)y + crossing(at[x], at[x + nx], level),
                                                         (double)z)) < 0)
                return -1;
            if (which & 4 && (ids[2 * layer + k] = add_point(c, (double)x, (double)y,
                                                             (double)z + crossing(at[x], at[x + layer], level))) < 0)
                return -1;
        }
    }
    return 0;
}

/* Triangles of the cubes between two layers, from the signs of their corners. */
static int layer_faces(const int64_t *shape, const uint8_t *in, const uint8_t *next, uint8_t *which,
                       int64_t *const ids[2], Contour *c)
{
    const int64_t ny = shape[1], nx = shape[2], layer = ny * nx;
    for (int64_t y = 0; y + 1 < ny; y++, in += nx, next += nx) {
        const int64_t row = y * nx;
        for (int64_t x = 0; x + 1 < nx; x++) {
            const int low = in[x] | in[x + 1] << 1 | in[x + nx] << 2 | in[x + nx + 1] << 3;
            const int high = next[x] | next[x + 1] << 1 | next[x + nx] << 2 | next[x + nx + 1] << 3;
            which[x] = (uint8_t)(low | high << 4);
        }
        for (int64_t x = 0; x + 1 < nx; x++) {
            const int8_t *how = CASES[which[x]];
            for (int t = 0; t < how[0]; t++) {
                int64_t corner[3];
                for (int k = 0; k < 3; k++) {
                    const int edge = how[1 + 3 * t + k], first = edge & 1, second = edge >> 1 & 1;
                    if (edge < 4)
                        corner[k] = ids[second][row + x + first * nx];
                    else if (edge < 8)
                        corner[k] = ids[second][layer + row + x + first];
                    else
                        corner[k] = ids[0][2 * layer + row + x + first + second * nx];
                }
                if (add_face(c, corner))
                    return -1;
            }
        }
    }
    return 0;
}

/* Contour a field. The points (n, 3; index x, y, z) and faces (m, 3) are handed over in memory that `released`
 * frees. Returns 0. */
API int64_t contoured(const float *field, const int64_t *shape, double level, double **points, int64_t *n_points,
                      int64_t **faces, int64_t *n_faces)
{
    const int64_t nz = shape[0], layer = shape[1] * shape[2];
    Contour c = {NULL, NULL, 0, 0, 0, 0};
    int64_t *memory = malloc((size_t)(6 * layer) * sizeof *memory);
    int64_t *ids[2] = {memory, memory ? memory + 3 * layer : NULL};
    uint8_t *bytes = malloc((size_t)(3 * layer + shape[2]));
    uint8_t *in[3] = {bytes, bytes ? bytes + layer : NULL, bytes ? bytes + 2 * layer : NULL};
    float limit = (float)level; /* the least single number that is not below the level */
    if ((double)limit < level)
        limit = nextafterf(limit, INFINITY);
    int bad = !memory || !bytes;
    if (!bad) {
        layer_signs(field, layer, limit, in[0]);
        if (nz > 1)
            layer_signs(field + layer, layer, limit, in[1]);
        bad = layer_points(field, shape, 0, level, in[0], nz > 1 ? in[1] : NULL, bytes + 3 * layer, ids[0], &c);
    }
    for (int64_t z = 0; !bad && z + 1 < nz; z++) {
        const float *at = field + (z + 1) * layer;
        if (z + 2 < nz)
            layer_signs(at + layer, layer, limit, in[2]);
        bad = layer_points(at, shape, z + 1, level, in[1], z + 2 < nz ? in[2] : NULL, bytes + 3 * layer, ids[1], &c) ||
              layer_faces(shape, in[0], in[1], bytes + 3 * layer, ids, &c);
        int64_t *next = ids[1];
        ids[1] = ids[0];
        ids[0] = next;
        uint8_t *first = in[0];
        in[0] = in[1], in[1] = in[2], in[2] = first;
    }
    free(memory);
    free(bytes);
    if (bad) {
        free(c.points);
        free(c.faces);
        return -1;
    }
    *points = c.points, *n_points = c.n_points;
    *faces = c.faces, *n_faces = c.n_faces;
    return 0;
}

API void released(void *memory) { free(memory); }

static int64_t root_of(int64_t *parent, int64_t k)
{
    while (parent[k] != k) {
        parent[k] = parent[parent[k]];
        k = parent[k];
    }
    return k;
}

/* Number the connected pieces of n nodes joined by edges (m, 2), in the order of their first nodes, from 0. Nodes
 * that lie outside 0 .. n - 1 are not joined. Returns how many pieces there are. */
API int64_t graph_pieces(int64_t n, const int64_t *edges, int64_t m, int64_t *piece)
{
    for (int64_t k = 0; k < n; k++)
        piece[k] = k;
    for (int64_t k = 0; k < m; k++) {
        if (edges[2 * k] < 0 || edges[2 * k] >= n || edges[2 * k + 1] < 0 || edges[2 * k + 1] >= n)
            continue;
        const int64_t a = root_of(piece, edges[2 * k]), b = root_of(piece, edges[2 * k + 1]);
        piece[most(a, b)] = least(a, b);
    }
    for (int64_t k = 0; k < n; k++)
        piece[k] = piece[k] == k ? k : piece[piece[k]]; /* roots come first and stay */
    int64_t count = 0;
    for (int64_t k = 0; k < n; k++)
        piece[k] = piece[k] == k ? -(++count) : piece[piece[k]];
    for (int64_t k = 0; k < n; k++)
        piece[k] = -piece[k] - 1;
    return count;
}

/* Put a matrix into compressed rows: a diagonal (n,), which comes first, and m entries, those at one place added up.
 * `start` has n + 1 places, `column` and `value` n + m. Returns how many are used. */
API int64_t assembled(int64_t n, int64_t m, const int64_t *row, const int64_t *col, const double *entry,
                      const double *diagonal, int64_t *start, int32_t *column, double *value)
{
    int64_t *first = calloc((size_t)(n + 1), sizeof *first), used = 0;
    int64_t *order = malloc((size_t)most(m, 1) * sizeof *order);
    if (!first || !order) {
        free(first);
        free(order);
        return -1;
    }
    for (int64_t k = 0; k < m; k++)
        first[row[k] + 1]++;
    for (int64_t i = 0; i < n; i++)
        first[i + 1] += first[i];
    for (int64_t k = 0; k < m; k++)
        order[first[row[k]]++] = k;
    for (int64_t i = 0, next = 0; i < n; i++) { /* first[i] has moved on to where row i ends */
        start[i] = used;
        column[used] = (int32_t)i;
        value[used++] = diagonal[i];
        for (; next < first[i]; next++) {
            int64_t at = start[i];
            while (at < used && column[at] != col[order[next]])
                at++;
            if (at == used) {
                column[used] = (int32_t)col[order[next]];
                value[used++] = 0.0;
            }
            value[at] += entry[order[next]];
        }
    }
    start[n] = used;
    free(first);
    free(order);
    return used;
}

/* So many right-hand sides are solved at once: their sums do not wait for each other. */
#define SIDES 4
typedef double Sides __attribute__((vector_size(SIDES * sizeof(double)), aligned(sizeof(double))));

/* Solve A x = b for `use` right-hand sides, SIDES at most: the first columns of b and x (n, wide). */
INLINED void solve_sides(int64_t n, const int64_t *start, const int32_t *column, const double *value, int64_t wide,
                         int64_t use, const double *b, double accuracy, int64_t most_rounds, Sides *memory, double *x)
{
    Sides *r = memory, *p = r + n, *q = p + n, *own = q + n;
    Sides size = {0.0}, rho = {0.0}, step = {0.0}, turn = {0.0};
    double *inverse = (double *)(own + n);
    int runs[SIDES], more = 0;
    for (int64_t i = 0; i < n; i++) {
        inverse[i] = 1.0 / value[start[i]];
        for (int w = 0; w < SIDES; w++)
            r[i][w] = w < use ? b[i * wide + w] : 0.0;
        own[i] = r[i] * inverse[i];
        size += r[i] * r[i] * inverse[i];
    }
    for (int64_t i = 0; i < n; i++) {
        for (int64_t k = start[i]; k < start[i + 1]; k++)
            r[i] -= value[k] * own[column[k]];
        p[i] = inverse[i] * r[i];
        rho += r[i] * p[i];
    }
    for (int w = 0; w < SIDES; w++)
        more |= runs[w] = rho[w] > accuracy * accuracy * size[w];
    for (int64_t round = 0; round < most_rounds && more; round++) {
        Sides along = {0.0}, next = {0.0};
        for (int64_t i = 0; i < n; i++) {
            Sides sum = {0.0};
            for (int64_t k = start[i]; k < start[i + 1]; k++)
                sum += value[k] * p[column[k]];
            q[i] = sum;
            along += p[i] * sum;
        }
        for (int w = 0; w < SIDES; w++) { /* one that has ended moves no more */
            runs[w] = runs[w] && along[w] > 0.0;
            step[w] = runs[w] ? rho[w] / along[w] : 0.0;
        }
        for (int64_t i = 0; i < n; i++) {
            own[i] += step * p[i];
            r[i] -= step * q[i];
            next += r[i] * inverse[i] * r[i];
        }
        more = 0;
        for (int w = 0; w < SIDES; w++) {
            turn[w] = runs[w] ? next[w] / rho[w] : 0.0;
            more |= runs[w] = runs[w] && next[w] > accuracy * accuracy * size[w];
        }
        rho = next;
        for (int64_t i = 0; i < n; i++)
            p[i] = inverse[i] * r[i] + turn * p[i];
    }
    for (int64_t i = 0; i < n; i++)
        for (int w = 0; w < use; w++)
            x[i * wide + w] = own[i][w];
}

/* Solve A x = b for `wide` right-hand sides (n, wide) by conjugate gradients with the diagonal as preconditioner
 * (Hestenes and Stiefel 1952, doi:10.6028/jres.049.044). A is symmetric and positive definite, in compressed rows.
 * Each stops at `accuracy` of its right-hand side or where it no longer gets better. Returns 0, or -1. */
API CLONES int64_t solved(int64_t n, const int64_t *start, const int32_t *column, const double *value, int64_t wide,
                          const double *b, double accuracy, int64_t most_rounds, double *x)
{
    Sides *memory = malloc((size_t)n * (4 * sizeof(Sides) + sizeof(double)));
    if (!memory)
        return -1;
    for (int64_t w = 0; w < wide; w += SIDES)
        solve_sides(n, start, column, value, wide, least(SIDES, wide - w), b + w, accuracy, most_rounds, memory, x + w);
    free(memory);
    return 0;
}

typedef struct {
    int64_t corner[3], normal[3], offset;
} Side;

static void side_through(const int64_t *p, int64_t a, int64_t b, int64_t c, Side *s)
{
    const int64_t *o = p + 3 * a, *u = p + 3 * b, *v = p + 3 * c;
    const int64_t ux = u[0] - o[0], uy = u[1] - o[1], uz = u[2] - o[2];
    const int64_t vx = v[0] - o[0], vy = v[1] - o[1], vz = v[2] - o[2];
    s->corner[0] = a, s->corner[1] = b, s->corner[2] = c;
    s->normal[0] = uy * vz - uz * vy;
    s->normal[1] = uz * vx - ux * vz;
    s->normal[2] = ux * vy - uy * vx;
    s->offset = s->normal[0] * o[0] + s->normal[1] * o[1] + s->normal[2] * o[2];
}

static int64_t height(const Side *s, const int64_t *p)
{
    return s->normal[0] * p[0] + s->normal[1] * p[1] + s->normal[2] * p[2] - s->offset;
}

/* Say which points (m, 3) lie in the convex hull of points (n, 3), or within 0.02 of it. Whole numbers from 0 to 511.
 * The hull grows point by point; all are scaled by 1024 and shaken by one part, so that no four lie in a plane and whole
 * numbers decide exactly. Returns the number of sides; 0 where the points span no body, -1 out of memory. */
API int64_t in_hull(const int64_t *points, int64_t n, const int64_t *asked, int64_t m, uint8_t *inside)
{
    int64_t room = 256, count = 0, result = 0, start[4] = {0, -1, -1, -1};
    uint64_t noise = 88172645463325252u;
    int64_t *p = malloc((size_t)(3 * most(n, 1)) * sizeof *p), *rim = malloc((size_t)(6 * room) * sizeof *rim);
    Side *side = malloc((size_t)room * sizeof *side);
    if (!p || !rim || !side) {
        result = -1;
        goto done;
    }
    for (int64_t k = 0; k < 3 * n; k++) {
        noise ^= noise << 13, noise ^= noise >> 7, noise ^= noise << 17;
        p[k] = 1024 * points[k] + (int64_t)(noise % 3) - 1;
    }
    memset(inside, 0, (size_t)m);
    /* a first tetrahedron: of the points after the first, one apart, one off the line, one off the plane */
    for (int64_t k = 1; k < n && start[3] < 0; k++) {
        Side s;
        if (start[1] < 0) {
            if (memcmp(p, p + 3 * k, 3 * sizeof *p))
                start[1] = k;
        } else if (start[2] < 0) {
            side_through(p, 0, start[1], k, &s);
            if (s.normal[0] || s.normal[1] || s.normal[2])
                start[2] = k;
        } else {
            side_through(p, 0, start[1], start[2], &s);
            if (height(&s, p + 3 * k))
                start[3] = k;
        }
    }
    if (start[3] < 0)
        goto done;
    for (int k = 0; k < 4; k++) {
        const int64_t a = start[(k + 1) % 4], b = start[(k + 2) % 4], c = start[(k + 3) % 4];
        side_through(p, a, b, c, side + count);
        if (height(side + count, p + 3 * start[k]) > 0)
            side_through(p, a, c, b, side + count);
        count++;
    }
    for (int64_t k = 0; k < n; k++) {
        int64_t edges = 0, kept = 0;
        for (int64_t s = 0; s < count; s++) {
            if (height(side + s, p + 3 * k) <= 0)
                continue;
            /* an edge seen from both of its sides is no part of the rim */
            for (int e = 0; e < 3; e++) {
                const int64_t a = side[s].corner[e], b = side[s].corner[(e + 1) % 3];
                int64_t same = 0;
                while (same < edges && !(rim[2 * same] == b && rim[2 * same + 1] == a))
                    same++;
                if (same < edges) {
                    edges--;
                    rim[2 * same] = rim[2 * edges], rim[2 * same + 1] = rim[2 * edges + 1];
                } else {
                    rim[2 * edges] = a, rim[2 * edges + 1] = b;
                    edges++;
                }
            }
        }
        if (!edges)
            continue;
        for (int64_t s = 0; s < count; s++)
            if (height(side + s, p + 3 * k) <= 0)
                side[kept++] = side[s];
        count = kept;
        if (count + edges > room) {
            room = 2 * (count + edges);
            Side *more = realloc(side, (size_t)room * sizeof *side);
            if (more)
                side = more;
            int64_t *longer = more ? realloc(rim, (size_t)(6 * room) * sizeof *rim) : NULL;
            if (!longer) {
                result = -1;
                goto done;
            }
            rim = longer;
        }
        for (int64_t e = 0; e < edges; e++)
            side_through(p, rim[2 * e], rim[2 * e + 1], k, side + count++);
    }
    for (int64_t k = 0; k < m; k++) {
        const int64_t q[3] = {1024 * asked[3 * k], 1024 * asked[3 * k + 1], 1024 * asked[3 * k + 2]};
        int64_t s = 0;
        for (; s < count; s++) {
            const double nx = (double)side[s].normal[0], ny = (double)side[s].normal[1], nz = (double)side[s].normal[2];
            if ((double)height(side + s, q) > 20.48 * sqrt(nx * nx + ny * ny + nz * nz))
                break;
        }
        inside[k] = s == count;
    }
    result = count;
done:
    free(p);
    free(rim);
    free(side);
    return result;
}
