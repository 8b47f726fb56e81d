/* Least squares at lines that share one factorisation (kinematics/fit/line_solver.py), in one pass over the data.
 *
 * Coefficients z = P y, residuals r = y - B z, misfit sum w |r|^2 of each line, and the sums of |r|^2 and of
 * |r|^2 / line^2 of each channel. Lines are taken TILE at a time, so that the readings of all channels stay in the
 * processor's cache between the two looks at them; those of the next tile are fetched meanwhile.
 */
#include "kernels.h"

#define PARTS 4
#define TILE (PARTS * WIDE / 2) /* lines: real and imaginary parts are side by side */
#define ROW (PARTS * WIDE)

typedef struct {
    const double *project; /* (count, SIZE) */
    const double *back;    /* (count, SIZE) */
    const double *weight;  /* (count) */
    double *sums;          /* (count, 2, WIDE) */
} factor;

INLINE void fetch(const double *row)
{
    for (int k = 0; k < PARTS; k++) __builtin_prefetch(row + k * WIDE + WIDE - 1, 0, 2);
}

INLINE void projected(vec z[SIZE][PARTS], const double *y, int64_t stride, const int64_t *rows, int64_t count,
                      const double *project, int64_t ahead)
{
    for (int j = 0; j < SIZE; j++)
        for (int k = 0; k < PARTS; k++) z[j][k] = (vec){0};
    for (int64_t c = 0; c < count; c++) {
        const double *row = y + rows[c] * stride, *p = project + c * SIZE;
        if (ahead) fetch(row + ahead);
        vec v[PARTS];
        for (int k = 0; k < PARTS; k++) v[k] = FROM(row + k * WIDE);
        for (int j = 0; j < SIZE; j++)
            for (int k = 0; k < PARTS; k++) z[j][k] += p[j] * v[k];
    }
}

INLINE int settled(vec z[SIZE][PARTS])
{
    vec sum = {0};
    for (int j = 0; j < SIZE; j++)
        for (int k = 0; k < PARTS; k++) sum += z[j][k] - z[j][k];
    double all = 0.0;
    LANES all += sum[l];
    return all == 0.0;
}

INLINE void left(vec misfit[PARTS], vec z[SIZE][PARTS], const vec even[PARTS], const double *y, int64_t stride,
                 const int64_t *rows, int64_t count, const factor *f)
{
    for (int k = 0; k < PARTS; k++) misfit[k] = (vec){0};
    for (int64_t c = 0; c < count; c++) {
        const double *row = y + rows[c] * stride, *b = f->back + c * SIZE;
        double *sums = f->sums + 2 * WIDE * c;
        vec plain = AT(sums), scaled = AT(sums + WIDE), r[PARTS];
        for (int k = 0; k < PARTS; k++) r[k] = FROM(row + k * WIDE);
        for (int j = 0; j < SIZE; j++)
            for (int k = 0; k < PARTS; k++) r[k] -= b[j] * z[j][k];
        for (int k = 0; k < PARTS; k++) {
            r[k] *= r[k];
            plain += r[k];
            scaled += even[k] * r[k];
            misfit[k] += f->weight[c] * r[k];
        }
        AT(sums) = plain;
        AT(sums + WIDE) = scaled;
    }
}

/* 1 when none of the rows left out holds a finite value */
INLINE int silent(const double *y, int64_t stride, const int64_t *rows, int64_t count, int64_t lines)
{
    for (int64_t c = 0; c < count; c++) {
        const double *row = y + rows[c] * stride;
        for (int64_t l = 0; l < lines; l++)
            if (row[2 * l] - row[2 * l] == 0.0 && row[2 * l + 1] - row[2 * l + 1] == 0.0) return 0;
    }
    return 1;
}

/* Readings of the last lines, zeros behind them: row c of the copy is row rows[c]. */
INLINE void padded(double *room, const double *y, int64_t stride, const int64_t *rows, int64_t count, int64_t lines)
{
    memset(room, 0, sizeof(double) * (size_t)(count * ROW));
    for (int64_t c = 0; c < count; c++)
        memcpy(room + c * ROW, y + rows[c] * stride, sizeof(double) * 2 * (size_t)lines);
}

/* Lines `start` to `stop` of `value` (rows `stride` doubles apart). `rows`: `count` that are used, then `silent_rows`
 * that must hold nothing. `even`: line^-2 by line. `z` (SIZE, 2 lines of the whole, `wide` doubles apart) and
 * `misfit` (2 lines of the whole); `room`: count * ROW doubles; `own`: 0 .. count - 1.
 * Returns the first line that is not done: of the first tile with values that are not finite, or `stop`. */
EXPORT CLONES int64_t fit_shared(const double *value, int64_t stride, const int64_t *rows, int64_t count,
                                 int64_t silent_rows, int64_t start, int64_t stop, const double *project,
                                 const double *back, const double *weight, double *sums, const double *even,
                                 double *z, int64_t wide, double *misfit, double *room, const int64_t *own)
{
    const factor f = {project, back, weight, sums};
    for (int64_t at = start; at < stop; at += TILE) {
        const int64_t lines = stop - at < TILE ? stop - at : TILE;
        const double *y = value + 2 * at;
        int64_t apart = stride;
        const int64_t *mine = rows;
        if (!silent(y, stride, rows + count, silent_rows, lines)) return at;
        if (lines < TILE) {
            padded(room, y, stride, rows, count, lines);
            y = room, apart = ROW, mine = own;
        }
        vec found[SIZE][PARTS], wrong[PARTS], level[PARTS];
        projected(found, y, apart, mine, count, project, at + 2 * TILE <= stop ? ROW : 0);
        if (!settled(found)) return at;
        double each[ROW] = {0};
        for (int64_t l = 0; l < lines; l++) each[2 * l] = each[2 * l + 1] = even[at + l];
        for (int k = 0; k < PARTS; k++) level[k] = FROM(each + k * WIDE);
        left(wrong, found, level, y, apart, mine, count, &f);
        double out[ROW];
        for (int j = 0; j < SIZE; j++) {
            for (int k = 0; k < PARTS; k++) AT(out + k * WIDE) = found[j][k];
            memcpy(z + j * wide + 2 * at, out, sizeof(double) * 2 * (size_t)lines);
        }
        for (int k = 0; k < PARTS; k++) AT(out + k * WIDE) = wrong[k];
        memcpy(misfit + 2 * at, out, sizeof(double) * 2 * (size_t)lines);
    }
    return stop;
}
