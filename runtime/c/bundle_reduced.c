/* The reduced system of the cameras: blocks, whitening, Cholesky factor within an envelope. */
#include <math.h>
#include <string.h>

#include "bundle.h"

#define B 12

/* Place of entry (k, l) of Q Q^T among its ten distinct ones, and of (a, b) among six of 3x3. */
static const int moment_of[4][4] = {{0, 1, 2, 3}, {1, 4, 5, 6}, {2, 5, 7, 8}, {3, 6, 8, 9}};
static const int upper_of[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};

/* Blocks of J^T J and of the depths (n, 12, 12), gradient (n, 12) from the sums of cameras. */
void eg_bundle_camera_blocks(
    ptrdiff_t n, const double *cameras, double *U, double *D, double *g)
{
    memset(D, 0, (size_t)(n * B * B) * sizeof(double));
    for (ptrdiff_t i = 0; i < n; ++i) {
        const double *sum = cameras + EG_CAMERA * i;
        for (int a = 0; a < 3; ++a)
            for (int k = 0; k < 4; ++k)
                for (int b = 0; b < 3; ++b)
                    for (int l = 0; l < 4; ++l)
                        U[(i * B + 4 * a + k) * B + 4 * b + l] =
                            sum[EG_SUM(7, upper_of[a][b], moment_of[k][l])];
        for (int k = 0; k < 4; ++k)
            for (int l = 0; l < 4; ++l)
                D[(i * B + 8 + k) * B + 8 + l] = sum[EG_SUM(7, 6, moment_of[k][l])];
        memcpy(g + B * i, sum + 7 * EG_MOMENTS, B * sizeof(double));
    }
}

/* L of A = L L^T in place of the lower triangle, rows `stride` apart. Returns 1 where A is not
   positive definite. */
static int factor_block(ptrdiff_t a, ptrdiff_t stride, double *A)
{
    for (ptrdiff_t j = 0; j < a; ++j) {
        for (ptrdiff_t i = j; i < a; ++i) {
            double rest = A[i * stride + j];
            for (ptrdiff_t k = 0; k < j; ++k)
                rest -= A[i * stride + k] * A[j * stride + k];
            if (i > j)
                A[i * stride + j] = rest / A[j * stride + j];
            else if (rest > 0.0 && rest < INFINITY)
                A[j * stride + j] = sqrt(rest);
            else
                return 1;
        }
    }
    return 0;
}

/* Inverse, transposed, of a lower triangular matrix (12, 12). */
static void invert_transposed(const double *L, double *T)
{
    memset(T, 0, B * B * sizeof(double));
    for (int j = 0; j < B; ++j) {
        T[B * j + j] = 1.0 / L[B * j + j];
        for (int i = j + 1; i < B; ++i) {
            double sum = 0.0;
            for (int k = j; k < i; ++k)
                sum += L[B * i + k] * T[B * j + k];
            T[B * j + i] = -sum / L[B * i + i];
        }
    }
}

/* C (p, r) = A^T (p, q) B (q, r), rows of A p long. */
static inline void transposed_product(ptrdiff_t p, ptrdiff_t q, ptrdiff_t r,
                                      const double *EG_RESTRICT A, const double *EG_RESTRICT X,
                                      double *EG_RESTRICT C)
{
    for (ptrdiff_t i = 0; i < p; ++i) {
        double *EG_RESTRICT row = C + r * i;
        for (ptrdiff_t l = 0; l < r; ++l)
            row[l] = 0.0;
        for (ptrdiff_t k = 0; k < q; ++k) {
            const double factor = A[p * k + i];
            for (ptrdiff_t l = 0; l < r; ++l)
                row[l] += factor * X[r * k + l];
        }
    }
}

/* C (p, r) = A (p, q) X (q, r). */
static inline void product(ptrdiff_t p, ptrdiff_t q, ptrdiff_t r, const double *EG_RESTRICT A,
                           const double *EG_RESTRICT X, double *EG_RESTRICT C)
{
    for (ptrdiff_t i = 0; i < p; ++i) {
        double *EG_RESTRICT row = C + r * i;
        for (ptrdiff_t l = 0; l < r; ++l)
            row[l] = 0.0;
        for (ptrdiff_t k = 0; k < q; ++k) {
            const double factor = A[q * i + k];
            for (ptrdiff_t l = 0; l < r; ++l)
                row[l] += factor * X[r * k + l];
        }
    }
}

/* A upper triangular with A^T W A = I, and A^T U A + lam I; all (n, 12, 12). Returns 1 where a W is
   not positive definite. */
int eg_bundle_whiten(
    ptrdiff_t n, const double *U, const double *W, double lam, double *A, double *white)
{
    double L[B * B], half[B * B];
    for (ptrdiff_t i = 0; i < n; ++i) {
        double *own = white + B * B * i;
        memcpy(L, W + B * B * i, sizeof L);
        if (factor_block(B, B, L))
            return 1;
        invert_transposed(L, A + B * B * i);
        product(B, B, B, U + B * B * i, A + B * B * i, half);
        transposed_product(B, B, B, A + B * B * i, half, own);
        for (int k = 0; k < B; ++k)
            own[B * k + k] += lam;
    }
    return 0;
}

static inline void reduce(ptrdiff_t a, const eg_envelope *envelope, const double *pairs,
                          const double *U, const double *A, double *S)
{
    double raw[B * B], half[B * B], whole[B * B];
    for (ptrdiff_t row = 0; row < envelope->n; ++row) {
        for (ptrdiff_t column = envelope->first[row]; column <= row; ++column) {
            const double *pair =
                pairs + EG_PAIR * (envelope->slot[row] + column - envelope->first[row]);
            double *to = S + envelope->base[row] + a * (column - envelope->first[row]);
            for (int p = 0; p < 3; ++p)
                for (int k = 0; k < 4; ++k)
                    for (int q = 0; q < 3; ++q)
                        for (int l = 0; l < 4; ++l)
                            raw[B * (4 * p + k) + 4 * q + l] =
                                pair[EG_SUM(9, 3 * q + p, moment_of[k][l])];
            const double *update = raw;
            if (A) {
                product(B, B, a, raw, A + B * a * column, half);
                transposed_product(a, B, a, A + B * a * row, half, whole);
                update = whole;
            }
            const double *own = row == column ? U + a * a * row : 0;
            for (ptrdiff_t k = 0; k < a; ++k)
                for (ptrdiff_t l = 0; l < a; ++l)
                    to[k * envelope->stride[row] + l] = (own ? own[a * k + l] : 0.0) - update[a * k + l];
        }
    }
}

/* S = U - A^T (sums of pairs) A, block by block; U (n, a, a), A (n, 12, a) or NULL for a = 12. */
void eg_bundle_reduce(
    const eg_envelope *envelope, const double *pairs, const double *U, const double *A, double *S)
{
    if (envelope->a == B)
        reduce(B, envelope, pairs, U, A, S);
    else
        reduce(envelope->a, envelope, pairs, U, A, S);
}

/* C (a, a) -= X Y^T for X, Y (a, length), rows apart by their strides. */
static inline void subtract_product(ptrdiff_t a, ptrdiff_t length, const double *X, ptrdiff_t stride_X,
                                    const double *Y, ptrdiff_t stride_Y, double *C,
                                    ptrdiff_t stride_C)
{
    ptrdiff_t i = 0;
    for (; i + 4 <= a; i += 4) {
        ptrdiff_t j = 0;
        for (; j + 3 <= a; j += 3) {
            const double *EG_RESTRICT x0 = X + i * stride_X, *EG_RESTRICT x1 = x0 + stride_X;
            const double *EG_RESTRICT x2 = x1 + stride_X, *EG_RESTRICT x3 = x2 + stride_X;
            const double *EG_RESTRICT y0 = Y + j * stride_Y, *EG_RESTRICT y1 = y0 + stride_Y;
            const double *EG_RESTRICT y2 = y1 + stride_Y;
            double s00 = 0.0, s01 = 0.0, s02 = 0.0, s10 = 0.0, s11 = 0.0, s12 = 0.0;
            double s20 = 0.0, s21 = 0.0, s22 = 0.0, s30 = 0.0, s31 = 0.0, s32 = 0.0;
#ifndef _MSC_VER
#pragma omp simd reduction(+ : s00, s01, s02, s10, s11, s12, s20, s21, s22, s30, s31, s32)
#endif
            for (ptrdiff_t k = 0; k < length; ++k) {
                s00 += x0[k] * y0[k];
                s01 += x0[k] * y1[k];
                s02 += x0[k] * y2[k];
                s10 += x1[k] * y0[k];
                s11 += x1[k] * y1[k];
                s12 += x1[k] * y2[k];
                s20 += x2[k] * y0[k];
                s21 += x2[k] * y1[k];
                s22 += x2[k] * y2[k];
                s30 += x3[k] * y0[k];
                s31 += x3[k] * y1[k];
                s32 += x3[k] * y2[k];
            }
            double *to = C + i * stride_C + j;
            to[0] -= s00, to[1] -= s01, to[2] -= s02, to += stride_C;
            to[0] -= s10, to[1] -= s11, to[2] -= s12, to += stride_C;
            to[0] -= s20, to[1] -= s21, to[2] -= s22, to += stride_C;
            to[0] -= s30, to[1] -= s31, to[2] -= s32;
        }
        for (; j < a; ++j)
            for (ptrdiff_t r = i; r < i + 4; ++r)
                for (ptrdiff_t k = 0; k < length; ++k)
                    C[r * stride_C + j] -= X[r * stride_X + k] * Y[j * stride_Y + k];
    }
    for (; i < a; ++i)
        for (ptrdiff_t j = 0; j < a; ++j)
            for (ptrdiff_t k = 0; k < length; ++k)
                C[i * stride_C + j] -= X[i * stride_X + k] * Y[j * stride_Y + k];
}

/* L of S = L L^T in place of S, block row by block row. Returns 1 where S is not positive definite. */
int eg_envelope_factor(const eg_envelope *envelope, double *S)
{
    const ptrdiff_t a = envelope->a;
    for (ptrdiff_t k = 0; k < envelope->n; ++k) {
        double *row = S + envelope->base[k];
        const ptrdiff_t stride = envelope->stride[k], first = envelope->first[k];
        for (ptrdiff_t i = first; i <= k; ++i) {
            const double *other = S + envelope->base[i];
            const ptrdiff_t other_stride = envelope->stride[i], other_first = envelope->first[i];
            const ptrdiff_t begin = first > other_first ? first : other_first;
            double *block = row + a * (i - first);
            subtract_product(a, a * (i - begin), row + a * (begin - first), stride,
                             other + a * (begin - other_first), other_stride, block, stride);
            const double *L = other + a * (i - other_first);
            if (i == k) {
                if (factor_block(a, stride, block))
                    return 1;
                continue;
            }
            for (ptrdiff_t r = 0; r < a; ++r) {
                double *values = block + r * stride;
                for (ptrdiff_t j = 0; j < a; ++j) {
                    double rest = values[j];
                    for (ptrdiff_t l = 0; l < j; ++l)
                        rest -= values[l] * L[j * other_stride + l];
                    values[j] = rest / L[j * other_stride + j];
                }
            }
        }
    }
    return 0;
}

/* x <- (L L^T)^-1 x for `count` vectors, one after the other. */
void eg_envelope_solve(
    const eg_envelope *envelope, const double *S, ptrdiff_t count, double *x)
{
    const ptrdiff_t a = envelope->a, n = envelope->n;
    for (ptrdiff_t c = 0; c < count; ++c, x += n * a) {
        for (ptrdiff_t k = 0; k < n; ++k) {
            for (ptrdiff_t r = 0; r < a; ++r) {
                const double *EG_RESTRICT row = S + envelope->base[k] + r * envelope->stride[k];
                const double *EG_RESTRICT from = x + a * envelope->first[k];
                const ptrdiff_t length = a * (k - envelope->first[k]) + r;
                double sum = 0.0;
#ifndef _MSC_VER
#pragma omp simd reduction(+ : sum)
#endif
                for (ptrdiff_t l = 0; l < length; ++l)
                    sum += row[l] * from[l];
                x[a * k + r] = (x[a * k + r] - sum) / row[length];
            }
        }
        for (ptrdiff_t k = n - 1; k >= 0; --k) {
            for (ptrdiff_t r = a - 1; r >= 0; --r) {
                const double *EG_RESTRICT row = S + envelope->base[k] + r * envelope->stride[k];
                double *EG_RESTRICT from = x + a * envelope->first[k];
                const ptrdiff_t length = a * (k - envelope->first[k]) + r;
                const double value = x[a * k + r] / row[length];
                x[a * k + r] = value;
                EG_SIMD
                for (ptrdiff_t l = 0; l < length; ++l)
                    from[l] -= value * row[l];
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
