/* Costs, normal equations and triangulation, chunk by chunk. */
#include "bundle_chunk.h"

/* Copy observations into the order of chunks. Lanes, rows, points and counts are filled in. */
void eg_bundle_pack(
    eg_bundle *bundle, const ptrdiff_t *first, const ptrdiff_t *view, const double *q,
    const double *weights, int32_t *packed_view, double *packed_q, double *packed_weights)
{
    const ptrdiff_t total = first[bundle->n_points];
    for (ptrdiff_t c = 0; c < bundle->n_chunks; ++c) {
        const ptrdiff_t lane = bundle->lanes[c], row = bundle->rows[c];
        const ptrdiff_t M = bundle->lanes[c + 1] - lane, L = (bundle->rows[c + 1] - row) / M;
        for (ptrdiff_t s = 0; s < L; ++s) {
            for (ptrdiff_t j = 0; j < M; ++j) {
                const int filled = s < bundle->count[lane + j];
                const ptrdiff_t from = first[bundle->point[lane + j]] + (filled ? s : 0);
                const ptrdiff_t to = row + s * M + j;
                packed_view[to] = (int32_t)view[from];
                packed_q[2 * (row + s * M) + j] = q[from];
                packed_q[2 * (row + s * M) + M + j] = q[total + from];
                packed_weights[to] = filled ? weights[from] : 0.0;
            }
        }
    }
}

/* Cost of each point: the weighted robust sum of its squared residuals. */
int eg_bundle_costs(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *P, const double *Q,
    double *costs)
{
    double *scratch = eg_scratch(bundle, begin, end, 12 + 4 + 1 + 3 + 1 + 1, 0);
    if (!scratch)
        return 1;
    for (ptrdiff_t c = begin; c < end; ++c) {
        const eg_chunk chunk = eg_chunk_of(bundle, c);
        const ptrdiff_t M = chunk.M;
        double *points = scratch, *cameras = points + 4 * M, *squared = cameras + 12 * M;
        double *work = squared + M, *w = work + 3 * M, *sums = w + M;
        eg_gather(M, 4, Q, chunk.point, points);
        memset(sums, 0, (size_t)M * sizeof(double));
        ptrdiff_t filled = M;
        for (ptrdiff_t s = 0; s < chunk.L; ++s) {
            filled = eg_filled(&chunk, s, filled);
            eg_gather(M, 12, P, chunk.view + s * M, cameras);
            eg_squared_distance(M, cameras, points, chunk.q + 2 * s * M, squared);
            eg_weigh(bundle, M, filled, chunk.weights + s * M, squared, work, w);
            eg_charge(bundle, M, chunk.weights + s * M, squared, work, sums);
        }
        eg_scatter(&chunk, 1, sums, costs);
    }
    eg_release(scratch);
    return 0;
}

/* Symmetric 4x4 matrices from their upper triangles, observation-last, into rows of 16. */
static void unpack_symmetric(const eg_chunk *chunk, const double *EG_RESTRICT in, double *rows)
{
    static const int entry[16] = {0, 1, 2, 3, 1, 4, 5, 6, 2, 5, 7, 8, 3, 6, 8, 9};
    for (ptrdiff_t j = 0; j < chunk->M; ++j) {
        if (!chunk->count[j])
            continue;
        double *row = rows + 16 * chunk->point[j];
        for (int k = 0; k < 16; ++k)
            row[k] = in[entry[k] * chunk->M + j];
    }
}

/* Blocks of J^T J and gradient of points, depth blocks of points; camera sums, see EG_CAMERA: for
   A (six rows) and depth the moments Q Q^T, then e Q^T. Cameras are added to. */
int eg_bundle_linearize(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *P, const double *Q,
    double *V, double *D, double *g, double *cameras)
{
    double *scratch = eg_scratch(bundle, begin, end, 4 + 12 + 16 + 25 + 25 + 5 + 10, 0);
    if (!scratch)
        return 1;
    for (ptrdiff_t c = begin; c < end; ++c) {
        const eg_chunk chunk = eg_chunk_of(bundle, c);
        const ptrdiff_t M = chunk.M;
        double *points = scratch, *seen_by = points + 4 * M, *moments = seen_by + 12 * M;
        double *sums = moments + 16 * M, *own = sums + 25 * M;
        double *work = own + 25 * M, *w = work + 3 * M, *squared = w + M, *factors = squared + M;
        eg_gather(M, 4, Q, chunk.point, points);
        eg_moments(M, points, moments);
        memset(sums, 0, 25 * (size_t)M * sizeof(double));
        ptrdiff_t filled = M;
        for (ptrdiff_t s = 0; s < chunk.L; ++s) {
            const double *q = chunk.q + 2 * s * M;
            const int32_t *view = chunk.view + s * M;
            filled = eg_filled(&chunk, s, filled);
            eg_gather(M, 12, P, view, seen_by);
            eg_weigh_at(bundle, M, filled, seen_by, points, q, chunk.weights + s * M, squared, work,
                        w);
            eg_point_normal(M, seen_by, points, q, w, own, own + 10 * M, own + 20 * M,
                            own + 24 * M);
            eg_add(25 * M, own, sums);
            eg_camera_normal(M, seen_by, points, q, w, factors, factors + 6 * M, factors + 7 * M);
            for (ptrdiff_t j = 0, next; j < filled; j = next) {
                next = eg_run(view, j, filled);
                const double *moment = moments + 16 * j, *factor = factors + j;
                double *sum = cameras + EG_CAMERA * view[j], *low = sum + 7 * 8;
                eg_accumulate(next - j, factor, M, moment, sum, low);
                eg_accumulate(next - j, factor + 3 * M, M, moment, sum + 3 * 8, low + 3 * 4);
                eg_accumulate_one(next - j, factor + 6 * M, moment, sum + 6 * 8, low + 6 * 4);
                eg_accumulate_points(next - j, factor + 7 * M, M, moment, sum + 7 * EG_MOMENTS);
            }
        }
        unpack_symmetric(&chunk, sums, V);
        unpack_symmetric(&chunk, sums + 10 * M, D);
        eg_scatter(&chunk, 4, sums + 20 * M, g);
    }
    eg_release(scratch);
    return 0;
}

/* Normal equations and costs of the points of a chunk, cameras gathered: 24 sums a lane and costs. */
static void normal(const eg_bundle *b, const eg_chunk *chunk, const double *cameras,
                   const double *points, double *scratch, double *sums, double *costs)
{
    const ptrdiff_t M = chunk->M;
    double *own = scratch, *work = own + 25 * M, *w = work + 3 * M;
    double *squared = own + 24 * M;
    ptrdiff_t filled = M;
    memset(sums, 0, 24 * (size_t)M * sizeof(double));
    memset(costs, 0, (size_t)M * sizeof(double));
    for (ptrdiff_t s = 0; s < chunk->L; ++s) {
        const double *P = cameras + 12 * s * M, *q = chunk->q + 2 * s * M;
        const double *weights = chunk->weights + s * M;
        filled = eg_filled(chunk, s, filled);
        eg_weigh_at(b, M, filled, P, points, q, weights, squared, work, w);
        eg_point_normal(M, P, points, q, w, own, own + 10 * M, own + 20 * M, squared);
        eg_add(24 * M, own, sums);
        eg_charge(b, M, weights, squared, work, costs);
    }
}

/* Move each point by a few damped Gauss-Newton iterations of its own; return its cost.

   Before each iteration a point is done where its step promises a decrease of at most
   `tolerance` times its cost. lambda begins at `lam`, and is divided or multiplied by `factor`. */
int eg_bundle_triangulate(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *P, double *Q,
    double *costs, ptrdiff_t iterations, double lam, double factor, double tolerance)
{
    double *scratch = eg_scratch(bundle, begin, end, 8 + 50 + 29 + 4, 12);
    if (!scratch)
        return 1;
    for (ptrdiff_t c = begin; c < end; ++c) {
        const eg_chunk chunk = eg_chunk_of(bundle, c);
        const ptrdiff_t M = chunk.M;
        double *cameras = scratch, *points = cameras + 12 * M * chunk.L, *trial = points + 4 * M;
        double *sums = trial + 4 * M, *cost = sums + 24 * M;
        double *sums_trial = cost + M, *cost_trial = sums_trial + 24 * M;
        double *lams = cost_trial + M, *promised = lams + M, *better = promised + M;
        double *work = better + M;
        eg_gather(M, 4, Q, chunk.point, points);
        for (ptrdiff_t s = 0; s < chunk.L; ++s)
            eg_gather(M, 12, P, chunk.view + s * M, cameras + 12 * s * M);
        normal(bundle, &chunk, cameras, points, work, sums, cost);
        for (ptrdiff_t j = 0; j < M; ++j)
            lams[j] = lam;
        for (ptrdiff_t pass = 0; pass < iterations; ++pass) {
            int any = 0;
            eg_point_step(M, sums, sums + 10 * M, sums + 20 * M, lams, trial, promised);
            for (ptrdiff_t j = 0; j < M; ++j)
                any |= promised[j] > tolerance * cost[j];
            if (!any)
                break;
            eg_add(4 * M, points, trial);
            normal(bundle, &chunk, cameras, trial, work, sums_trial, cost_trial);
            EG_SIMD
            for (ptrdiff_t j = 0; j < M; ++j)
                better[j] = promised[j] > tolerance * cost[j] && cost_trial[j] < cost[j] ? 1.0 : 0.0;
            EG_SIMD
            for (ptrdiff_t j = 0; j < M; ++j) {
                cost[j] = better[j] > 0.0 ? cost_trial[j] : cost[j];
                lams[j] = better[j] > 0.0 ? lams[j] / factor : lams[j] * factor;
            }
            for (ptrdiff_t k = 0; k < 24; ++k) {
                EG_SIMD
                for (ptrdiff_t j = 0; j < M; ++j)
                    sums[k * M + j] = better[j] > 0.0 ? sums_trial[k * M + j] : sums[k * M + j];
            }
            for (ptrdiff_t k = 0; k < 4; ++k) {
                EG_SIMD
                for (ptrdiff_t j = 0; j < M; ++j)
                    points[k * M + j] = better[j] > 0.0 ? trial[k * M + j] : points[k * M + j];
            }
        }
        eg_scatter(&chunk, 4, points, Q);
        eg_scatter(&chunk, 1, cost, costs);
    }
    eg_release(scratch);
    return 0;
}
