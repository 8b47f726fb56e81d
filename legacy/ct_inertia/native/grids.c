/* Masks and grey values on a grid: connected pieces, growing and shrinking, Gaussians, interpolation. */
#include "stapes.h"

static int32_t root_of(int32_t *parent, int32_t k)
{
    while (parent[k] != k) {
        parent[k] = parent[parent[k]];
        k = parent[k];
    }
    return k;
}

static int32_t joined(int32_t *parent, int32_t a, int32_t b)
{
    a = root_of(parent, a);
    b = root_of(parent, b);
    if (a < b) {
        parent[b] = a;
        return a;
    }
    parent[a] = b;
    return b;
}

/* Number the connected pieces of a mask in the order of their first voxels; 0 elsewhere. Voxels hang together
 * by faces, with `corners` by edges and corners too. Two passes with union-find (Rosenfeld and Pfaltz 1966,
 * doi:10.1145/321356.321357). Returns how many pieces there are. */
API int64_t label_pieces(const uint8_t *mask, const int64_t *shape, int64_t corners, int32_t *labels)
{
    const int64_t nz = shape[0], ny = shape[1], nx = shape[2], layer = ny * nx, total = nz * layer;
    int64_t room = 1 << 16, used = 1, step[13];
    int move[13][3], count = 0;
    int32_t *parent = malloc((size_t)room * sizeof *parent);
    if (!parent)
        return -1;
    parent[0] = 0;
    for (int dz = -1; dz <= 0; dz++)
        for (int dy = -1; dy <= 1; dy++)
            for (int dx = -1; dx <= 1; dx++) {
                const int before = dz < 0 || (dz == 0 && (dy < 0 || (dy == 0 && dx < 0)));
                if (!before || (!corners && abs(dz) + abs(dy) + abs(dx) > 1))
                    continue;
                move[count][0] = dz;
                move[count][1] = dy;
                move[count][2] = dx;
                step[count++] = dz * layer + dy * nx + dx;
            }
    for (int64_t z = 0; z < nz; z++)
        for (int64_t y = 0; y < ny; y++) {
            const int64_t row = z * layer + y * nx;
            if (!memchr(mask + row, 1, (size_t)nx)) {
                memset(labels + row, 0, (size_t)nx * sizeof *labels);
                continue;
            }
            for (int64_t x = 0; x < nx; x++) {
                int32_t own = 0;
                if (!mask[row + x]) {
                    labels[row + x] = 0;
                    continue;
                }
                for (int k = 0; k < count; k++) {
                    const int64_t y2 = y + move[k][1], x2 = x + move[k][2];
                    if (z + move[k][0] < 0 || y2 < 0 || y2 >= ny || x2 < 0 || x2 >= nx)
                        continue;
                    const int32_t other = labels[row + x + step[k]];
                    if (other && other != own)
                        own = own ? joined(parent, own, other) : other;
                }
                if (!own) {
                    if (used == room) {
                        int32_t *more = used < INT32_MAX / 2 ? realloc(parent, (size_t)(2 * room) * sizeof *parent) : NULL;
                        if (!more) {
                            free(parent);
                            return -1;
                        }
                        parent = more;
                        room *= 2;
                    }
                    own = (int32_t)used;
                    parent[used++] = own;
                }
                labels[row + x] = own;
            }
        }
    int32_t pieces = 0;
    for (int32_t k = 1; k < used; k++) /* roots come before what hangs on them */
        parent[k] = parent[k] == k ? -(++pieces) : parent[k];
    for (int32_t k = 1; k < used; k++)
        if (parent[k] > 0)
            parent[k] = parent[parent[k]];
    for (int64_t i = 0; i < total; i++)
        if (labels[i])
            labels[i] = -parent[labels[i]];
    free(parent);
    return pieces;
}

/* The box of every piece (z0, z1, y0, y1, x0, x1; one past the last) and how many voxels it has, by number. */
API void measure_pieces(const int32_t *labels, const int64_t *shape, int64_t count, int64_t *box, int64_t *size)
{
    for (int64_t k = 0; k <= count; k++) {
        size[k] = 0;
        for (int a = 0; a < 3; a++) {
            box[6 * k + 2 * a] = shape[a];
            box[6 * k + 2 * a + 1] = 0;
        }
    }
    for (int64_t z = 0; z < shape[0]; z++)
        for (int64_t y = 0; y < shape[1]; y++, labels += shape[2])
            for (int64_t x = 0; x < shape[2];) {
                const int32_t own = labels[x];
                const int64_t first = x;
                while (x < shape[2] && labels[x] == own)
                    x++;
                if (own < 0 || own > count)
                    continue;
                int64_t *b = box + 6 * own;
                size[own] += x - first;
                b[0] = least(b[0], z), b[1] = most(b[1], z + 1);
                b[2] = least(b[2], y), b[3] = most(b[3], y + 1);
                b[4] = least(b[4], first), b[5] = most(b[5], x);
            }
}

/* The box of a mask, as above; 0 when it is empty. */
API int64_t used_box(const uint8_t *mask, const int64_t *shape, int64_t *box)
{
    const int64_t nx = shape[2];
    int64_t b[6] = {shape[0], 0, shape[1], 0, nx, 0};
    for (int64_t z = 0; z < shape[0]; z++)
        for (int64_t y = 0; y < shape[1]; y++, mask += nx) {
            const uint8_t *found = memchr(mask, 1, (size_t)nx);
            if (!found)
                continue;
            int64_t last = nx;
            while (!mask[last - 1])
                last--;
            b[0] = least(b[0], z), b[1] = z + 1;
            b[2] = least(b[2], y), b[3] = most(b[3], y + 1);
            b[4] = least(b[4], found - mask), b[5] = most(b[5], last);
        }
    memcpy(box, b, sizeof b);
    return b[1] > 0;
}

static void one_round(const uint8_t *in, const int64_t *shape, uint8_t outside, uint8_t *out)
{
    const int64_t nz = shape[0], ny = shape[1], nx = shape[2], layer = ny * nx;
    for (int64_t z = 0; z < nz; z++)
        for (int64_t y = 0; y < ny; y++) {
            const uint8_t *row = in + z * layer + y * nx;
            uint8_t *to = out + z * layer + y * nx;
            memcpy(to, row, (size_t)nx);
            const uint8_t *beside[4] = {z > 0 ? row - layer : NULL, z + 1 < nz ? row + layer : NULL,
                                        y > 0 ? row - nx : NULL, y + 1 < ny ? row + nx : NULL};
            for (int k = 0; k < 4; k++)
                if (beside[k])
                    for (int64_t x = 0; x < nx; x++)
                        to[x] |= beside[k][x];
                else if (outside)
                    memset(to, 1, (size_t)nx);
            for (int64_t x = 1; x < nx; x++)
                to[x] |= row[x - 1];
            for (int64_t x = 1; x < nx; x++)
                to[x - 1] |= row[x];
            to[0] |= outside;
            to[nx - 1] |= outside;
        }
}

/* Grow a mask across faces by some voxels, only `within` another mask when there is one; or shrink it, where
 * what lies outside the grid counts as empty. */
API int64_t grown(const uint8_t *mask, const uint8_t *within, const int64_t *shape, int64_t rounds, int64_t shrink,
                  uint8_t *out)
{
    const int64_t total = shape[0] * shape[1] * shape[2];
    uint8_t *from = malloc((size_t)total);
    if (!from)
        return -1;
    for (int64_t i = 0; i < total; i++)
        out[i] = shrink ? !mask[i] : mask[i] != 0;
    for (int64_t k = 0; k < rounds; k++) {
        memcpy(from, out, (size_t)total);
        one_round(from, shape, shrink != 0, out);
        if (within)
            for (int64_t i = 0; i < total; i++)
                out[i] = within[i] ? out[i] : mask[i] != 0;
    }
    if (shrink)
        for (int64_t i = 0; i < total; i++)
            out[i] = !out[i];
    free(from);
    return 0;
}

/* Voxels with more than half of the 27 around them in the mask; the outermost voxels come out empty. */
API void majority(const uint8_t *mask, const int64_t *shape, uint8_t *out)
{
    const int64_t nz = shape[0], ny = shape[1], nx = shape[2], layer = ny * nx;
    memset(out, 0, (size_t)(nz * layer));
    for (int64_t z = 1; z + 1 < nz; z++)
        for (int64_t y = 1; y + 1 < ny; y++)
            for (int64_t x = 1; x + 1 < nx; x++) {
                const uint8_t *at = mask + z * layer + y * nx + x;
                int sum = 0;
                for (int64_t dz = -layer; dz <= layer; dz += layer)
                    for (int64_t dy = -nx; dy <= nx; dy += nx)
                        sum += at[dz + dy - 1] + at[dz + dy] + at[dz + dy + 1];
                out[z * layer + y * nx + x] = sum > 13;
            }
}

INLINED int64_t mirrored(int64_t k, int64_t n)
{
    k %= 2 * n;
    if (k < 0)
        k += 2 * n;
    return k < n ? k : 2 * n - 1 - k;
}

/* So many neighbouring sums stay in registers, and are left out together where nothing but zeros adds to them. */
#define BLOCK 16

/* Where a block of a line of `length` numbers begins; the last one ends with the line and may overlap the one before. */
INLINED int64_t block_start(int64_t block, int64_t length)
{
    const int64_t last = length - BLOCK;
    return last > 0 ? least(block * BLOCK, last) : 0;
}

INLINED uint8_t not_zero(const float *block, int64_t count)
{
    uint64_t bits[BLOCK / 2], found = 0;
    if (count < BLOCK) {
        for (int64_t k = 0; k < count; k++)
            if (block[k] != 0.0f)
                return 1;
        return 0;
    }
    for (int k = 0; k < BLOCK / 2; k++)
        memcpy(bits + k, block + 2 * k, sizeof *bits);
    for (int k = 0; k < BLOCK / 2; k++)
        found |= bits[k];
    return found != 0;
}

/* Sums of a block, or of `count` places of it: weights[0] times the middle row and, from the outermost pair inward,
 * weights[j] times the two rows at the distance j; rows[radius] is the middle one. With `used`, rows that hold zeros
 * there are not added. */
INLINED void weighted_sums(const float *const *rows, const uint8_t *const *used, int64_t block, int64_t radius,
                           const double *weights, int64_t at, int64_t count, float *to)
{
    double sum[BLOCK];
    if (count < BLOCK) {
        for (int64_t k = at; k < at + count; k++) {
            double total = (double)rows[radius][k] * weights[0];
            for (int64_t j = radius; j > 0; j--)
                total += ((double)rows[radius - j][k] + (double)rows[radius + j][k]) * weights[j];
            to[k] = (float)total;
        }
        return;
    }
    for (int k = 0; k < BLOCK; k++)
        sum[k] = (double)rows[radius][at + k] * weights[0];
    for (int64_t j = radius; j > 0; j--) {
        const float *a = rows[radius - j] + at, *b = rows[radius + j] + at;
        if (used && !(used[radius - j][block] | used[radius + j][block]))
            continue;
        for (int k = 0; k < BLOCK; k++)
            sum[k] += ((double)a[k] + (double)b[k]) * weights[j];
    }
    for (int k = 0; k < BLOCK; k++)
        to[at + k] = (float)sum[k];
}

/* Convolve rows of n numbers along x, in blocks of `count`; `line` holds one with what is mirrored beyond it, `any` a
 * flag for each block. */
INLINED void smooth_rows(const float *in, int64_t many, int64_t n, int64_t count, int64_t radius, const double *weights,
                         const int64_t *source, const float **rows, float *line, uint8_t *any, float *out)
{
    const int64_t blocks = (n + BLOCK - 1) / BLOCK;
    for (int64_t j = 0; j <= 2 * radius; j++)
        rows[j] = line + j;
    for (int64_t o = 0; o < many; o++, in += n, out += n) {
        int64_t full = 0;
        for (int64_t b = 0; b < blocks; b++)
            full += any[b] = not_zero(in + block_start(b, n), count);
        if (!full) {
            memset(out, 0, (size_t)n * sizeof *out);
            continue;
        }
        memcpy(line + radius, in, (size_t)n * sizeof *line);
        for (int64_t k = 0; k < radius; k++) {
            line[k] = in[source[k]];
            line[radius + n + k] = in[source[radius + n + k]];
        }
        for (int64_t b = 0; b < blocks; b++) { /* what is mirrored lies within the radius of the border, too */
            const int64_t at = block_start(b, n), first = most(at - radius, 0) / BLOCK;
            const int64_t last = least((at + count - 1 + radius) / BLOCK, blocks - 1);
            if (full == blocks || memchr(any + first, 1, (size_t)(last - first + 1)))
                weighted_sums(rows, NULL, b, radius, weights, at, count, out);
            else
                memset(out + at, 0, (size_t)count * sizeof *out);
        }
    }
}

/* Convolve n rows of `inner` numbers with their neighbours, in blocks of `count`; `any` holds a flag for each block,
 * `near` a count. */
INLINED void smooth_columns(const float *in, int64_t n, int64_t inner, int64_t count, int64_t radius, const double *weights,
                            const int64_t *source, const float **rows, const uint8_t **used, uint8_t *any,
                            int64_t *near, float *out)
{
    const int64_t blocks = (inner + BLOCK - 1) / BLOCK;
    for (int64_t k = 0; k < n; k++)
        for (int64_t b = 0; b < blocks; b++)
            any[k * blocks + b] = not_zero(in + k * inner + block_start(b, inner), count);
    memset(near, 0, (size_t)blocks * sizeof *near);
    for (int64_t k = 0; k < least(radius, n); k++)
        for (int64_t b = 0; b < blocks; b++)
            near[b] += any[k * blocks + b];
    for (int64_t start = 0; start < blocks; start += 32) /* rows that stay in the cache */
        for (int64_t k = 0; k < n; k++) {
            const uint8_t *comes = k + radius < n ? any + (k + radius) * blocks : NULL;
            const uint8_t *goes = k > radius ? any + (k - radius - 1) * blocks : NULL;
            for (int64_t j = 0; j <= 2 * radius; j++) {
                rows[j] = in + source[k + j] * inner;
                used[j] = any + source[k + j] * blocks;
            }
            for (int64_t b = start; b < least(start + 32, blocks); b++) {
                const int64_t at = block_start(b, inner);
                near[b] += (comes ? comes[b] : 0) - (goes ? goes[b] : 0);
                if (near[b])
                    weighted_sums(rows, used, b, radius, weights, at, count, out + k * inner);
                else
                    memset(out + k * inner + at, 0, (size_t)count * sizeof *out);
            }
        }
}

/* Convolve with a symmetric kernel, weights[0] in the middle, along one axis; d c b a | a b c d | d c b a beyond
 * the border. The sums are in double precision, from the outermost pair inward. Of bodies in air most grey values
 * are zeros, which add nothing. */
API CLONES int64_t smooth_axis(const float *in, const int64_t *shape, int64_t axis, int64_t radius, const double *weights,
                        float *out)
{
    const int64_t n = shape[axis], many = 2 * radius + 1;
    int64_t outer = 1, inner = 1;
    for (int64_t a = 0; a < axis; a++)
        outer *= shape[a];
    for (int64_t a = axis + 1; a < 3; a++)
        inner *= shape[a];
    const int64_t blocks = (inner + BLOCK - 1) / BLOCK;
    const float **rows = malloc((size_t)many * sizeof *rows);
    const uint8_t **used = malloc((size_t)many * sizeof *used);
    float *line = malloc((size_t)(n + 2 * radius) * sizeof *line);
    uint8_t *any = malloc((size_t)(n * blocks));
    int64_t *source = malloc((size_t)(n + 2 * radius) * sizeof *source), *near = malloc((size_t)blocks * sizeof *near);
    const int room = rows && used && line && any && source && near;
    for (int64_t k = 0; room && k < n + 2 * radius; k++)
        source[k] = mirrored(k - radius, n);
    /* apart where blocks are whole: their size is then known to the compiler */
    if (room && inner == 1 && n < BLOCK)
        smooth_rows(in, outer, n, n, radius, weights, source, rows, line, any, out);
    else if (room && inner == 1)
        smooth_rows(in, outer, n, BLOCK, radius, weights, source, rows, line, any, out);
    for (int64_t o = 0; room && inner > 1 && o < outer; o++) {
        const float *from = in + o * n * inner;
        float *to = out + o * n * inner;
        if (inner < BLOCK)
            smooth_columns(from, n, inner, inner, radius, weights, source, rows, used, any, near, to);
        else
            smooth_columns(from, n, inner, BLOCK, radius, weights, source, rows, used, any, near, to);
    }
    free(rows);
    free(used);
    free(line);
    free(any);
    free(source);
    free(near);
    return room ? 0 : -1;
}

/* Grey values at places (n, 3; z, y, x) by linear interpolation, those of the border beyond it. */
API void interpolated(const float *grey, const int64_t *shape, const double *places, int64_t count, double *out)
{
    for (int64_t k = 0; k < count; k++) {
        int64_t low[3], high[3];
        double share[3];
        for (int a = 0; a < 3; a++) {
            double p = places[3 * k + a];
            if (!(p > 0.0))
                p = 0.0;
            if (p > (double)(shape[a] - 1))
                p = (double)(shape[a] - 1);
            low[a] = (int64_t)p;
            high[a] = least(low[a] + 1, shape[a] - 1);
            share[a] = p - (double)low[a];
        }
        double total = 0.0;
        for (int c = 0; c < 8; c++) {
            const int64_t z = c & 4 ? high[0] : low[0], y = c & 2 ? high[1] : low[1], x = c & 1 ? high[2] : low[2];
            const double w = (c & 4 ? share[0] : 1.0 - share[0]) * (c & 2 ? share[1] : 1.0 - share[1]) *
                             (c & 1 ? share[2] : 1.0 - share[2]);
            total += w * grey[(z * shape[1] + y) * shape[2] + x];
        }
        out[k] = total;
    }
}
