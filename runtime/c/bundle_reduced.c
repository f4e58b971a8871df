/* The reduced system of the cameras: blocks, whitening, Cholesky factor within an envelope. */
#include <math.h>
#include <string.h>

#include "bundle.h"

#define ROWS 12
#define BLOCK (ROWS * ROWS)
#define GROUP 8

/* Place of entry (k, l) of Q Q^T among its ten distinct ones, and of (a, b) among six of 3x3. */
static const int moment_of[4][4] = {{0, 1, 2, 3}, {1, 4, 5, 6}, {2, 5, 7, 8}, {3, 6, 8, 9}};
static const int upper_of[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};

/* Blocks of J^T J and of the depths (n, 12, 12), gradient (n, 12) from the sums of cameras. */
void eg_bundle_camera_blocks(
    ptrdiff_t n, const double *cameras, double *U, double *D, double *g)
{
    memset(D, 0, (size_t)(n * BLOCK) * sizeof(double));
    for (ptrdiff_t i = 0; i < n; ++i) {
        const double *sum = cameras + EG_CAMERA * i;
        double *own = U + BLOCK * i, *depth = D + BLOCK * i;
        for (int a = 0; a < 3; ++a)
            for (int k = 0; k < 4; ++k)
                for (int b = 0; b < 3; ++b)
                    for (int l = 0; l < 4; ++l)
                        own[ROWS * (4 * a + k) + 4 * b + l] =
                            sum[EG_ENTRY(7, upper_of[a][b], moment_of[k][l])];
        for (int k = 0; k < 4; ++k)
            for (int l = 0; l < 4; ++l)
                depth[ROWS * (8 + k) + 8 + l] = sum[EG_ENTRY(7, 6, moment_of[k][l])];
        memcpy(g + ROWS * i, sum + 7 * EG_MOMENTS, ROWS * sizeof(double));
    }
}

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
static int factor_block(double *A)
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
static void divide_by_transposed(const double *EG_RESTRICT L, double *EG_RESTRICT X)
{
    for (int j = 0; j < ROWS; ++j) {
        scale(1.0 / L[ROWS * j + j], X + ROWS * j);
        for (int c = j + 1; c < ROWS; ++c)
            subtract_multiple(L[ROWS * j + c], X + ROWS * j, X + ROWS * c);
    }
}

/* C -= X Y^T for panels X and Y of so many columns. */
static void subtract_product(ptrdiff_t columns, const double *EG_RESTRICT X,
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

/* A upper triangular with A^T W A = I, and A^T U A + lam I; all (n, 12, 12). Returns 1 where a W is
   not positive definite. */
int eg_bundle_whiten(
    ptrdiff_t n, const double *U, const double *W, double lam, double *A, double *white)
{
    double L[BLOCK], inverse[BLOCK], half[BLOCK];
    for (ptrdiff_t i = 0; i < n; ++i) {
        double *root = A + BLOCK * i, *own = white + BLOCK * i;
        memcpy(L, W + BLOCK * i, sizeof L);
        if (factor_block(L))
            return 1;
        /* L^-T column by column, and the other way round. */
        memset(inverse, 0, sizeof inverse);
        for (int k = 0; k < ROWS; ++k)
            inverse[(ROWS + 1) * k] = 1.0;
        divide_by_transposed(L, inverse);
        for (int k = 0; k < ROWS; ++k)
            for (int l = 0; l < ROWS; ++l)
                root[ROWS * k + l] = inverse[ROWS * l + k];
        /* -(A^T U), and A^T U A. */
        memset(half, 0, sizeof half);
        subtract_product(ROWS, root, U + BLOCK * i, half);
        memset(own, 0, sizeof half);
        subtract_product(ROWS, half, root, own);
        for (int k = 0; k < ROWS; ++k)
            own[(ROWS + 1) * k] += lam;
    }
    return 0;
}

/* S = U - A^T (sums of pairs) A, block by block; U (n, 12, 12), A (n, 12, 12) or NULL for I. */
void eg_bundle_reduce(
    const eg_envelope *envelope, const double *pairs, const double *U, const double *A, double *S)
{
    double raw[BLOCK], half[BLOCK];
    for (ptrdiff_t row = 0; row < envelope->n; ++row) {
        for (ptrdiff_t column = envelope->first[row]; column <= row; ++column, S += BLOCK) {
            const ptrdiff_t slot = envelope->slot[row] + column - envelope->first[row];
            const double *pair = pairs + EG_PAIR * slot;
            double *to = A ? raw : S;
            for (int q = 0; q < 3; ++q)
                for (int l = 0; l < 4; ++l)
                    for (int p = 0; p < 3; ++p)
                        for (int k = 0; k < 4; ++k)
                            to[ROWS * (4 * q + l) + 4 * p + k] =
                                -pair[EG_ENTRY(9, 3 * q + p, moment_of[k][l])];
            if (A) { /* half = (sums) A, row by row; S = -A^T half. */
                memset(half, 0, sizeof half);
                memset(S, 0, sizeof half);
                subtract_product(ROWS, A + BLOCK * column, raw, half);
                subtract_product(ROWS, A + BLOCK * row, half, S);
            }
            for (int k = 0; row == column && k < BLOCK; ++k)
                S[k] += U[BLOCK * row + k];
        }
    }
}

/* L of S = L L^T in place of S, a few block rows at a time, so that the rows before them are read
   from memory less often. Returns 1 where S is not positive definite. */
int eg_envelope_factor(const eg_envelope *envelope, double *S)
{
    const int32_t *first = envelope->first;
    for (ptrdiff_t begin = 0, end; begin < envelope->n; begin = end) {
        end = begin + GROUP < envelope->n ? begin + GROUP : envelope->n;
        ptrdiff_t i = begin;
        for (ptrdiff_t k = begin; k < end; ++k)
            i = first[k] < i ? first[k] : i;
        for (; i < end; ++i) {
            const double *other = S + BLOCK * envelope->slot[i];
            for (ptrdiff_t k = i > begin ? i : begin; k < end; ++k) {
                if (i < first[k])
                    continue;
                const ptrdiff_t both = first[k] > first[i] ? first[k] : first[i];
                double *panel = S + BLOCK * envelope->slot[k], *block = panel + BLOCK * (i - first[k]);
                subtract_product(ROWS * (i - both), panel + BLOCK * (both - first[k]),
                                 other + BLOCK * (both - first[i]), block);
                if (i < k)
                    divide_by_transposed(other + BLOCK * (i - first[i]), block);
                else if (factor_block(block))
                    return 1;
            }
        }
    }
    return 0;
}

/* x <- (L L^T)^-1 x for `count` vectors, one after the other. */
void eg_envelope_solve(
    const eg_envelope *envelope, const double *S, ptrdiff_t count, double *x)
{
    for (ptrdiff_t c = 0; c < count; ++c, x += ROWS * envelope->n) {
        for (ptrdiff_t k = 0; k < envelope->n; ++k) {
            const double *panel = S + BLOCK * envelope->slot[k];
            const double *before = x + ROWS * envelope->first[k];
            const ptrdiff_t columns = ROWS * (k - envelope->first[k]);
            double *own = x + ROWS * k;
            for (ptrdiff_t p = 0; p < columns; ++p)
                subtract_multiple(before[p], panel + ROWS * p, own);
            for (ptrdiff_t j = 0; j < ROWS; ++j) {
                const double *column = panel + ROWS * (columns + j);
                const double value = own[j] / column[j];
                subtract_multiple(value, column, own);
                own[j] = value;
            }
        }
        for (ptrdiff_t k = envelope->n - 1; k >= 0; --k) {
            const double *panel = S + BLOCK * envelope->slot[k];
            double *before = x + ROWS * envelope->first[k], *own = x + ROWS * k;
            const ptrdiff_t columns = ROWS * (k - envelope->first[k]);
            for (ptrdiff_t j = ROWS - 1; j >= 0; --j) {
                const double *column = panel + ROWS * (columns + j);
                double rest = own[j];
                for (ptrdiff_t r = j + 1; r < ROWS; ++r)
                    rest -= column[r] * own[r];
                own[j] = rest / column[j];
            }
            for (ptrdiff_t p = 0; p < columns; ++p) {
                double sum = 0.0;
                for (int r = 0; r < ROWS; ++r)
                    sum += panel[ROWS * p + r] * own[r];
                before[p] -= sum;
            }
        }
    }
}

/* together[i n + k] = 1 where views i and k share a point. */
void eg_bundle_neighbours(const eg_bundle *bundle, unsigned char *together)
{
    for (ptrdiff_t c = 0; c < bundle->n_chunks; ++c) {
        const ptrdiff_t lane = bundle->lanes[c], row = bundle->rows[c];
        const ptrdiff_t M = bundle->lanes[c + 1] - lane;
        for (ptrdiff_t j = 0; j < M; ++j)
            for (ptrdiff_t t = 0; t < bundle->count[lane + j]; ++t)
                for (ptrdiff_t s = 0; s <= t; ++s) {
                    const ptrdiff_t i = bundle->view[row + s * M + j];
                    const ptrdiff_t k = bundle->view[row + t * M + j];
                    together[i * bundle->n_views + k] = together[k * bundle->n_views + i] = 1;
                }
    }
}
