/* The blocks of the cameras' reduced system, from sums; whitening of projective cameras. */
#include <string.h>

#include "bundle_chunk.h"
#include "panels.h"

/* Place of entry (k, l) of Q Q^T among its ten distinct ones, and of (a, b) among six of 3x3. */
static const int moment_of[4][4] = {{0, 1, 2, 3}, {1, 4, 5, 6}, {2, 5, 7, 8}, {3, 6, 8, 9}};
static const int upper_of[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};

/* Blocks of J^T J and of the depths (n, 12, 12), gradient (n, 12) from the sums of cameras. */
static void factored_blocks(ptrdiff_t n, const double *cameras, double *U, double *D, double *g)
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

/* Blocks U of J^T J (n, a, a), gradient g (n, a), and in the factored route blocks D of the depths,
   from the sums of cameras. */
void eg_bundle_camera_blocks(
    const eg_bundle *bundle, const double *cameras, double *U, double *D, double *g)
{
    const eg_route route = eg_route_of(bundle);
    const ptrdiff_t a = route.tangent;
    if (route.factored) {
        factored_blocks(bundle->n_views, cameras, U, D, g);
        return;
    }
    for (ptrdiff_t i = 0; i < bundle->n_views; ++i) {
        const double *sum = cameras + route.camera_sums * i;
        for (ptrdiff_t k = 0; k < a; ++k)
            for (ptrdiff_t l = k; l < a; ++l)
                U[a * (a * i + k) + l] = U[a * (a * i + l) + k] = sum[route.padded * k + l];
        memcpy(g + a * i, sum + route.padded * a, (size_t)a * sizeof(double));
    }
}

/* Blocks (l, a, a) of the sums of l pairs of cameras, rows for the one with the lower number. */
void eg_bundle_pair_blocks(
    const eg_bundle *bundle, ptrdiff_t count, const double *pairs, double *blocks)
{
    const eg_route route = eg_route_of(bundle);
    const ptrdiff_t a = route.tangent;
    for (ptrdiff_t k = 0; k < count; ++k, pairs += route.pair_sums.size, blocks += a * a) {
        for (ptrdiff_t i = 0; !route.factored && i < a; ++i)
            memcpy(blocks + a * i, pairs + route.pair_sums.length * i, (size_t)a * sizeof(double));
        for (int p = 0; route.factored && p < 3; ++p)
            for (int i = 0; i < 4; ++i)
                for (int q = 0; q < 3; ++q)
                    for (int l = 0; l < 4; ++l)
                        blocks[ROWS * (4 * p + i) + 4 * q + l] =
                            pairs[EG_ENTRY(9, 3 * p + q, moment_of[i][l])];
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
