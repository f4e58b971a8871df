/* The blocks of the inverse within a skyline (Takahashi's selected inversion), from a factor.

   Only products are added up here: where the processor has fused multiply-adds, they are used (see
   CMakeLists.txt). */
#include <stdlib.h>
#include <string.h>

#include "panels.h"
#include "skyline.h"

/* X <- X L^-1 for X (12 rows) and a lower triangular L, both column by column. */
static void divide_by(const double *L, double *X)
{
    for (int j = ROWS - 1; j >= 0; --j) {
        for (int c = j + 1; c < ROWS; ++c)
            subtract_multiple(L[ROWS * j + c], X + ROWS * c, X + ROWS * j);
        scale(1.0 / L[(ROWS + 1) * j], X + ROWS * j);
    }
}

static void transpose(const double *EG_RESTRICT X, double *EG_RESTRICT Y)
{
    for (int c = 0; c < ROWS; ++c)
        for (int r = 0; r < ROWS; ++r)
            Y[ROWS * r + c] = X[ROWS * c + r];
}

/* C += sum of y x over pairs of blocks: row r of C is at 12 r, entry (r, p) of y at r_step r +
   p_step p, and row p of x at 12 p. Four rows of C stay in registers meanwhile. */
EG_INLINE void add_products(ptrdiff_t count, const double *const *y, const double *const *x,
                            ptrdiff_t r_step, ptrdiff_t p_step, double *EG_RESTRICT C)
{
    for (int r = 0; r < ROWS; r += 4, C += 4 * ROWS) {
        double a[8] = {0.0}, b[8] = {0.0}, d[8] = {0.0}, e[8] = {0.0};
        double f[4] = {0.0}, g[4] = {0.0}, h[4] = {0.0}, i[4] = {0.0};
        for (ptrdiff_t l = 0; l < count; ++l) {
            const double *EG_RESTRICT row = x[l], *EG_RESTRICT own = y[l] + r_step * r;
            for (int p = 0; p < ROWS; ++p, row += ROWS, own += p_step) {
                const double s = own[0], t = own[r_step], u = own[2 * r_step], v = own[3 * r_step];
                EG_SIMD
                for (int k = 0; k < 8; ++k)
                    a[k] += s * row[k], b[k] += t * row[k], d[k] += u * row[k], e[k] += v * row[k];
                EG_SIMD
                for (int k = 0; k < 4; ++k)
                    f[k] += s * row[8 + k], g[k] += t * row[8 + k], h[k] += u * row[8 + k],
                        i[k] += v * row[8 + k];
            }
        }
        for (int k = 0; k < 8; ++k)
            C[k] += a[k], C[ROWS + k] += b[k], C[2 * ROWS + k] += d[k], C[3 * ROWS + k] += e[k];
        for (int k = 0; k < 4; ++k)
            C[8 + k] += f[k], C[ROWS + 8 + k] += g[k], C[2 * ROWS + 8 + k] += h[k],
                C[3 * ROWS + 8 + k] += i[k];
    }
}

/* The block rows below block column j that have it, in rising order; so many. */
static ptrdiff_t rows_below(const eg_envelope *envelope, ptrdiff_t j, ptrdiff_t last, ptrdiff_t *rows)
{
    ptrdiff_t count = 0;
    for (ptrdiff_t k = j + 1; k <= last; ++k)
        if (envelope->first[k] <= j)
            rows[count++] = k;
    return count;
}

static double *block_at(const eg_envelope *envelope, double *S, ptrdiff_t row, ptrdiff_t column)
{
    return S + BLOCK * (envelope->slot[row] + column - envelope->first[row]);
}

/* The blocks within the skyline of Z = (L L^T)^-1 in place of L, blocks of the diagonal whole.
   Returns 1 where there is no memory.

   With M = L D^-1, D the diagonal blocks of L, column by column from the last one on:
   Z_kj = -sum_i Z_ki M_ij over the rows i below j that have the column, and
   Z_jj = D_j^-T D_j^-1 - sum_i M_ij^T Z_ij. All Z_ki needed are within the skyline: where rows
   i < k have column j, row k has column i. */
int eg_envelope_invert(const eg_envelope *envelope, double *S)
{
    const ptrdiff_t n = envelope->n;
    ptrdiff_t *last = malloc((size_t)(2 * n + 1) * sizeof *last), *rows = last + n;
    double *M = malloc((size_t)(2 * BLOCK * n + 1) * sizeof *M), *Z = M + BLOCK * n;
    const double **x = malloc((size_t)(2 * n + 1) * sizeof *x), **y = x + n;
    if (!last || !M || !x) {
        free(last), free(M), free((void *)x);
        return 1;
    }
    /* The last row that has each column. */
    memset(last, 0, (size_t)n * sizeof *last);
    for (ptrdiff_t k = 0; k < n; ++k)
        last[envelope->first[k]] = k;
    for (ptrdiff_t j = 1; j < n; ++j)
        last[j] = last[j] > last[j - 1] ? last[j] : last[j - 1];
    for (ptrdiff_t j = n - 1; j >= 0; --j) {
        double *D = block_at(envelope, S, j, j), X[BLOCK];
        const ptrdiff_t count = rows_below(envelope, j, last[j], rows);
        for (ptrdiff_t l = 0; l < count; ++l) {
            memcpy(X, block_at(envelope, S, rows[l], j), sizeof X);
            divide_by(D, X);
            transpose(X, M + BLOCK * l);
            x[l] = M + BLOCK * l;
        }
        memset(Z, 0, (size_t)(BLOCK * count) * sizeof *Z);
        for (ptrdiff_t l = 0; l < count; ++l) {
            for (ptrdiff_t i = 0; i <= l; ++i)
                y[i] = block_at(envelope, S, rows[l], rows[i]);
            for (ptrdiff_t i = l + 1; i < count; ++i)
                y[i] = block_at(envelope, S, rows[i], rows[l]);
            add_products(l + 1, y, x, 1, ROWS, Z + BLOCK * l);
            add_products(count - l - 1, y + l + 1, x + l + 1, ROWS, 1, Z + BLOCK * l);
        }
        for (ptrdiff_t l = 0; l < count; ++l) {
            y[l] = Z + BLOCK * l;
            double *to = block_at(envelope, S, rows[l], j);
            transpose(y[l], to);
            for (int k = 0; k < BLOCK; ++k)
                to[k] = -to[k];
        }
        double inverse[BLOCK] = {0.0}, own[BLOCK] = {0.0};
        for (int k = 0; k < ROWS; ++k)
            inverse[(ROWS + 1) * k] = 1.0;
        divide_by(D, inverse); /* D^-1, column by column; its products of columns make D^-T D^-1 */
        const double *column = inverse;
        double turned[BLOCK];
        transpose(inverse, turned);
        const double *row = turned;
        add_products(1, &column, &row, ROWS, 1, own);
        add_products(count, y, x, 1, ROWS, own);
        for (int r = 0; r < ROWS; ++r)
            for (int c = 0; c < ROWS; ++c)
                D[ROWS * c + r] = 0.5 * (own[ROWS * r + c] + own[ROWS * c + r]);
    }
    free(last), free(M), free((void *)x);
    return 0;
}

/* Entry (r, c) of the matrix; either may be the larger one. */
static double entry(const eg_envelope *panels, const double *S, ptrdiff_t r, ptrdiff_t c)
{
    if (c > r) {
        const ptrdiff_t k = r;
        r = c, c = k;
    }
    const ptrdiff_t panel = r / ROWS;
    return S[BLOCK * (panels->slot[panel] - panels->first[panel]) + ROWS * c + r - ROWS * panel];
}

/* blocks = A Z A^T + K K^T for the pairs of views of a skyline: a row for each entry of the view with
   the lower number. Z is in panels, A (n, d, a), NULL for I; K (n, d, k). */
void eg_skyline_spread(
    const eg_envelope *views, const eg_envelope *panels, const eg_blocks *how, ptrdiff_t a,
    const double *A, ptrdiff_t k, const double *K, const double *S, double *blocks)
{
    double X[EG_MOST_TANGENT * EG_MOST_TANGENT], half[EG_MOST_TANGENT * EG_MOST_TANGENT];
    const ptrdiff_t d = how->d;
    for (ptrdiff_t t = 0; t < views->n; ++t)
        for (ptrdiff_t s = views->first[t]; s <= t; ++s, blocks += how->size) {
            for (ptrdiff_t i = 0; i < a; ++i)
                for (ptrdiff_t l = 0; l < a; ++l)
                    X[a * i + l] = entry(panels, S, a * s + i, a * t + l);
            for (ptrdiff_t i = 0; A && i < d; ++i)
                for (ptrdiff_t l = 0; l < a; ++l) {
                    double sum = 0.0;
                    for (ptrdiff_t p = 0; p < a; ++p)
                        sum += A[a * (d * s + i) + p] * X[a * p + l];
                    half[a * i + l] = sum;
                }
            memset(blocks, 0, (size_t)how->size * sizeof *blocks);
            for (ptrdiff_t i = 0; i < d; ++i)
                for (ptrdiff_t l = 0; l < d; ++l) {
                    double sum = A ? 0.0 : X[a * i + l];
                    for (ptrdiff_t p = 0; A && p < a; ++p)
                        sum += half[a * i + p] * A[a * (d * t + l) + p];
                    for (ptrdiff_t p = 0; p < k; ++p)
                        sum += K[k * (d * s + i) + p] * K[k * (d * t + l) + p];
                    blocks[how->length * i + l] = sum;
                }
        }
}
