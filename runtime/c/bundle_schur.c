/* The coupling of cameras and points: Schur complement, products, back-substitution. */
#include "bundle_chunk.h"

#define BATCH 64

static const int upper_row[10] = {0, 1, 2, 3, 5, 6, 7, 10, 11, 15};

/* T with T T^T = (V + lam W)^-1, or V^-1 where W is NULL; half = T^T g unless g is NULL. Rows of 16
   and 4. Returns 1 where a block is not positive definite. */
int eg_bundle_inverse_roots(
    ptrdiff_t m, const double *V, const double *W, double lam, const double *g, double *T,
    double *half)
{
    double packed_V[10 * BATCH], packed_W[10 * BATCH], root[16 * BATCH];
    int bad = 0;
    for (ptrdiff_t begin = 0; begin < m; begin += BATCH) {
        const ptrdiff_t n = m - begin < BATCH ? m - begin : BATCH;
        for (ptrdiff_t j = 0; j < n; ++j)
            for (int k = 0; k < 10; ++k)
                packed_V[k * n + j] = V[16 * (begin + j) + upper_row[k]];
        if (W) {
            for (ptrdiff_t j = 0; j < n; ++j)
                for (int k = 0; k < 10; ++k)
                    packed_W[k * n + j] = W[16 * (begin + j) + upper_row[k]];
            eg_damped_inverse_root(n, packed_V, packed_W, &lam, root);
        } else {
            eg_inverse_root(n, packed_V, root);
        }
        for (ptrdiff_t j = 0; j < n; ++j) {
            double *row = T + 16 * (begin + j);
            double sum = 0.0;
            for (int k = 0; k < 16; ++k) {
                row[k] = root[k * n + j];
                sum += row[k];
            }
            bad |= !(sum - sum == 0.0);
            if (!g)
                continue;
            for (int k = 0; k < 4; ++k) {
                double value = 0.0;
                for (int l = 0; l < 4; ++l)
                    value += row[4 * l + k] * g[4 * (begin + j) + l];
                half[4 * (begin + j) + k] = value;
            }
        }
    }
    return bad;
}

/* Identity matrices, or those of the lanes' points, observation-last. */
static void gather_roots(const eg_chunk *chunk, const double *T, double *EG_RESTRICT out)
{
    if (T) {
        eg_gather(chunk->M, 16, T, chunk->point, out);
        return;
    }
    for (ptrdiff_t k = 0; k < 16; ++k)
        for (ptrdiff_t j = 0; j < chunk->M; ++j)
            out[k * chunk->M + j] = k % 5 ? 0.0 : 1.0;
}

/* cameras += (Y v) x Q for the observations of a slot. */
static void add_to_cameras(const eg_chunk *chunk, ptrdiff_t filled, const int32_t *view,
                           const double *Y, const double *moments, const double *v,
                           double *EG_RESTRICT y, double *cameras)
{
    const ptrdiff_t M = chunk->M;
    for (int a = 0; a < 3; ++a) {
        EG_SIMD
        for (ptrdiff_t j = 0; j < M; ++j)
            y[a * M + j] = Y[(4 * a) * M + j] * v[j] + Y[(4 * a + 1) * M + j] * v[M + j]
                           + Y[(4 * a + 2) * M + j] * v[2 * M + j]
                           + Y[(4 * a + 3) * M + j] * v[3 * M + j];
    }
    for (ptrdiff_t j = 0, end; j < filled; j = end) {
        end = eg_run(view, j, filled);
        eg_accumulate_points(end - j, y + j, M, moments + 16 * j, cameras + 12 * view[j]);
    }
}

/* Y of all slots of a chunk: w a^T a P T. `scratch` has 12 + 5 M entries. */
static void couplings(const eg_bundle *bundle, const eg_chunk *chunk, const double *P,
                      const double *points, const double *roots, double *scratch, double *Y)
{
    const ptrdiff_t M = chunk->M;
    double *cameras = scratch, *work = cameras + 12 * M, *w = work + 3 * M, *squared = w + M;
    ptrdiff_t filled = M;
    for (ptrdiff_t s = 0; s < chunk->L; ++s) {
        filled = eg_filled(chunk, s, filled);
        eg_gather(M, 12, P, chunk->view + s * M, cameras);
        eg_weigh_at(bundle, M, filled, cameras, points, chunk->q + 2 * s * M,
                    chunk->weights + s * M, squared, work, w);
        eg_coupling(M, cameras, points, w, roots, Y + 12 * s * M);
    }
}

/* Add to the pairs of cameras what eliminating the points takes off them, W T T^T W^T: nine rows of
   the moments Q Q^T a pair, row (a, b) for row a of the view with the lower number. Pairs outside
   the envelope are left out. Add W T half to the cameras, rows of 12. */
int eg_bundle_schur(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *P, const double *Q,
    const double *T, const double *half, const eg_envelope *envelope, double *pairs,
    double *cameras)
{
    double *scratch = eg_scratch(bundle, begin, end, 4 + 4 + 16 + 16 + 17 + 9, 25);
    ptrdiff_t *views = malloc(((size_t)bundle->n_views + 1) * sizeof *views);
    if (!scratch || !views) {
        if (scratch)
            eg_release(scratch);
        free(views);
        return 1;
    }
    for (ptrdiff_t c = begin; c < end; ++c) {
        const eg_chunk chunk = eg_chunk_of(bundle, c);
        const ptrdiff_t M = chunk.M;
        double *points = scratch, *v = points + 4 * M, *moments = v + 4 * M;
        double *roots = moments + 16 * M, *work = roots + 16 * M, *X = work + 17 * M;
        double *Y = X + 9 * M, *turned = Y + 12 * M * chunk.L;
        int32_t *sorted = (int32_t *)(turned + 12 * M * chunk.L);
        eg_gather(M, 4, Q, chunk.point, points);
        gather_roots(&chunk, T, roots);
        eg_moments(M, points, moments);
        couplings(bundle, &chunk, P, points, roots, work, Y);
        ptrdiff_t filled = M;
        if (half)
            eg_gather(M, 4, half, chunk.point, v);
        for (ptrdiff_t s = 0; half && s < chunk.L; ++s) {
            filled = eg_filled(&chunk, s, filled);
            add_to_cameras(&chunk, filled, chunk.view + s * M, Y + 12 * s * M, moments, v, X,
                           cameras);
        }
        eg_add_to_pairs(&chunk, envelope, Y, moments, X, turned, views, sorted, pairs);
    }
    free(views);
    eg_release(scratch);
    return 0;
}

/* v = y + T^T W^T x, with y = 0 or x = 0 where NULL; points = v and cameras += W T v unless NULL.
   T is the identity where NULL. */
int eg_bundle_couple(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *P, const double *Q,
    const double *T, const double *x, const double *y, double *points, double *cameras)
{
    double *scratch = eg_scratch(bundle, begin, end, 4 + 4 + 16 + 16 + 17 + 3, 12);
    if (!scratch)
        return 1;
    for (ptrdiff_t c = begin; c < end; ++c) {
        const eg_chunk chunk = eg_chunk_of(bundle, c);
        const ptrdiff_t M = chunk.M;
        double *Q_lanes = scratch, *v = Q_lanes + 4 * M, *roots = v + 4 * M;
        double *work = roots + 16 * M, *moved = work + 17 * M;
        double *moments = moved + 3 * M, *Y = moments + 16 * M;
        eg_gather(M, 4, Q, chunk.point, Q_lanes);
        gather_roots(&chunk, T, roots);
        couplings(bundle, &chunk, P, Q_lanes, roots, work, Y);
        if (y)
            eg_gather(M, 4, y, chunk.point, v);
        else
            memset(v, 0, 4 * (size_t)M * sizeof(double));
        for (ptrdiff_t s = 0; x && s < chunk.L; ++s) {
            const double *Ys = Y + 12 * s * M;
            eg_gather(M, 12, x, chunk.view + s * M, work);
            for (int a = 0; a < 3; ++a) {
                EG_SIMD
                for (ptrdiff_t j = 0; j < M; ++j)
                    moved[a * M + j] = work[(4 * a) * M + j] * Q_lanes[j]
                                       + work[(4 * a + 1) * M + j] * Q_lanes[M + j]
                                       + work[(4 * a + 2) * M + j] * Q_lanes[2 * M + j]
                                       + work[(4 * a + 3) * M + j] * Q_lanes[3 * M + j];
            }
            for (int k = 0; k < 4; ++k) {
                EG_SIMD
                for (ptrdiff_t j = 0; j < M; ++j)
                    v[k * M + j] += Ys[k * M + j] * moved[j] + Ys[(4 + k) * M + j] * moved[M + j]
                                    + Ys[(8 + k) * M + j] * moved[2 * M + j];
            }
        }
        if (points)
            eg_scatter(&chunk, 4, v, points);
        ptrdiff_t filled = M;
        if (cameras)
            eg_moments(M, Q_lanes, moments);
        for (ptrdiff_t s = 0; cameras && s < chunk.L; ++s) {
            filled = eg_filled(&chunk, s, filled);
            add_to_cameras(&chunk, filled, chunk.view + s * M, Y + 12 * s * M, moments, v, moved,
                           cameras);
        }
    }
    eg_release(scratch);
    return 0;
}

/* step = -T (half + coupled) for each point; returns the sum of step^T W step, 0 where W is NULL. */
double eg_bundle_point_steps(
    ptrdiff_t m, const double *T, const double *half, const double *coupled, const double *W,
    double *step)
{
    double energy = 0.0;
    for (ptrdiff_t j = 0; j < m; ++j) {
        const double *root = T + 16 * j;
        double *own = step + 4 * j, v[4];
        for (int k = 0; k < 4; ++k)
            v[k] = half[4 * j + k] + coupled[4 * j + k];
        for (int i = 0; i < 4; ++i)
            own[i] = -(root[4 * i] * v[0] + root[4 * i + 1] * v[1] + root[4 * i + 2] * v[2]
                       + root[4 * i + 3] * v[3]);
        for (int i = 0; W && i < 4; ++i)
            for (int k = 0; k < 4; ++k)
                energy += own[i] * W[16 * j + 4 * i + k] * own[k];
    }
    return energy;
}
