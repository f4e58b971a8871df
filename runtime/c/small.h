/* Small dense matrices, row by row, of at most EG_SMALL rows. */
#ifndef EPIGAUGE_SMALL_H
#define EPIGAUGE_SMALL_H

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

#endif
