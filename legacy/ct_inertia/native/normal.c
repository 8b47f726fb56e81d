/* The normal distribution and its quantiles. */
#include "stapes.h"

API void normal_cdf(const double *z, int64_t count, double *share)
{
    for (int64_t k = 0; k < count; k++)
        share[k] = 0.5 * erfc(-z[k] * 0.70710678118654752440);
}

/* Quantiles: a rational function good to 1e-9 (Acklam 2003) and two steps of Halley's method, taken in the lower
 * tail, where the share keeps its digits. */
static double quantile(double share)
{
    static const double a[6] = {-3.969683028665376e+01, 2.209460984245205e+02, -2.759285104469687e+02,
                                1.383577518672690e+02,  -3.066479806614716e+01, 2.506628277459239e+00};
    static const double b[5] = {-5.447609879822406e+01, 1.615858368580409e+02, -1.556989798598866e+02,
                                6.680131188771972e+01, -1.328068155288572e+01};
    static const double c[6] = {-7.784894002430293e-03, -3.223964580411365e-01, -2.400758277161838e+00,
                                -2.549732539343734e+00, 4.374664141464968e+00,  2.938163982698783e+00};
    static const double d[4] = {7.784695709041462e-03, 3.224671290700398e-01, 2.445134137142996e+00,
                                3.754408661907416e+00};
    if (!(share > 0.0 && share < 1.0))
        return share == 0.0 ? -INFINITY : share == 1.0 ? INFINITY : NAN;
    const double p = share > 0.5 ? 1.0 - share : share;
    double z;
    if (p < 0.02425) {
        const double q = sqrt(-2.0 * log(p));
        z = (((((c[0] * q + c[1]) * q + c[2]) * q + c[3]) * q + c[4]) * q + c[5]) /
            ((((d[0] * q + d[1]) * q + d[2]) * q + d[3]) * q + 1.0);
    } else {
        const double q = p - 0.5, r = q * q;
        z = (((((a[0] * r + a[1]) * r + a[2]) * r + a[3]) * r + a[4]) * r + a[5]) * q /
            (((((b[0] * r + b[1]) * r + b[2]) * r + b[3]) * r + b[4]) * r + 1.0);
    }
    for (int round = 0; round < 2; round++) {
        const double miss = 0.5 * erfc(-z * 0.70710678118654752440) - p;
        const double u = miss * 2.50662827463100050242 * exp(0.5 * z * z);
        z -= u / (1.0 + 0.5 * z * u);
    }
    return share > 0.5 ? -z : z;
}

API void normal_quantile(const double *share, int64_t count, double *z)
{
    for (int64_t k = 0; k < count; k++)
        z[k] = quantile(share[k]);
}
