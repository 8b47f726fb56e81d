/* What is measured voxel by voxel: distances, the inside of materials, block means, sums over masks, moments. */
#include "stapes.h"

/* Squared distances from a mask along x, y, z in units of `unit`, as far as `steps` voxels: a minimum over shifted
 * parabolas, axis by axis (Felzenszwalb and Huttenlocher 2012, doi:10.4086/toc.2012.v008a019). `far` stands for what
 * lies beyond. The result is root(square) * edge, at most `cap`. */
#define CAPPED(NAME, T)                                                                                             \
    API int64_t NAME(const uint8_t *mask, const int64_t *shape, const int64_t *steps, const double *unit, double far, \
                     float edge, float cap, float *out)                                                             \
    {                                                                                                               \
        const int64_t nz = shape[0], ny = shape[1], nx = shape[2], layer = ny * nx;                                 \
        const int64_t longest = most(steps[0], most(steps[1], steps[2])) + 1;                                       \
        T *all = malloc((size_t)(nz * layer) * sizeof *all), *flat = malloc((size_t)layer * sizeof *flat);          \
        T *line = malloc((size_t)nx * sizeof *line), *raised = malloc((size_t)(3 * longest) * sizeof *raised);      \
        uint8_t *used = calloc((size_t)(nz * ny + ny), 1), *seen = used ? used + nz * ny : NULL;                    \
        const int bad = !all || !flat || !line || !raised || !used;                                                 \
        for (int a = 0; !bad && a < 3; a++)                                                                         \
            for (int64_t k = 0; k <= steps[a]; k++)                                                                 \
                raised[a * longest + k] = (T)((double)(k * k) * unit[a]);                                           \
        for (int64_t z = 0; !bad && z < nz; z++) {                                                                  \
            T *here = all + z * layer;                                                                              \
            int any = 0;                                                                                            \
            for (int64_t y = 0; y < ny; y++) {                                                                      \
                const uint8_t *row = mask + z * layer + y * nx;                                                     \
                T *to = flat + y * nx;                                                                              \
                seen[y] = memchr(row, 1, (size_t)nx) != NULL;                                                       \
                any |= seen[y];                                                                                     \
                if (!seen[y])                                                                                       \
                    continue;                                                                                       \
                int64_t away = steps[0] + 1;                                                                        \
                for (int64_t x = 0; x < nx; x++) {                                                                  \
                    away = row[x] ? 0 : away + 1;                                                                   \
                    to[x] = away <= steps[0] ? raised[away] : (T)far;                                               \
                }                                                                                                   \
                away = steps[0] + 1;                                                                                \
                for (int64_t x = nx - 1; x >= 0; x--) {                                                             \
                    away = row[x] ? 0 : away + 1;                                                                   \
                    if (away <= steps[0] && raised[away] < to[x])                                                   \
                        to[x] = raised[away];                                                                       \
                }                                                                                                   \
            }                                                                                                       \
            for (int64_t y = 0; any && y < ny; y++) {                                                               \
                T *to = here + y * nx;                                                                              \
                for (int64_t x = 0; x < nx; x++)                                                                    \
                    to[x] = (T)far;                                                                                 \
                for (int64_t k = most(0, y - steps[1]); k <= least(ny - 1, y + steps[1]); k++) {                    \
                    const T more = raised[longest + (k < y ? y - k : k - y)];                                       \
                    const T *from = flat + k * nx;                                                                  \
                    if (!seen[k])                                                                                   \
                        continue;                                                                                   \
                    used[z * ny + y] = 1;                                                                           \
                    for (int64_t x = 0; x < nx; x++) {                                                              \
                        const T sum = (T)(from[x] + more);                                                          \
                        to[x] = sum < to[x] ? sum : to[x];                                                          \
                    }                                                                                               \
                }                                                                                                   \
            }                                                                                                       \
        }                                                                                                           \
        for (int64_t y = 0; !bad && y < ny; y++)                                                                    \
            for (int64_t z = 0; z < nz; z++) {                                                                      \
                float *to = out + z * layer + y * nx;                                                               \
                int any = 0;                                                                                        \
                for (int64_t k = most(0, z - steps[2]); k <= least(nz - 1, z + steps[2]); k++) {                    \
                    const T more = raised[2 * longest + (k < z ? z - k : k - z)];                                   \
                    const T *from = all + k * layer + y * nx;                                                       \
                    if (!used[k * ny + y])                                                                          \
                        continue;                                                                                   \
                    for (int64_t x = 0; x < nx; x++) {                                                              \
                        const T sum = (T)(from[x] + more);                                                          \
                        line[x] = !any || sum < line[x] ? sum : line[x];                                            \
                    }                                                                                               \
                    any = 1;                                                                                        \
                }                                                                                                   \
                for (int64_t x = 0; x < nx; x++) {                                                                  \
                    const float root = any ? sqrtf((float)line[x]) * edge : cap;                                    \
                    to[x] = root < cap ? root : cap;                                                                \
                }                                                                                                   \
            }                                                                                                       \
        free(all);                                                                                                  \
        free(flat);                                                                                                 \
        free(line);                                                                                                 \
        free(raised);                                                                                               \
        free(used);                                                                                                 \
        return bad ? -1 : 0;                                                                                        \
    }

CAPPED(capped_whole, uint16_t)
CAPPED(capped_float, float)

/* Grow a mask by a voxel in all 26 directions. */
API int64_t spread(const uint8_t *mask, const int64_t *shape, uint8_t *out)
{
    const int64_t nz = shape[0], ny = shape[1], nx = shape[2], layer = ny * nx;
    uint8_t *wide = malloc((size_t)(nz * layer)), *high = malloc((size_t)(nz * layer));
    if (!wide || !high) {
        free(wide);
        free(high);
        return -1;
    }
    for (int64_t r = 0; r < nz * ny; r++) {
        const uint8_t *from = mask + r * nx;
        uint8_t *to = wide + r * nx;
        memcpy(to, from, (size_t)nx);
        for (int64_t x = 1; x < nx; x++)
            to[x] |= from[x - 1];
        for (int64_t x = 1; x < nx; x++)
            to[x - 1] |= from[x];
    }
    for (int64_t z = 0; z < nz; z++)
        for (int64_t y = 0; y < ny; y++)
            for (int64_t k = most(y - 1, 0); k <= least(y + 1, ny - 1); k++)
                for (int64_t x = 0; x < nx; x++) {
                    const uint8_t seen = wide[z * layer + k * nx + x];
                    uint8_t *to = high + z * layer + y * nx + x;
                    *to = k == most(y - 1, 0) ? seen : *to | seen;
                }
    for (int64_t z = 0; z < nz; z++)
        for (int64_t k = most(z - 1, 0); k <= least(z + 1, nz - 1); k++)
            for (int64_t i = 0; i < layer; i++) {
                const uint8_t seen = high[k * layer + i];
                out[z * layer + i] = k == most(z - 1, 0) ? seen : out[z * layer + i] | seen;
            }
    free(wide);
    free(high);
    return 0;
}

/* The place of every n-th voxel of a mask, from the first on. Returns how many were written, at most `room`. */
API int64_t every_nth(const uint8_t *mask, int64_t total, int64_t n, int64_t room, int64_t *place)
{
    int64_t seen = 0, written = 0;
    for (int64_t i = 0; i < total && written < room; i++) {
        if (mask[i] && seen % n == 0)
            place[written++] = i;
        seen += mask[i] != 0;
    }
    return written;
}

/* Number and sum of grey values in a mask: by layer (n along z), by row (y), by column (x), and by eighth of the box,
 * which is halved behind n / 2 + 1 voxels. `count` and `sum` hold nz + ny + nx + 8 values. */
API void masked_sums(const float *grey, const uint8_t *mask, const int64_t *shape, int64_t *count, double *sum)
{
    const int64_t nz = shape[0], ny = shape[1], nx = shape[2], all = nz + ny + nx, half = nx / 2 + 1;
    memset(count, 0, (size_t)(all + 8) * sizeof *count);
    memset(sum, 0, (size_t)(all + 8) * sizeof *sum);
    for (int64_t z = 0; z < nz; z++)
        for (int64_t y = 0; y < ny; y++, grey += nx, mask += nx) {
            if (!memchr(mask, 1, (size_t)nx))
                continue;
            const int64_t eighth = 4 * (z > nz / 2) + 2 * (y > ny / 2);
            for (int part = 0; part < 2; part++) {
                int64_t number = 0;
                double total = 0.0;
                for (int64_t x = part ? half : 0; x < (part ? nx : least(half, nx)); x++) {
                    const double value = mask[x] ? (double)grey[x] : 0.0;
                    number += mask[x];
                    total += value;
                    count[nz + ny + x] += mask[x];
                    sum[nz + ny + x] += value;
                }
                count[z] += number, sum[z] += total;
                count[nz + y] += number, sum[nz + y] += total;
                count[all + eighth + part] += number, sum[all + eighth + part] += total;
            }
        }
}

/* Sum of the squares of what values in a mask differ from a level by. */
API void masked_squares(const float *grey, const uint8_t *mask, int64_t total, double level, double *sum)
{
    double all = 0.0;
    for (int64_t start = 0; start < total; start += 4096) {
        double part = 0.0;
        for (int64_t i = start; i < least(start + 4096, total); i++) {
            const double away = mask[i] ? (double)grey[i] - level : 0.0;
            part += away * away;
        }
        all += part;
    }
    *sum = all;
}

/* The lowest value in a mask, and how many have it. */
#define LOWEST(NAME, T)                                                                  \
    API void NAME(const T *value, const uint8_t *mask, int64_t total, double *low, int64_t *count) \
    {                                                                                    \
        int64_t found = 0;                                                               \
        T least_seen = 0;                                                                \
        for (int64_t i = 0; i < total; i++)                                              \
            if (mask[i] && (!found || value[i] <= least_seen)) {                         \
                found = found && value[i] == least_seen ? found + 1 : 1;                 \
                least_seen = value[i];                                                   \
            }                                                                            \
        *low = (double)least_seen;                                                       \
        *count = found;                                                                  \
    }

LOWEST(lowest_uint8, uint8_t)
LOWEST(lowest_int16, int16_t)
LOWEST(lowest_uint16, uint16_t)
LOWEST(lowest_float32, float)

/* Voxels of a mask with grey values between two, `reach` voxels (z, y, x) off the border. Returns how many there are;
 * their places z, y, x are written as far as there is room. */
API int64_t between(const float *grey, const uint8_t *mask, const int64_t *shape, const int64_t *reach, float low,
                    float high, int64_t room, int64_t *place)
{
    int64_t found = 0;
    for (int64_t z = reach[0]; z < shape[0] - reach[0]; z++)
        for (int64_t y = reach[1]; y < shape[1] - reach[1]; y++) {
            const int64_t row = (z * shape[1] + y) * shape[2];
            if (!memchr(mask + row, 1, (size_t)shape[2]))
                continue;
            for (int64_t x = reach[2]; x < shape[2] - reach[2]; x++)
                if (mask[row + x] && grey[row + x] > low && grey[row + x] < high) {
                    if (found < room) {
                        place[3 * found] = z;
                        place[3 * found + 1] = y;
                        place[3 * found + 2] = x;
                    }
                    found++;
                }
        }
    return found;
}

/* The value and its slopes along z, y, x at places (n, 3), smoothed by separable weights: `weights` holds for z, y and
 * x in turn those of the value and those of the slope, 2 reach + 1 each. `out` is (n, 4). */
API void smooth_slopes(const float *grey, const int64_t *shape, const int64_t *place, int64_t count,
                       const int64_t *reach, const double *weights, double *out)
{
    const int64_t wide[3] = {2 * reach[0] + 1, 2 * reach[1] + 1, 2 * reach[2] + 1};
    const double *wz = weights, *wy = wz + 2 * wide[0], *wx = wy + 2 * wide[1];
    for (int64_t n = 0; n < count; n++) {
        double value = 0.0, sz = 0.0, sy = 0.0, sx = 0.0;
        for (int64_t i = 0; i < wide[0]; i++) {
            double plain = 0.0, along_y = 0.0, along_x = 0.0;
            for (int64_t j = 0; j < wide[1]; j++) {
                const float *row = grey + ((place[3 * n] - reach[0] + i) * shape[1] + place[3 * n + 1] - reach[1] + j) * shape[2] +
                                   place[3 * n + 2] - reach[2];
                double a = 0.0, b = 0.0;
                for (int64_t k = 0; k < wide[2]; k++) {
                    a += (double)row[k] * wx[k];
                    b += (double)row[k] * wx[wide[2] + k];
                }
                plain += a * wy[j];
                along_y += a * wy[wide[1] + j];
                along_x += b * wy[j];
            }
            value += plain * wz[i];
            sz += plain * wz[wide[0] + i];
            sy += along_y * wz[i];
            sx += along_x * wz[i];
        }
        out[4 * n] = value, out[4 * n + 1] = sz, out[4 * n + 2] = sy, out[4 * n + 3] = sx;
    }
}

/* Index x, y, z and grey value of the voxels of a mask; noise[1] where `inner` holds, else noise[0]. */
API void gathered(const float *grey, const uint8_t *mask, const uint8_t *inner, const int64_t *shape,
                  const double *noise, double *index, double *value, double *own_noise)
{
    for (int64_t z = 0; z < shape[0]; z++)
        for (int64_t y = 0; y < shape[1]; y++, mask += shape[2], inner += shape[2], grey += shape[2]) {
            if (!memchr(mask, 1, (size_t)shape[2]))
                continue;
            for (int64_t x = 0; x < shape[2]; x++)
                if (mask[x]) {
                    index[0] = (double)x, index[1] = (double)y, index[2] = (double)z;
                    index += 3;
                    *value++ = (double)grey[x];
                    *own_noise++ = noise[inner[x] != 0];
                }
        }
}

static void placed(const double *index, const double *axes, const double *middle, double *p)
{
    const double x = index[0] - middle[0], y = index[1] - middle[1], z = index[2] - middle[2];
    for (int a = 0; a < 3; a++)
        p[a] = axes[3 * a] * x + axes[3 * a + 1] * y + axes[3 * a + 2] * z;
}

/* Sums of w p p^T with p = (1, axes (index - middle)) and w = (grey - air) / contrast, (4, 4). */
API void raw_moments(const double *index, const double *grey, int64_t count, const double *axes, const double *middle,
                     double air, double contrast, double *raw)
{
    double total[10] = {0};
    for (int64_t start = 0; start < count; start += 4096) {
        double sum[10] = {0};
        for (int64_t n = start; n < least(start + 4096, count); n++) {
            const double w = (grey[n] - air) / contrast;
            double p[3];
            placed(index + 3 * n, axes, middle, p);
            const double wx = w * p[0], wy = w * p[1], wz = w * p[2];
            sum[0] += w, sum[1] += wx, sum[2] += wy, sum[3] += wz;
            sum[4] += wx * p[0], sum[5] += wx * p[1], sum[6] += wx * p[2];
            sum[7] += wy * p[1], sum[8] += wy * p[2], sum[9] += wz * p[2];
        }
        for (int k = 0; k < 10; k++)
            total[k] += sum[k];
    }
    for (int a = 0, k = 0; a < 4; a++)
        for (int b = a; b < 4; b++, k++)
            raw[4 * a + b] = raw[4 * b + a] = total[k];
}

/* How the moments answer to every step-th voxel: with f the ten sensitivities times `scale`, the sums of f (1 - w),
 * f w (10 each) and noise^2 f f^T (10, 10), times `step`. */
API void answers(const double *index, const double *grey, const double *noise, int64_t count, int64_t step,
                 const double *axes, const double *middle, const double *centroid, double volume, double sigma,
                 double scale, double air, double contrast, double *to_air, double *to_bone, double *to_noise)
{
    const double s2 = sigma * sigma;
    double a[10] = {0}, b[10] = {0}, c[100] = {0};
    for (int64_t n = 0; n < count; n += step) {
        const double w = (grey[n] - air) / contrast;
        double p[3];
        placed(index + 3 * n, axes, middle, p);
        const double x = p[0] - centroid[0], y = p[1] - centroid[1], z = p[2] - centroid[2];
        double f[10] = {1.0, x / volume, y / volume, z / volume, x * x - s2, y * y - s2, z * z - s2, x * y, y * z, x * z};
        for (int k = 0; k < 10; k++) {
            f[k] *= scale;
            a[k] += f[k] * (1.0 - w);
            b[k] += f[k] * w;
            f[k] *= noise[n];
        }
        for (int j = 0; j < 10; j++)
            for (int k = 0; k < 10; k++)
                c[10 * j + k] += f[j] * f[k];
    }
    for (int k = 0; k < 10; k++)
        to_air[k] = (double)step * a[k], to_bone[k] = (double)step * b[k];
    for (int k = 0; k < 100; k++)
        to_noise[k] = (double)step * c[k];
}

/* Means over a voxel and its six neighbours, in bins, for all but the outermost voxels of some layers; and how many
 * voxels agree with their neighbours, by bin: those with a sum of squares about the mean of seven below `limit`. */
API void interior(const float *grey, int64_t layers, int64_t ny, int64_t nx, float limit, float low, float per_width,
                  uint16_t *bins, int64_t *histogram)
{
    const int64_t layer = ny * nx, stride[3] = {layer, nx, 1};
    const float seventh = (float)(1.0 / 7.0);
    for (int64_t z = 1; z <= layers; z++)
        for (int64_t y = 1; y + 1 < ny; y++) {
            const float *at = grey + z * layer + y * nx;
            uint16_t *to = bins + ((z - 1) * (ny - 2) + y - 1) * (nx - 2) - 1;
            for (int64_t start = 1; start + 1 < nx; start += 256) {
                const int64_t end = least(start + 256, nx - 1);
                uint8_t calm[256];
                for (int64_t x = start; x < end; x++) {
                    float total = 0.0f, square = 0.0f;
                    for (int k = 0; k < 3; k++) {
                        const float ahead = at[x + stride[k]] - at[x], back = at[x] - at[x - stride[k]];
                        total = k ? total - back + ahead : ahead - back;
                        square = k ? square + back * back + ahead * ahead : back * back + ahead * ahead;
                    }
                    square -= total * total * seventh;
                    calm[x - start] = square < limit;
                    to[x] = (uint16_t)(int32_t)((total * seventh + at[x] - low) * per_width);
                }
                for (int64_t x = start; x < end; x++)
                    histogram[to[x]] += calm[x - start];
            }
        }
}

/* How many voxels lie in bins from `first` to before `last`; `cubes` how many cubes of three they fill. -1: memory. */
API int64_t cubes_near(const uint16_t *bins, const int64_t *shape, int64_t first, int64_t last, int64_t *cubes)
{
    const int64_t nz = shape[0], ny = shape[1], nx = shape[2], layer = ny * nx;
    uint8_t *memory = malloc((size_t)(4 * layer));
    int64_t count = 0, filled = 0;
    if (!memory)
        return -1;
    uint8_t *mask = memory, *square[3] = {memory + layer, memory + 2 * layer, memory + 3 * layer};
    for (int64_t z = 0; z < nz; z++, bins += layer) {
        uint8_t *own = square[z % 3];
        int64_t here = 0;
        for (int64_t i = 0; i < layer; i++) {
            mask[i] = bins[i] >= first && bins[i] < last;
            here += mask[i];
        }
        count += here;
        for (int64_t i = 0; i < layer; i++)
            own[i] = 0;
        for (int64_t y = 2; here && y < ny; y++) {
            const uint8_t *a = mask + y * nx, *b = a - nx, *c = b - nx;
            for (int64_t x = 2; x < nx; x++)
                own[y * nx + x] = a[x] & a[x - 1] & a[x - 2] & b[x] & b[x - 1] & b[x - 2] & c[x] & c[x - 1] & c[x - 2];
        }
        if (z > 1 && here)
            for (int64_t i = 0; i < layer; i++)
                filled += square[0][i] & square[1][i] & square[2][i];
    }
    free(memory);
    *cubes = filled;
    return count;
}

/* Means over blocks of voxels of a part of a scan, x without gaps, rows and layers `step` apart; the sums are in single
 * precision: along z, then y, then x. `size` counts the blocks along z, y, x. */
#define MEANS(NAME, T)                                                                                              \
    API int64_t NAME(const T *part, const int64_t *step, const int64_t *size, const int64_t *block, float share,     \
                     float *out)                                                                                    \
    {                                                                                                               \
        const int64_t wide = size[2] * block[2];                                                                    \
        float *row = malloc((size_t)(2 * wide) * sizeof *row), *column = row ? row + wide : NULL;                   \
        if (!row)                                                                                                   \
            return -1;                                                                                              \
        for (int64_t z = 0; z < size[0]; z++)                                                                       \
            for (int64_t y = 0; y < size[1]; y++, out += size[2]) {                                                 \
                for (int64_t j = 0; j < block[1]; j++) {                                                            \
                    float *to = j ? column : row;                                                                   \
                    for (int64_t i = 0; i < block[0]; i++) {                                                        \
                        const T *from = part + (z * block[0] + i) * step[0] + (y * block[1] + j) * step[1];         \
                        if (i)                                                                                      \
                            for (int64_t x = 0; x < wide; x++)                                                      \
                                to[x] += (float)from[x];                                                            \
                        else                                                                                        \
                            for (int64_t x = 0; x < wide; x++)                                                      \
                                to[x] = (float)from[x];                                                             \
                    }                                                                                               \
                    if (j)                                                                                          \
                        for (int64_t x = 0; x < wide; x++)                                                          \
                            row[x] += column[x];                                                                    \
                }                                                                                                   \
                for (int64_t x = 0; x < size[2]; x++) {                                                             \
                    float sum = row[x * block[2]] * share;                                                          \
                    for (int64_t i = 1; i < block[2]; i++)                                                          \
                        sum += row[x * block[2] + i] * share;                                                       \
                    out[x] = sum;                                                                                   \
                }                                                                                                   \
            }                                                                                                       \
        free(row);                                                                                                  \
        return 0;                                                                                                   \
    }

MEANS(means_uint8, uint8_t)
MEANS(means_int8, int8_t)
MEANS(means_uint16, uint16_t)
MEANS(means_int16, int16_t)
MEANS(means_uint32, uint32_t)
MEANS(means_int32, int32_t)

/* Look every number up in a table of `count` flags; 0 for those beyond. */
API void looked_up(const int32_t *number, int64_t total, const uint8_t *table, int64_t count, uint8_t *out)
{
    for (int64_t i = 0; i < total; i++)
        out[i] = number[i] && number[i] > 0 && number[i] < count ? table[number[i]] : 0;
}
