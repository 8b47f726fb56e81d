/* Mixtures of the lines of every channel: value (count, lines) times vectors (lines, n), complex.
 *
 * A reading times the real part of a vector's entry, and times its imaginary part, are summed with real and
 * imaginary parts side by side, and put together at the end. Lines are taken CHUNK at a time, of which the
 * vectors stay in the first cache.
 */
#include "kernels.h"

#define CHUNK 64
#define PAIR 2

/* `twice` (2 SIZE, 2 CHUNK): real parts of the vectors, each twice, then imaginary parts */
INLINE void spread(double *twice, const double *vectors, int64_t n, int64_t lines)
{
    memset(twice, 0, sizeof(double) * 4 * SIZE * CHUNK);
    for (int64_t j = 0; j < n; j++)
        for (int64_t l = 0; l < lines; l++) {
            double *re = twice + 2 * j * 2 * CHUNK + 2 * l, *im = re + 2 * CHUNK;
            re[0] = re[1] = vectors[2 * (l * n + j)];
            im[0] = im[1] = vectors[2 * (l * n + j) + 1];
        }
}

INLINE void summed(double *sums, const double *one, const double *two, const double *twice, int64_t count)
{
    vec a[2 * SIZE], b[2 * SIZE];
    for (int j = 0; j < 2 * SIZE; j++) a[j] = AT(sums + j * WIDE), b[j] = AT(sums + (2 * SIZE + j) * WIDE);
    for (int64_t k = 0; k < count; k += WIDE) {
        vec y = FROM(one + k), x = FROM(two + k);
        for (int j = 0; j < 2 * SIZE; j++) {
            vec v = FROM(twice + j * 2 * CHUNK + k);
            a[j] += v * y;
            b[j] += v * x;
        }
    }
    for (int j = 0; j < 2 * SIZE; j++) AT(sums + j * WIDE) = a[j], AT(sums + (2 * SIZE + j) * WIDE) = b[j];
}

/* `out` (count, n) complex; `vectors` (lines, n) complex, n at most SIZE; `sums`: 2 SIZE WIDE doubles for an even
 * number of rows, at least count */
EXPORT CLONES void mix_lines(const double *value, int64_t stride, int64_t count, int64_t lines,
                             const double *vectors, int64_t n, double *sums, double *out)
{
    double twice[4 * SIZE * CHUNK], tail[PAIR][2 * CHUNK];
    memset(sums, 0, sizeof(double) * 2 * SIZE * WIDE * (size_t)(count + (count & 1)));
    for (int64_t at = 0; at < lines; at += CHUNK) {
        const int64_t here = lines - at < CHUNK ? lines - at : CHUNK;
        spread(twice, vectors + 2 * n * at, n, here);
        for (int64_t c = 0; c < count; c += PAIR) {
            const double *one = value + c * stride + 2 * at, *two = c + 1 < count ? one + stride : one;
            if (c + PAIR < count)
                for (int64_t k = 0; k < 2 * here; k += WIDE) {
                    __builtin_prefetch(two + stride + k);
                    if (c + PAIR + 1 < count) __builtin_prefetch(two + 2 * stride + k);
                }
            if (here % (WIDE / 2)) {
                memset(tail, 0, sizeof(tail));
                memcpy(tail[0], one, sizeof(double) * 2 * (size_t)here);
                memcpy(tail[1], two, sizeof(double) * 2 * (size_t)here);
                one = tail[0], two = tail[1];
            }
            summed(sums + 2 * SIZE * WIDE * c, one, two, twice, (2 * here + WIDE - 1) / WIDE * WIDE);
        }
    }
    for (int64_t c = 0; c < count; c++)
        for (int64_t j = 0; j < n; j++) {
            const double *re = sums + (2 * SIZE * c + 2 * j) * WIDE, *im = re + WIDE;
            double total[2] = {0.0, 0.0};
            for (int l = 0; l < WIDE; l += 2) {
                total[0] += re[l] - im[l + 1];
                total[1] += im[l] + re[l + 1];
            }
            out[2 * (c * n + j)] = total[0];
            out[2 * (c * n + j) + 1] = total[1];
        }
}
