/* One look at all values: are they finite, and is none of them zero? */
#include "kernels.h"
#include <math.h>

#define RUN 256

/* whether one of RUN numbers is not finite, or zero when that is asked for: x - x is zero but for such that are
 * not finite, and t | -t, of the bits but for the sign, has its top bit set but for zero */
INLINE int odd_run(const double *at, int zero)
{
    vec wrong = {0};
    bits some = ~(bits){0};
    for (int k = 0; k < RUN; k += WIDE) {
        const vec x = FROM(at + k);
        wrong += x - x;
        const bits t = (bits)x << 1;
        if (zero) some &= t | -t;
    }
    double sum = 0.0;
    uint64_t low = some[0];
    LANES sum += wrong[l];
    LANES low &= some[l];
    return !(sum == 0.0) || !(low >> 63);
}

INLINE int bad_pairs(const double *at, int64_t count)
{
    for (int64_t k = 0; k < count; k += 2) {
        if (!isfinite(at[k]) || !isfinite(at[k + 1])) return 1;
        if (at[k] == 0.0 && at[k + 1] == 0.0) return 1;
    }
    return 0;
}

/* 1 when all `lines` complex values of every row are finite and other than zero; rows are `stride` doubles apart */
EXPORT CLONES int64_t whole(const double *value, int64_t rows, int64_t stride, int64_t lines)
{
    for (int64_t c = 0; c < rows; c++) {
        const double *row = value + c * stride;
        int64_t count = 2 * lines, k = 0;
        for (; k + RUN <= count; k += RUN)
            if (odd_run(row + k, 1) && bad_pairs(row + k, RUN)) return 0;
        if (bad_pairs(row + k, count - k)) return 0;
    }
    return 1;
}

/* 1 when all `count` numbers of every row are finite */
EXPORT CLONES int64_t finite(const double *value, int64_t rows, int64_t stride, int64_t count)
{
    for (int64_t c = 0; c < rows; c++) {
        const double *row = value + c * stride;
        int64_t k = 0;
        for (; k + RUN <= count; k += RUN)
            if (odd_run(row + k, 0)) return 0;
        for (; k < count; k++)
            if (!isfinite(row[k])) return 0;
    }
    return 1;
}
