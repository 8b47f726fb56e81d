/* Labels: voxels above a grey value in the cells of a coarser grid. */
#include "stapes.h"

/* Write `number` where a voxel lies in a cell and above a grey value: `above` for all cells, or that of each cell in
 * `of_cell`, rounded down and kept within `lowest` .. `highest`. Everything is x, y, z here: `low` is the place of the
 * part's first voxel, `size` its extent, `first` the first voxel of the first cell, `step` the voxels of a cell.
 * `stride` is the distance of rows and layers in the scan. */
#define MARKED(NAME, T)                                                                                              \
    API void NAME(const T *part, const int64_t *stride, const int64_t *low, const int64_t *size, const uint8_t *cells, \
                  const int64_t *cell_shape, const int64_t *first, const int64_t *step, double above,                 \
                  const float *of_cell, double lowest, double highest, int64_t number, uint8_t *labels)               \
    {                                                                                                                \
        for (int64_t z = 0; z < size[2]; z++) {                                                                      \
            const int64_t dz = low[2] + z - first[2], cz = dz / step[2];                                             \
            if (dz < 0 || cz >= cell_shape[0])                                                                       \
                continue;                                                                                            \
            for (int64_t y = 0; y < size[1]; y++) {                                                                  \
                const int64_t dy = low[1] + y - first[1], cy = dy / step[1];                                         \
                if (dy < 0 || cy >= cell_shape[1])                                                                   \
                    continue;                                                                                        \
                const uint8_t *cell = cells + (cz * cell_shape[1] + cy) * cell_shape[2];                             \
                const T *from = part + z * stride[1] + y * stride[0];                                                \
                uint8_t *to = labels + (z * size[1] + y) * size[0];                                                  \
                for (int64_t c = 0; c < cell_shape[2];) {                                                            \
                    if (!cell[c]) {                                                                                  \
                        const uint8_t *next = memchr(cell + c, 1, (size_t)(cell_shape[2] - c));                      \
                        if (!next)                                                                                   \
                            break;                                                                                   \
                        c = next - cell;                                                                             \
                    }                                                                                                \
                    int64_t end = c + 1;                                                                             \
                    while (!of_cell && end < cell_shape[2] && cell[end])                                             \
                        end++;                                                                                       \
                    double limit = floor(of_cell ? (double)of_cell[cell - cells + c] : above);                       \
                    limit = limit < lowest ? lowest : limit > highest ? highest : limit;                             \
                    const T over = (T)limit;                                                                         \
                    const int64_t x0 = most(first[0] + c * step[0] - low[0], 0);                                     \
                    const int64_t x1 = least(first[0] + end * step[0] - low[0], size[0]);                            \
                    for (int64_t x = x0; x < x1; x++)                                                                \
                        to[x] = from[x] > over ? (uint8_t)number : to[x];                                            \
                    c = end;                                                                                         \
                }                                                                                                    \
            }                                                                                                        \
        }                                                                                                            \
    }

MARKED(marked_uint8, uint8_t)
MARKED(marked_int8, int8_t)
MARKED(marked_uint16, uint16_t)
MARKED(marked_int16, int16_t)
