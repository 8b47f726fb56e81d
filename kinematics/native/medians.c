/* Running medians along the rows of a table, the first and last row repeated beyond its ends. */
#include "kernels.h"

#define MOST 63

/* Put `value` into `sorted` (count numbers), or take it out. */
INLINE void put(double *sorted, int count, double value)
{
    int k = count;
    for (; k > 0 && sorted[k - 1] > value; k--) sorted[k] = sorted[k - 1];
    sorted[k] = value;
}

INLINE void taken(double *sorted, int count, double value)
{
    int k = 0;
    while (k < count - 1 && sorted[k] != value) k++;
    for (; k < count - 1; k++) sorted[k] = sorted[k + 1];
}

/* `table` and `out` (rows, columns) without gaps; windows of 2 half + 1 rows, at most MOST; no NaN */
EXPORT void medians(const double *table, int64_t rows, int64_t columns, int64_t half, double *out)
{
    if (rows < 1 || half < 0 || 2 * half + 1 > MOST) return;
    const int width = (int)(2 * half + 1);
    for (int64_t c = 0; c < columns; c++) {
        double sorted[MOST + 1];
#define PLACE(r) table[((r) < 0 ? 0 : (r) >= rows ? rows - 1 : (r)) * columns + c]
        for (int k = 0; k < width; k++) put(sorted, k, PLACE(k - half));
        for (int64_t r = 0; r < rows; r++) {
            out[r * columns + c] = sorted[half];
            if (r + 1 == rows) break;
            taken(sorted, width, PLACE(r - half));
            put(sorted, width - 1, PLACE(r + 1 + half));
        }
#undef PLACE
    }
}
