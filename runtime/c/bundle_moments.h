/* Sums of factors times moments of points: what the factored route, and resection, add up. */
#ifndef EPIGAUGE_BUNDLE_MOMENTS_H
#define EPIGAUGE_BUNDLE_MOMENTS_H

#include "bundle_points.h"

/* Add three factors (rows of `factors`, M apart) times the moments of one or more neighbouring lanes
   to their sums: eight moments to `high`, four to `low`. The sums stay in registers meanwhile. */
static inline void eg_accumulate(ptrdiff_t lanes, const double *EG_RESTRICT factors, ptrdiff_t M,
                                 const double *EG_RESTRICT moments, double *EG_RESTRICT high,
                                 double *EG_RESTRICT low)
{
    double a[8], b[8], c[8], d[4], e[4], f[4];
    EG_SIMD
    for (int k = 0; k < 8; ++k)
        a[k] = high[k], b[k] = high[8 + k], c[k] = high[16 + k];
    EG_SIMD
    for (int k = 0; k < 4; ++k)
        d[k] = low[k], e[k] = low[4 + k], f[k] = low[8 + k];
    ptrdiff_t j = 0;
    do {
        const double *EG_RESTRICT moment = moments + 16 * j;
        const double x = factors[j], y = factors[M + j], z = factors[2 * M + j];
        EG_SIMD
        for (int k = 0; k < 8; ++k)
            a[k] += x * moment[k], b[k] += y * moment[k], c[k] += z * moment[k];
        EG_SIMD
        for (int k = 0; k < 4; ++k)
            d[k] += x * moment[8 + k], e[k] += y * moment[8 + k], f[k] += z * moment[8 + k];
    } while (++j < lanes);
    EG_SIMD
    for (int k = 0; k < 8; ++k)
        high[k] = a[k], high[8 + k] = b[k], high[16 + k] = c[k];
    EG_SIMD
    for (int k = 0; k < 4; ++k)
        low[k] = d[k], low[4 + k] = e[k], low[8 + k] = f[k];
}

/* The same for one factor. */
static inline void eg_accumulate_one(ptrdiff_t lanes, const double *EG_RESTRICT factors,
                                     const double *EG_RESTRICT moments, double *EG_RESTRICT high,
                                     double *EG_RESTRICT low)
{
    double a[8], d[4];
    EG_SIMD
    for (int k = 0; k < 8; ++k)
        a[k] = high[k];
    EG_SIMD
    for (int k = 0; k < 4; ++k)
        d[k] = low[k];
    ptrdiff_t j = 0;
    do {
        EG_SIMD
        for (int k = 0; k < 8; ++k)
            a[k] += factors[j] * moments[16 * j + k];
        EG_SIMD
        for (int k = 0; k < 4; ++k)
            d[k] += factors[j] * moments[16 * j + 8 + k];
    } while (++j < lanes);
    EG_SIMD
    for (int k = 0; k < 8; ++k)
        high[k] = a[k];
    EG_SIMD
    for (int k = 0; k < 4; ++k)
        low[k] = d[k];
}

/* Add three factors times Q of one or more neighbouring lanes: twelve sums. */
static inline void eg_accumulate_points(ptrdiff_t lanes, const double *EG_RESTRICT factors,
                                        ptrdiff_t M, const double *EG_RESTRICT moments,
                                        double *EG_RESTRICT sums)
{
    double a[4], b[4], c[4];
    EG_SIMD
    for (int k = 0; k < 4; ++k)
        a[k] = sums[k], b[k] = sums[4 + k], c[k] = sums[8 + k];
    ptrdiff_t j = 0;
    do {
        const double *EG_RESTRICT point = moments + 16 * j + 12;
        const double x = factors[j], y = factors[M + j], z = factors[2 * M + j];
        EG_SIMD
        for (int k = 0; k < 4; ++k)
            a[k] += x * point[k], b[k] += y * point[k], c[k] += z * point[k];
    } while (++j < lanes);
    EG_SIMD
    for (int k = 0; k < 4; ++k)
        sums[k] = a[k], sums[4 + k] = b[k], sums[8 + k] = c[k];
}

#endif
