/* Shares of voxels that lie in a body whose surface is where a field is zero. */
#include "stapes.h"

#define LANES 16
#define EACH(n) for (int k = 0; k < (n); k++)

/* Values a quarter of a voxel from the middle, on the side of `other`. */
INLINED void quarter(const float *middle, const float *other, int count, float *to)
{
    EACH(count) to[k] = 0.75f * middle[k] + 0.25f * other[k];
}

/* Shares of LANES voxels along x: the mean of eight samples a quarter of a voxel from the centre, each interpolated
 * linearly and softened. rows[3 * z + y] holds the LANES + 2 values of the voxels around. */
INLINED void shares_of(float rows[9][LANES + 2], float per_soft, float *to)
{
    float along_z[3][LANES + 2], along_y[LANES + 2], sample[LANES];
    EACH(LANES) to[k] = 0.0f;
    for (int z = 0; z <= 2; z += 2) {
        for (int y = 0; y < 3; y++)
            quarter(rows[3 + y], rows[3 * z + y], LANES + 2, along_z[y]);
        for (int y = 0; y <= 2; y += 2) {
            quarter(along_z[1], along_z[y], LANES + 2, along_y);
            for (int x = 0; x <= 2; x += 2) {
                quarter(along_y + 1, along_y + x, LANES, sample);
                EACH(LANES)
                {
                    float inside = sample[k] * per_soft + 0.5f;
                    inside = inside > 0.0f ? inside : 0.0f;
                    to[k] += inside < 1.0f ? inside : 1.0f;
                }
            }
        }
    }
    EACH(LANES) to[k] *= 0.125f;
}

/* So many of the nine voxels around in z and y are inside, for each voxel of a row. */
INLINED void count_nine(const uint8_t *inside, int64_t nx, int64_t layer, uint8_t *restrict to)
{
    const uint8_t *restrict a = inside - layer, *restrict b = inside, *restrict c = inside + layer;
    for (int64_t x = 0; x < nx; x++)
        to[x] = (uint8_t)(a[x - nx] + a[x] + a[x + nx] + b[x - nx] + b[x] + b[x + nx] + c[x - nx] + c[x] + c[x + nx]);
}

/* Shares of all voxels: 1 where the field is positive, 0 elsewhere, and that of shares_of where both are among the
 * 27 voxels around. The outermost voxels stay 1 or 0; what is no number counts as outside. */
API CLONES int64_t sampled_shares(const float *restrict field, const int64_t *shape, float soft,
                                  float *restrict out)
{
    const int64_t nz = shape[0], ny = shape[1], nx = shape[2], layer = ny * nx;
    uint8_t *restrict inside = malloc((size_t)(nz * layer)), *restrict nine = calloc((size_t)nx + LANES + 1, 1);
    uint8_t *full = malloc((size_t)(nz * ny)); /* rows with anything inside */
    const int room = inside && nine && full;
    for (int64_t i = 0; room && i < nz * layer; i++)
        out[i] = field[i] > 0.0f ? 1.0f : 0.0f;
    for (int64_t i = 0; room && i < nz * layer; i++)
        inside[i] = field[i] > 0.0f;
    for (int64_t r = 0; room && r < nz * ny; r++)
        full[r] = memchr(inside + r * nx, 1, (size_t)nx) != NULL;
    for (int64_t z = 1; room && z + 1 < nz; z++)
        for (int64_t y = 1; y + 1 < ny; y++) {
            const int64_t row = z * layer + y * nx;
            const uint8_t *around = full + z * ny + y - 1;
            if (!memchr(around - ny, 1, 3) && !memchr(around, 1, 3) && !memchr(around + ny, 1, 3))
                continue;
            count_nine(inside + row, nx, layer, nine);
            for (int64_t x = 1; x + 1 < nx; x += LANES) {
                const int64_t count = least(LANES, nx - 1 - x);
                static const uint8_t none[LANES + 2];
                float rows[9][LANES + 2], share[LANES];
                uint8_t rim[LANES], any = 0;
                if (!memcmp(nine + x - 1, none, sizeof none))
                    continue;
                EACH(LANES) rim[k] = (uint8_t)(nine[x + k - 1] + nine[x + k] + nine[x + k + 1] - 1) < 26;
                EACH(LANES) any |= rim[k];
                if (!any)
                    continue;
                memset(rows, 0, sizeof rows);
                for (int r = 0; r < 9; r++)
                    memcpy(rows[r], field + row + x - 1 + (r / 3 - 1) * layer + (r % 3 - 1) * nx,
                           (size_t)(count + 2) * sizeof(float));
                shares_of(rows, 1.0f / soft, share);
                for (int k = 0; k < count; k++)
                    if (rim[k])
                        out[row + x + k] = share[k];
            }
        }
    free(inside);
    free(nine);
    free(full);
    return room ? 0 : -1;
}
