/* The reduced system of the unknowns of all cameras, in panels of twelve rows within a skyline. */
#include <string.h>

#include "panels.h"
#include "skyline.h"

#define GROUP 8

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


/* X (n, a) = M (n, d) A (d, a), or M^T A for M (d, n). */
static void times(ptrdiff_t n, ptrdiff_t d, ptrdiff_t a, int turned, const double *M,
                  const double *EG_RESTRICT A, double *EG_RESTRICT X)
{
    memset(X, 0, (size_t)(n * a) * sizeof(double));
    for (ptrdiff_t i = 0; i < n; ++i)
        for (ptrdiff_t l = 0; l < d; ++l) {
            const double value = turned ? M[n * l + i] : M[d * i + l];
            EG_SIMD
            for (ptrdiff_t k = 0; k < a; ++k)
                X[a * i + k] += value * A[a * l + k];
        }
}

/* The same twice for blocks as large as a panel: X = left^T X right. */
static void between(const double *left, const double *right, double *X)
{
    double turned[BLOCK], half[BLOCK] = {0.0};
    for (int i = 0; i < ROWS; ++i)
        for (int k = 0; k < ROWS; ++k)
            turned[ROWS * k + i] = X[ROWS * i + k];
    subtract_some(ROWS, right, turned, half); /* -X right, row by row */
    memset(X, 0, sizeof half);
    subtract_some(ROWS, half, left, X);
}

/* Whether all matrices (a, a) are diagonal. */
static int diagonal(ptrdiff_t count, ptrdiff_t a, const double *A)
{
    for (ptrdiff_t i = 0; i < count; ++i)
        for (ptrdiff_t k = 0; k < a * a; ++k)
            if (A[a * a * i + k] != 0.0 && k % (a + 1))
                return 0;
    return 1;
}

/* S = U - A^T P A in panels, for the pairs P of views, U (n, a, a) and A (n, d, a), NULL for I. Rows of
   blocks are own tangents of the view with the lower number. Ones fill up the last panel. */
void eg_skyline_reduce(
    const eg_envelope *views, const eg_envelope *panels, const eg_blocks *how, ptrdiff_t a,
    const double *blocks, const double *U, const double *A, double *S)
{
    double half[EG_MOST_TANGENT * EG_MOST_TANGENT], X[EG_MOST_TANGENT * EG_MOST_TANGENT];
    const ptrdiff_t d = how->d;
    const int scaled = A && a == d && diagonal(views->n, a, A);
    memset(S, 0, (size_t)(BLOCK * panels->slot[panels->n]) * sizeof(double));
    for (ptrdiff_t t = 0; t < views->n; ++t)
        for (ptrdiff_t s = views->first[t]; s <= t; ++s, blocks += how->size) {
            const double *left = A + d * a * s, *right = A + d * a * t;
            for (ptrdiff_t i = 0; i < d; ++i)
                for (ptrdiff_t k = 0; k < d; ++k)
                    X[d * i + k] = blocks[how->length * i + k];
            for (ptrdiff_t i = 0; scaled && i < d; ++i)
                for (ptrdiff_t k = 0; k < d; ++k)
                    X[d * i + k] *= left[(a + 1) * i] * right[(a + 1) * k];
            if (A && !scaled && a == ROWS && d == ROWS) {
                between(left, right, X);
            } else if (A && !scaled) {
                times(d, d, a, 0, X, right, half);
                times(a, d, a, 1, left, half, X);
            }
            for (ptrdiff_t k = 0; k < a; ++k) {
                /* Entry (r, c) of the lower triangle is at 12 c of its row. */
                const ptrdiff_t r = a * t + k, panel = r / ROWS;
                double *to = S + BLOCK * (panels->slot[panel] - panels->first[panel])
                             + r - ROWS * panel + ROWS * a * s;
                for (ptrdiff_t i = 0; i < (s == t ? k + 1 : a); ++i)
                    to[ROWS * i] = (s == t ? U[a * (a * t + k) + i] : 0.0) - X[a * i + k];
            }
        }
    for (ptrdiff_t r = a * views->n; r < ROWS * panels->n; ++r) {
        const ptrdiff_t panel = r / ROWS;
        S[BLOCK * (panels->slot[panel] - panels->first[panel]) + r - ROWS * panel + ROWS * r] = 1.0;
    }
}
