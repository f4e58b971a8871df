/* Small dense matrices, row by row, of at most EG_SMALL rows. */
#ifndef EPIGAUGE_SMALL_H
#define EPIGAUGE_SMALL_H

#include <math.h>

#define EG_SMALL 9

/* Cholesky factor of A + shift I into L (lower). Returns the ratio of the least squared pivot to
   the largest diagonal entry, or a number <= 0 (or NaN) where the matrix is not positive definite. */
double eg_cholesky(int p, const double *A, double shift, double *L);

/* x <- (L L^T)^-1 x */
void eg_cholesky_solve(int p, const double *L, double *x);

/* Eigenvalues, rising, and eigenvectors (columns) of a symmetric matrix, by Jacobi rotations. */
void eg_eigen(int p, const double *A, double *values, double *vectors);

/* F ~ U diag(1, sigma, 0) V^T of the nearest matrix of rank two; 0 where the rank is below two. */
int eg_factorize(const double *F, double *U, double *V, double *sigma);

/* C <- A B and C <- A^T B, for A (n, k) or (k, n) and B (k, m). Inline: their sizes are constants. */
static inline void eg_product(int n, int k, int m, const double *A, const double *B, double *C)
{
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < m; ++j) {
            double sum = 0.0;
            for (int l = 0; l < k; ++l)
                sum += A[i * k + l] * B[l * m + j];
            C[i * m + j] = sum;
        }
}

static inline void eg_transposed_product(int n, int k, int m, const double *A, const double *B,
                                         double *C)
{
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < m; ++j) {
            double sum = 0.0;
            for (int l = 0; l < k; ++l)
                sum += A[l * n + i] * B[l * m + j];
            C[i * m + j] = sum;
        }
}

/* P A = L U in the place of A (p, p), rows exchanged by their numbers; returns 1 if it is singular. Inline,
   as products are. */
static inline int eg_lu(int p, double *A, int *rows)
{
    for (int k = 0; k < p; ++k) {
        int best = k;
        for (int i = k + 1; i < p; ++i)
            if (fabs(A[p * i + k]) > fabs(A[p * best + k]))
                best = i;
        rows[k] = best;
        if (A[p * best + k] == 0.0)
            return 1;
        for (int j = 0; j < p && best != k; ++j) {
            const double other = A[p * k + j];
            A[p * k + j] = A[p * best + j];
            A[p * best + j] = other;
        }
        for (int i = k + 1; i < p; ++i) {
            A[p * i + k] /= A[p * k + k];
            for (int j = k + 1; j < p; ++j)
                A[p * i + j] -= A[p * i + k] * A[p * k + j];
        }
    }
    return 0;
}

/* x <- A^-1 x */
static inline void eg_lu_solve(int p, const double *A, const int *rows, double *x)
{
    for (int k = 0; k < p; ++k) {
        const double other = x[k];
        x[k] = x[rows[k]];
        x[rows[k]] = other;
    }
    for (int i = 1; i < p; ++i)
        for (int j = 0; j < i; ++j)
            x[i] -= A[p * i + j] * x[j];
    for (int i = p - 1; i >= 0; --i) {
        for (int j = i + 1; j < p; ++j)
            x[i] -= A[p * i + j] * x[j];
        x[i] /= A[p * i + i];
    }
}

#endif
