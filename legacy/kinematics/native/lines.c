/* Least squares at lines that have weights of their own (kinematics/fit/line_gram.py), in one pass over the data.
 *
 * Per line: Gram matrix of the weighted basis, its inverse by Cholesky, coefficients, refined once where the
 * condition asks for it, and the sums of residuals. BLOCK lines of all channels are copied to where they stay in
 * the processor's cache, real and imaginary parts apart, and solved WIDE at a time. Fewer columns than SIZE are
 * filled up with zeros, and ones on the diagonal of the Gram matrix. A line whose condition is above `doubtful`
 * is marked, and enters no sum.
 */
#include "kernels.h"
#include <math.h>

#define BLOCK 32
#define PACKED(i, j) ((i) * ((i) + 1) / 2 + (j))
#define TINY 1e-300

typedef struct {
    int64_t channels, size; /* size: columns of the basis, at most SIZE */
    const double *basis;    /* (channel, SIZE) */
    const double *products; /* (channel, HALF): b_i b_j */
} rows;

typedef struct {
    const double *stated;
    int64_t across, along; /* doubles from channel to channel, and from line to line */
    const double *factor, *least; /* by line, or NULL */
} noise;

/* re, im, root (channel, 3, BLOCK): readings, zero where not used, and 1 / sd there, else zero */
INLINE void gathered(double *room, const double *value, int64_t stride, const noise *n, int64_t channels, int64_t at,
                     int64_t lines, int64_t ahead)
{
    for (int64_t c = 0; c < channels; c++) {
        const double *row = value + c * stride + 2 * at, *sd = n->stated + c * n->across + at * n->along;
        double *re = room + 3 * BLOCK * c, *im = re + BLOCK, *root = im + BLOCK;
        if (ahead) {
            for (int k = 0; k < 2 * BLOCK; k += WIDE) __builtin_prefetch(row + 2 * BLOCK + k);
            if (n->along == 1)
                for (int k = 0; k < BLOCK; k += WIDE) __builtin_prefetch(sd + BLOCK + k);
        }
        if (n->along == 1)
            for (int64_t l = 0; l < lines; l++) root[l] = sd[l];
        else
            for (int64_t l = 0; l < lines; l++) root[l] = sd[l * n->along];
        if (n->factor)
            for (int64_t l = 0; l < lines; l++) root[l] *= n->factor[at + l];
        if (n->least)
            for (int64_t l = 0; l < lines; l++) root[l] = root[l] < n->least[at + l] ? n->least[at + l] : root[l];
        for (int64_t l = lines; l < BLOCK; l++) root[l] = INFINITY;
        for (int64_t l = 0; l < BLOCK; l++) root[l] = 1.0 / root[l];
        for (int64_t l = 0; l < lines; l++) re[l] = row[2 * l], im[l] = row[2 * l + 1];
        for (int64_t l = lines; l < BLOCK; l++) re[l] = im[l] = 0.0;
        vec wrong = {0};
        bits some = ~(bits){0};
        for (int k = 0; k < BLOCK; k += WIDE) {
            const vec x = FROM(re + k), y = FROM(im + k), w = FROM(root + k);
            wrong += (x - x) + (y - y) + (w - w);
            const bits t = (bits)w << 1;
            some &= (t | -t) & ~(bits)w; /* the top bit: w is positive */
        }
        int use = 1;
        LANES use &= wrong[l] == 0.0 && some[l] >> 63;
        if (!use)
            for (int64_t l = 0; l < BLOCK; l++) {
                const double odd = (re[l] - re[l]) + (im[l] - im[l]) + (root[l] - root[l]);
                if (!(odd == 0.0 && root[l] > 0.0)) re[l] = im[l] = root[l] = 0.0;
            }
    }
}

INLINE void root_of(vec *x)
{
    double v[WIDE];
    LANES v[l] = sqrt((*x)[l] > TINY ? (*x)[l] : TINY);
    *x = FROM(v);
}

/* packed inverses by A = L L^T, A^-1 = L^-T L^-1 */
INLINE void inverted(vec *found, const vec *gram)
{
    vec low[HALF];
    for (int p = 0; p < HALF; p++) low[p] = gram[p];
    for (int j = 0; j < SIZE; j++) {
        vec pivot = low[PACKED(j, j)];
        for (int k = 0; k < j; k++) pivot -= low[PACKED(j, k)] * low[PACKED(j, k)];
        root_of(&pivot);
        low[PACKED(j, j)] = pivot;
        for (int i = j + 1; i < SIZE; i++) {
            vec entry = low[PACKED(i, j)];
            for (int k = 0; k < j; k++) entry -= low[PACKED(i, k)] * low[PACKED(j, k)];
            low[PACKED(i, j)] = entry / pivot;
        }
    }
    for (int j = 0; j < SIZE; j++) {
        low[PACKED(j, j)] = 1.0 / low[PACKED(j, j)];
        for (int i = j + 1; i < SIZE; i++) {
            vec total = low[PACKED(i, j)] * low[PACKED(j, j)];
            for (int k = j + 1; k < i; k++) total += low[PACKED(i, k)] * low[PACKED(k, j)];
            low[PACKED(i, j)] = -total / low[PACKED(i, i)];
        }
    }
    for (int i = 0; i < SIZE; i++)
        for (int j = 0; j <= i; j++) {
            vec total = low[PACKED(i, i)] * low[PACKED(i, j)];
            for (int k = i + 1; k < SIZE; k++) total += low[PACKED(k, i)] * low[PACKED(k, j)];
            found[PACKED(i, j)] = total;
        }
}

INLINE void add_times(vec *to, const vec *packed, const vec *x)
{
    for (int i = 0; i < SIZE; i++)
        for (int j = 0; j <= i; j++) {
            to[i] += packed[PACKED(i, j)] * x[j];
            if (i != j) to[j] += packed[PACKED(i, j)] * x[i];
        }
}

INLINE void weigh(vec *w, const double *root, const vec *over)
{
    *w = FROM(root) * *over;
    *w *= *w;
}

INLINE void gram_of(vec *gram, const double *room, const rows *r, const vec *over)
{
    for (int p = 0; p < HALF; p++) gram[p] = (vec){0};
    for (int64_t c = 0; c < r->channels; c++) {
        vec w;
        weigh(&w, room + 3 * BLOCK * c + 2 * BLOCK, over);
        const double *k = r->products + c * HALF;
        for (int p = 0; p < HALF; p++) gram[p] += k[p] * w;
    }
    for (int64_t j = r->size; j < SIZE; j++) gram[PACKED(j, j)] = (vec){1, 1, 1, 1, 1, 1, 1, 1};
}

/* right sides of the readings, or of what coefficients leave of them */
INLINE void right_of(vec *re, vec *im, const double *room, const rows *r, const vec *over, const vec *zre,
                     const vec *zim)
{
    for (int j = 0; j < SIZE; j++) re[j] = im[j] = (vec){0};
    for (int64_t c = 0; c < r->channels; c++) {
        const double *at = room + 3 * BLOCK * c, *b = r->basis + c * SIZE;
        vec x = FROM(at), y = FROM(at + BLOCK), w;
        weigh(&w, at + 2 * BLOCK, over);
        if (zre)
            for (int j = 0; j < SIZE; j++) x -= b[j] * zre[j], y -= b[j] * zim[j];
        x *= w, y *= w;
        for (int j = 0; j < SIZE; j++) re[j] += b[j] * x, im[j] += b[j] * y;
    }
}

/* Sums by channel (channel, 5, WIDE): |r|^2, |r / sd|^2, leverage, relative weight, lines used; by line: |r|^2
 * times the relative weight, and channels used. `live`: 1 where a line counts; `twice`: the packed inverses, twice
 * off the diagonal. */
INLINE void summed(double *sums, vec *misfit, vec *number, const double *room, const rows *r, const vec *over,
                   const vec *top, const vec *live, const vec *zre, const vec *zim, const vec *twice)
{
    *misfit = *number = (vec){0};
    for (int64_t c = 0; c < r->channels; c++) {
        const double *at = room + 3 * BLOCK * c, *b = r->basis + c * SIZE, *k = r->products + c * HALF;
        double *own = sums + 5 * WIDE * c;
        vec x = FROM(at), y = FROM(at + BLOCK), used, w;
        weigh(&w, at + 2 * BLOCK, over);
        double mark[WIDE];
        LANES mark[l] = at[2 * BLOCK + l] > 0.0 ? 1.0 : 0.0;
        used = FROM(mark);
        for (int j = 0; j < SIZE; j++) x -= b[j] * zre[j], y -= b[j] * zim[j];
        vec square = used * (x * x + y * y), lever = {0}, other = {0};
#pragma GCC unroll 21
        for (int p = 0; p < HALF; p++)
            if (p % 2) other += k[p] * twice[p];
            else lever += k[p] * twice[p];
        lever += other;
        *number += used;
        *misfit += w * square;
        square *= *live;
        const vec count = w * *live;
        AT(own) += square;
        AT(own + WIDE) += w * square * *top * *top;
        AT(own + 2 * WIDE) += count * lever;
        AT(own + 3 * WIDE) += count;
        AT(own + 4 * WIDE) += used * *live;
    }
}

typedef struct {
    double *z;       /* (size, lines) complex */
    double *inverse; /* packed (size (size + 1) / 2, lines), with weights 1 / (2 sd^2) */
    double *misfit, *explained;
    int64_t *count;
    uint8_t *good;
    int64_t wide; /* lines of the whole: from row to row */
} made;

INLINE void solved(double *room, const rows *r, const double limits[3], double *sums, const made *out, int64_t at,
                   int64_t lines)
{
    vec top = {0}, over, gram[HALF], inverse[HALF], re[SIZE], im[SIZE], zre[SIZE] = {{0}}, zim[SIZE] = {{0}};
    double best[WIDE] = {0}, good[WIDE];
    for (int64_t c = 0; c < r->channels; c++)
        LANES best[l] = room[3 * BLOCK * c + 2 * BLOCK + l] > best[l] ? room[3 * BLOCK * c + 2 * BLOCK + l] : best[l];
    LANES best[l] = best[l] > 0.0 ? best[l] : 1.0;
    top = FROM(best), over = 1.0 / top;
    gram_of(gram, room, r, &over);
    inverted(inverse, gram);
    vec one = {0}, two = {0};
    for (int64_t i = 0; i < r->size; i++)
        for (int64_t j = 0; j <= i; j++) {
            const double times = i == j ? 1.0 : 2.0;
            one += times * gram[PACKED(i, j)] * gram[PACKED(i, j)];
            two += times * inverse[PACKED(i, j)] * inverse[PACKED(i, j)];
        }
    int refine = 0;
    LANES {
        const double condition = sqrt(one[l]) * sqrt(two[l]);
        good[l] = condition < limits[1] ? 1.0 : 0.0;
        refine |= condition > limits[0] && condition < limits[1];
        if (!(condition < limits[1]))
            for (int p = 0; p < HALF; p++) inverse[p][l] = 0.0;
    }
    right_of(re, im, room, r, &over, NULL, NULL);
    add_times(zre, inverse, re);
    add_times(zim, inverse, im);
    if (refine) {
        right_of(re, im, room, r, &over, zre, zim);
        add_times(zre, inverse, re);
        add_times(zim, inverse, im);
    }
    for (int64_t l = lines; l < WIDE; l++) good[l] = 0.0;
    const vec live = FROM(good);
    vec misfit, number, energy = {0}, gre[SIZE] = {{0}}, gim[SIZE] = {{0}}, twice[HALF];
    for (int i = 0; i < SIZE; i++)
        for (int j = 0; j <= i; j++) twice[PACKED(i, j)] = inverse[PACKED(i, j)] * (i == j ? 1.0 : 2.0);
    summed(sums, &misfit, &number, room, r, &over, &top, &live, zre, zim, twice);
    add_times(gre, gram, zre);
    add_times(gim, gram, zim);
    for (int j = 0; j < SIZE; j++) energy += gre[j] * zre[j] + gim[j] * zim[j];
    for (int64_t l = 0; l < lines; l++) {
        const double square = best[l] * best[l];
        for (int64_t j = 0; j < r->size; j++) {
            out->z[2 * (j * out->wide + at + l)] = zre[j][l];
            out->z[2 * (j * out->wide + at + l) + 1] = zim[j][l];
        }
        for (int64_t p = 0; p < r->size * (r->size + 1) / 2; p++)
            out->inverse[p * out->wide + at + l] = inverse[p][l] * (2.0 / square);
        out->misfit[at + l] = misfit[l] * square;
        out->explained[at + l] = energy[l] * square;
        out->count[at + l] = (int64_t)number[l];
        out->good[at + l] = good[l] > 0.0;
    }
}

/* Lines `start` to `stop`; outputs are those of the whole. `room`: 3 BLOCK doubles per channel; `sums`: 5 WIDE per
 * channel. `refine` and `doubtful`: conditions above which a line is refined, and marked. */
EXPORT CLONES void fit_lines(const double *value, int64_t stride, int64_t channels, int64_t start, int64_t stop,
                             const double *stated, int64_t across, int64_t along, const double *factor,
                             const double *least, int64_t size, const double *basis, const double *products,
                             double refine, double doubtful, double *room, double *sums, double *z, double *inverse,
                             double *misfit, double *explained, int64_t *count, uint8_t *good, int64_t wide)
{
    const rows r = {channels, size, basis, products};
    const noise n = {stated, across, along, factor, least};
    const made out = {z, inverse, misfit, explained, count, good, wide};
    const double limits[3] = {refine, doubtful, 0.0};
    for (int64_t at = start; at < stop; at += BLOCK) {
        const int64_t lines = stop - at < BLOCK ? stop - at : BLOCK;
        gathered(room, value, stride, &n, channels, at, lines, at + 2 * BLOCK <= stop);
        for (int64_t k = 0; k < lines; k += WIDE)
            solved(room + k, &r, limits, sums, &out, at + k, lines - k < WIDE ? lines - k : WIDE);
    }
}
