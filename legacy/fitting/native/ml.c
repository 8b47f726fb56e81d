/* Maximum likelihood with errors in all variables: distances, gradient and Gauss-Newton Hessian in one pass.
 *
 * For every line: Z = K + s D, e = Z dq - f, G = Spp Z^H - Spf, Ce = Z G - (Z Spf)^H + Sff = L L^H,
 * distance = |L^-1 e|^2, corrected motion dq - G Ce^-1 e, J = L^-1 d(Z dq)/dp at the corrected motion;
 * H = sum w Re(J^H J), g = sum w Re(J^H L^-1 e)  (fitting/model/scaled_lines.py, fitting/estimators/ml.py).
 * The columns of J that belong to D are s times those of K, so that only the latter are formed.
 * Lines are taken WIDE at a time; arrays are complex, rows of `count` lines, as numpy keeps them.
 */
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("O2", "tree-vectorize") /* as fast as O3 here, and compiled in a fifth of the time */
#endif
#include <math.h>
#include <stdint.h>
#include <string.h>

#define WIDE 8
#define MOST 6
#define HALF (MOST * (MOST + 1) / 2)
#define EACH for (int l = 0; l < WIDE; l++)

#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__)
#define CLONES __attribute__((target_clones("default", "fma", "avx512f")))
#else
#define CLONES
#endif
#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

typedef struct { double re[WIDE], im[WIDE]; } lane;

static inline __attribute__((always_inline)) void load(lane *to, const double *row, const int *at)
{
    EACH { to->re[l] = row[2 * at[l]]; to->im[l] = row[2 * at[l] + 1]; }
}

static inline __attribute__((always_inline)) void load_run(lane *to, const double *row)
{
    EACH { to->re[l] = row[2 * l]; to->im[l] = row[2 * l + 1]; }
}

/* to += a b */
static inline __attribute__((always_inline)) void add(lane *to, const lane *a, const lane *b)
{
    EACH {
        to->re[l] += a->re[l] * b->re[l] - a->im[l] * b->im[l];
        to->im[l] += a->re[l] * b->im[l] + a->im[l] * b->re[l];
    }
}

/* to += a conj(b) */
static inline __attribute__((always_inline)) void add_conj(lane *to, const lane *a, const lane *b)
{
    EACH {
        to->re[l] += a->re[l] * b->re[l] + a->im[l] * b->im[l];
        to->im[l] += a->im[l] * b->re[l] - a->re[l] * b->im[l];
    }
}

/* to -= a b */
static inline __attribute__((always_inline)) void take(lane *to, const lane *a, const lane *b)
{
    EACH {
        to->re[l] -= a->re[l] * b->re[l] - a->im[l] * b->im[l];
        to->im[l] -= a->re[l] * b->im[l] + a->im[l] * b->re[l];
    }
}

/* to -= a conj(b) */
static inline __attribute__((always_inline)) void take_conj(lane *to, const lane *a, const lane *b)
{
    EACH {
        to->re[l] -= a->re[l] * b->re[l] + a->im[l] * b->im[l];
        to->im[l] -= a->im[l] * b->re[l] - a->re[l] * b->im[l];
    }
}

static inline __attribute__((always_inline)) void scale(lane *to, const double *by)
{
    EACH { to->re[l] *= by[l]; to->im[l] *= by[l]; }
}

static inline __attribute__((always_inline)) double total(const double *values)
{
    double sum = 0.0;
    EACH sum += values[l];
    return sum;
}

static inline __attribute__((always_inline)) void
expand(const int n, const int count, const double *parameters, const double *factor, const double *dq, const double *force,
       const double *spread, const double *sff, double student, double dimension, int mode, double *distance,
       double *hessian, double *gradient)
{
    const int half = n * (n + 1) / 2, all = 2 * half;
    double k[MOST][MOST], d[MOST][MOST];
    double kk[HALF][HALF][WIDE], kd[HALF][HALF][WIDE], dd[HALF][HALF][WIDE], gk[HALF][WIDE], gd[HALF][WIDE];
    int first[HALF], second[HALF];
    for (int row = 0, at = 0; row < n; row++)
        for (int column = row; column < n; column++, at++) {
            k[row][column] = k[column][row] = parameters[at];
            d[row][column] = d[column][row] = parameters[half + at];
            first[at] = row;
            second[at] = column;
        }
    if (mode)
        for (int i = 0; i < half; i++) {
            memset(gk[i], 0, sizeof gk[i]);
            memset(gd[i], 0, sizeof gd[i]);
            for (int j = 0; j < half; j++) {
                memset(kk[i][j], 0, sizeof kk[i][j]);
                memset(kd[i][j], 0, sizeof kd[i][j]);
                memset(dd[i][j], 0, sizeof dd[i][j]);
            }
        }
    for (int from = 0; from < count; from += WIDE) {
        lane s, z[MOST][MOST], q[MOST], e[MOST], u[MOST], g[MOST][MOST], c[MOST][MOST], t;
        double inverse[MOST][WIDE], sum[WIDE], weight[WIDE], size[WIDE];
        const int whole = from + WIDE <= count;
        int at[WIDE];
        EACH at[l] = from + l < count ? from + l : count - 1;
#define LOAD(to, base, row) \
    do { if (whole) load_run((to), (base) + 2 * ((size_t)(row) * count + from)); \
         else load((to), (base) + 2 * (size_t)(row) * count, at); } while (0)
        LOAD(&s, factor, 0);
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++)
                EACH {
                    z[i][j].re[l] = k[i][j] + s.re[l] * d[i][j];
                    z[i][j].im[l] = s.im[l] * d[i][j];
                }
        for (int i = 0; i < n; i++) {
            LOAD(&q[i], dq, i);
            LOAD(&t, force, i);
            EACH { e[i].re[l] = -t.re[l]; e[i].im[l] = -t.im[l]; }
        }
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++)
                add(&e[i], &z[i][j], &q[j]);
        /* G = Spp Z^H - Spf; then Ce = Z G - (Z Spf)^H + Sff, lower triangle */
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) {
                LOAD(&t, spread, i * 2 * n + n + j);
                EACH { g[i][j].re[l] = -t.re[l]; g[i][j].im[l] = -t.im[l]; }
            }
        for (int i = 0; i < n; i++)
            for (int m = 0; m < n; m++) {
                LOAD(&t, spread, i * 2 * n + m);
                for (int j = 0; j < n; j++)
                    add_conj(&g[i][j], &t, &z[j][m]);
            }
        for (int i = 0; i < n; i++)
            for (int j = 0; j <= i; j++) {
                LOAD(&c[i][j], sff, i * n + j);
                if (mode == 3)
                    EACH { c[i][j].re[l] = i == j; c[i][j].im[l] = 0.0; }
            }
        for (int m = 0; m < n && mode < 3; m++)
            for (int i = 0; i < n; i++) {
                LOAD(&t, spread, m * 2 * n + n + i);
                EACH t.im[l] = -t.im[l];
                for (int j = 0; j <= i; j++) {
                    add(&c[i][j], &z[i][m], &g[m][j]);
                    take_conj(&c[i][j], &t, &z[j][m]);
                }
            }
        /* Ce = L L^H in place, then u = L^-1 e */
        for (int j = 0; j < n; j++) {
            EACH {
                double square = c[j][j].re[l];
                for (int m = 0; m < j; m++)
                    square -= c[j][m].re[l] * c[j][m].re[l] + c[j][m].im[l] * c[j][m].im[l];
                inverse[j][l] = 1.0 / sqrt(square);
            }
            for (int i = j + 1; i < n; i++) {
                for (int m = 0; m < j; m++)
                    take_conj(&c[i][j], &c[i][m], &c[j][m]);
                scale(&c[i][j], inverse[j]);
            }
        }
        memset(sum, 0, sizeof sum);
        for (int i = 0; i < n; i++) {
            u[i] = e[i];
            for (int m = 0; m < i; m++)
                take(&u[i], &c[i][m], &u[m]);
            scale(&u[i], inverse[i]);
            EACH sum[l] += u[i].re[l] * u[i].re[l] + u[i].im[l] * u[i].im[l];
        }
        for (int l = 0; l < WIDE && from + l < count; l++)
            distance[from + l] = isnan(sum[l]) ? INFINITY : sum[l];
        if (!mode)
            continue;
        EACH weight[l] = from + l >= count ? 0.0 : student > 0.0 ? (4.0 + dimension) / (student + 2.0 * sum[l]) : 1.0;
        /* corrected motion q - G L^-H u */
        lane v[MOST];
        for (int i = n - 1; i >= 0 && mode == 1; i--) {
            v[i] = u[i];
            for (int m = i + 1; m < n; m++)
                EACH {
                    v[i].re[l] -= c[m][i].re[l] * v[m].re[l] + c[m][i].im[l] * v[m].im[l];
                    v[i].im[l] -= c[m][i].re[l] * v[m].im[l] - c[m][i].im[l] * v[m].re[l];
                }
            scale(&v[i], inverse[i]);
        }
        for (int i = 0; i < n && mode == 1; i++)
            for (int j = 0; j < n; j++)
                take(&q[i], &g[i][j], &v[j]);
        /* columns of J for K, weighted by the root of the weight on both sides through `weight` */
        lane column[HALF][MOST];
        for (int a = 0; a < half; a++) {
            const int low = first[a], high = second[a];
            for (int i = low; i < n; i++) {
                lane *x = &column[a][i];
                if (i == low) *x = q[high];
                else if (i == high) *x = q[low];
                else memset(x, 0, sizeof *x);
                for (int m = low; m < i; m++)
                    take(x, &c[i][m], &column[a][m]);
                scale(x, inverse[i]);
            }
        }
        EACH size[l] = s.re[l] * s.re[l] + s.im[l] * s.im[l];
        for (int a = 0; a < half; a++) {
            lane dot;
            memset(&dot, 0, sizeof dot);
            for (int i = first[a]; i < n; i++)
                add_conj(&dot, &u[i], &column[a][i]);
            EACH {
                gk[a][l] += weight[l] * dot.re[l];
                gd[a][l] += weight[l] * (s.re[l] * dot.re[l] + s.im[l] * dot.im[l]);
            }
            for (int b = a; b < half; b++) {
                memset(&dot, 0, sizeof dot);
                for (int i = first[b]; i < n; i++)
                    add_conj(&dot, &column[b][i], &column[a][i]);
                /* dot = J_a^H J_b; D columns are s J */
                EACH {
                    const double re = weight[l] * dot.re[l], im = weight[l] * dot.im[l];
                    kk[a][b][l] += re;
                    dd[a][b][l] += size[l] * re;
                    kd[a][b][l] += s.re[l] * re - s.im[l] * im;
                    kd[b][a][l] += b == a ? 0.0 : s.re[l] * re + s.im[l] * im;
                }
            }
        }
    }
    if (!mode)
        return;
    for (int a = 0; a < half; a++) {
        gradient[a] = total(gk[a]);
        gradient[half + a] = total(gd[a]);
        for (int b = a; b < half; b++) {
            hessian[a * all + b] = hessian[b * all + a] = total(kk[a][b]);
            hessian[(half + a) * all + half + b] = hessian[(half + b) * all + half + a] = total(dd[a][b]);
        }
        for (int b = 0; b < half; b++)
            hessian[a * all + half + b] = hessian[(half + b) * all + a] = total(kd[a][b]);
    }
}

/* n in 1..6; returns 0, or 1 when n is outside. `student` = 4 spread for Student's t with 4 degrees of freedom,
 * 0 for least squares. mode 0: distances alone; 1: with H and g; 2: with the regressor at the measured motion;
 * 3: that, and Ce = 1. */
EXPORT CLONES int64_t
ml_expand(int64_t n, int64_t count, const double *parameters, const double *factor, const double *dq,
          const double *force, const double *spread, const double *sff, double student, double dimension,
          int64_t mode, double *distance, double *hessian, double *gradient)
{
    const int size = (int)n, lines = (int)count, kind = (int)mode;
    if (n < 1 || n > MOST)
        return 1;
    if (n == 3)
        expand(3, lines, parameters, factor, dq, force, spread, sff, student, dimension, kind, distance, hessian, gradient);
    else
        expand(size, lines, parameters, factor, dq, force, spread, sff, student, dimension, kind, distance, hessian, gradient);
    return 0;
}
