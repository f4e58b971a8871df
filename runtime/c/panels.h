/* Matrices in panels of twelve rows, column by column: what factors and changes them. */
#ifndef EPIGAUGE_PANELS_H
#define EPIGAUGE_PANELS_H

#include <math.h>

#include "epigauge_kernels.h"

#define ROWS 12
#define BLOCK (ROWS * ROWS)

/* x <- x - factor y for vectors of twelve. */
static inline void subtract_multiple(double factor, const double *EG_RESTRICT y,
                                     double *EG_RESTRICT x)
{
    EG_SIMD
    for (int k = 0; k < ROWS; ++k)
        x[k] -= factor * y[k];
}

static inline void scale(double factor, double *x)
{
    EG_SIMD
    for (int k = 0; k < ROWS; ++k)
        x[k] *= factor;
}

/* L of A = L L^T in place, column by column; only the lower triangle is read, the upper one becomes
   zero. Returns 1 where A is not positive definite. */
static inline int factor_block(double *A)
{
    for (int j = 0; j < ROWS; ++j) {
        const double pivot = A[ROWS * j + j];
        if (!(pivot > 0.0 && pivot < INFINITY))
            return 1;
        scale(1.0 / sqrt(pivot), A + ROWS * j);
        for (int i = 0; i < j; ++i)
            A[ROWS * j + i] = 0.0;
        for (int c = j + 1; c < ROWS; ++c)
            subtract_multiple(A[ROWS * j + c], A + ROWS * j, A + ROWS * c);
    }
    return 0;
}

/* X <- X L^-T for X (12 rows) and a lower triangular L, both column by column. */
static inline void divide_by_transposed(const double *EG_RESTRICT L, double *EG_RESTRICT X)
{
    for (int j = 0; j < ROWS; ++j) {
        scale(1.0 / L[ROWS * j + j], X + ROWS * j);
        for (int c = j + 1; c < ROWS; ++c)
            subtract_multiple(L[ROWS * j + c], X + ROWS * j, X + ROWS * c);
    }
}

/* Columns of a panel that stay in the fastest cache. */
#define COLUMNS (8 * ROWS)

/* C -= X Y^T for panels X and Y of at most COLUMNS columns. */
static inline void subtract_some(ptrdiff_t columns, const double *EG_RESTRICT X,
                                 const double *EG_RESTRICT Y, double *EG_RESTRICT C)
{
    if (!columns)
        return;
    for (int c = 0; c < ROWS; c += 4, C += 4 * ROWS) {
        double a[8] = {0.0}, b[8] = {0.0}, d[8] = {0.0}, e[8] = {0.0};
        double f[4] = {0.0}, g[4] = {0.0}, h[4] = {0.0}, i[4] = {0.0};
        ptrdiff_t p = 0;
        do {
            const double *EG_RESTRICT x = X + ROWS * p, *EG_RESTRICT y = Y + ROWS * p + c;
            EG_SIMD
            for (int k = 0; k < 8; ++k)
                a[k] += y[0] * x[k], b[k] += y[1] * x[k], d[k] += y[2] * x[k], e[k] += y[3] * x[k];
            EG_SIMD
            for (int k = 0; k < 4; ++k)
                f[k] += y[0] * x[8 + k], g[k] += y[1] * x[8 + k], h[k] += y[2] * x[8 + k],
                    i[k] += y[3] * x[8 + k];
        } while (++p < columns);
        for (int k = 0; k < 8; ++k)
            C[k] -= a[k], C[ROWS + k] -= b[k], C[2 * ROWS + k] -= d[k], C[3 * ROWS + k] -= e[k];
        for (int k = 0; k < 4; ++k)
            C[8 + k] -= f[k], C[ROWS + 8 + k] -= g[k], C[2 * ROWS + 8 + k] -= h[k],
                C[3 * ROWS + 8 + k] -= i[k];
    }
}

/* The same for any number of columns. */
static inline void subtract_product(ptrdiff_t columns, const double *X, const double *Y, double *C)
{
    for (ptrdiff_t p = 0; p < columns; p += COLUMNS)
        subtract_some(columns - p < COLUMNS ? columns - p : COLUMNS, X + ROWS * p, Y + ROWS * p, C);
}

#endif
