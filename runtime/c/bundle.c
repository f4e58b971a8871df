/* Costs, normal equations and refinement of points, chunk by chunk. */
#include "bundle_chunk.h"
#include "bundle_points.h"

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

/* Doubles a camera in the sums of linearize; how those of schur are stored. */
void eg_bundle_widths(const eg_bundle *bundle, ptrdiff_t *camera, eg_blocks *pairs)
{
    const eg_route route = eg_route_of(bundle);
    *camera = route.camera_sums;
    *pairs = route.pair_sums;
}

/* Cost of each point: the weighted robust sum of its squared residuals. */
int eg_bundle_costs(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *cameras,
    const double *points, double *costs)
{
    const eg_route route = eg_route_of(bundle);
    eg_pass p;
    if (eg_pass_begin(&p, bundle, &route, begin, end, 1, 0))
        return 1;
    for (ptrdiff_t c = begin; c < end; ++c) {
        eg_pass_chunk(&p, c, points);
        double *sums = p.extra;
        memset(sums, 0, (size_t)p.chunk.M * sizeof(double));
        for (ptrdiff_t s = 0; s < p.chunk.L; ++s) {
            eg_pass_slot(&p, s, cameras);
            route.squared(&p);
            eg_weigh(&p);
            eg_charge(&p, sums);
        }
        eg_scatter(&p.chunk, 1, sums, costs);
    }
    eg_release(p.memory);
    return 0;
}

/* Blocks of J^T J and gradient of points, depth blocks D of homogeneous points in the factored
   route; sums of cameras, which are added to, are for `eg_bundle_camera_blocks`. */
int eg_bundle_linearize(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *cameras,
    const double *points, double *V, double *D, double *g, double *camera_sums)
{
    const eg_route route = eg_route_of(bundle);
    const ptrdiff_t b = route.point, block = b * (b + 1) / 2;
    eg_pass p;
    if (eg_pass_begin(&p, bundle, &route, begin, end, route.sums + route.kept, 0))
        return 1;
    for (ptrdiff_t c = begin; c < end; ++c) {
        eg_pass_chunk(&p, c, points);
        const ptrdiff_t M = p.chunk.M, size = route.sums * M;
        double *sums = p.extra;
        if (route.factored)
            eg_moments(M, p.points, p.moments);
        memset(sums, 0, (size_t)size * sizeof(double));
        eg_pass_keep(&p, 0, sums + size);
        for (ptrdiff_t s = 0; s < p.chunk.L; ++s) {
            eg_pass_slot(&p, s, cameras);
            route.observe(&p, sums, camera_sums);
        }
        eg_scatter_symmetric(&p.chunk, b, sums, V);
        if (route.factored)
            eg_scatter_symmetric(&p.chunk, b, sums + block * M, D);
        eg_scatter(&p.chunk, b, sums + (route.sums - b) * M, g);
    }
    eg_release(p.memory);
    return 0;
}

/* Normal equations and costs of the points of a chunk at `points`, cameras gathered slot by slot. */
static void normal(eg_pass *p, double *cameras, const double *points, double *sums, double *costs)
{
    const ptrdiff_t M = p->chunk.M, size = p->route->sums * M;
    memset(sums, 0, (size_t)size * sizeof(double));
    memset(costs, 0, (size_t)M * sizeof(double));
    for (ptrdiff_t s = 0; s < p->chunk.L; ++s) {
        eg_pass_slot_of(p, s, cameras + p->route->camera * s * M);
        p->route->sight(p, points, sums);
        eg_charge(p, costs);
    }
}

/* rows of `to` where `better`, from those of `from`. */
static void replace(ptrdiff_t M, ptrdiff_t rows, const double *EG_RESTRICT better,
                    const double *EG_RESTRICT from, double *EG_RESTRICT to)
{
    for (ptrdiff_t k = 0; k < rows; ++k) {
        EG_SIMD
        for (ptrdiff_t j = 0; j < M; ++j)
            to[k * M + j] = better[j] > 0.0 ? from[k * M + j] : to[k * M + j];
    }
}

/* Move each point, but those marked as frozen (unless NULL), by a few damped Gauss-Newton iterations
   of its own; return its cost.

   Before each iteration a point is done where its step promises a decrease of at most
   `tolerance` times its cost. lambda begins at `lam`, and is divided or multiplied by `factor`. */
int eg_bundle_refine_points(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *cameras, double *points,
    double *costs, const unsigned char *frozen, const eg_refinement *how)
{
    const eg_route route = eg_route_of(bundle);
    const ptrdiff_t b = route.point, n = route.sums;
    eg_pass p;
    if (eg_pass_begin(&p, bundle, &route, begin, end, b + 2 * n + 31, route.camera))
        return 1;
    for (ptrdiff_t c = begin; c < end; ++c) {
        eg_pass_chunk(&p, c, points);
        const ptrdiff_t M = p.chunk.M;
        double *trial = p.extra, *sums = trial + b * M, *cost = sums + n * M;
        double *sums_trial = cost + M, *cost_trial = sums_trial + n * M;
        double *lams = cost_trial + M, *promised = lams + M, *better = promised + M;
        double *scratch = better + M, *gathered = scratch + 26 * M;
        for (ptrdiff_t s = 0; s < p.chunk.L; ++s)
            eg_gather(M, route.camera, cameras, p.chunk.view + s * M,
                      gathered + route.camera * s * M);
        normal(&p, gathered, p.points, sums, cost);
        for (ptrdiff_t j = 0; j < M; ++j)
            lams[j] = how->lam;
        for (ptrdiff_t pass = 0; pass < how->iterations; ++pass) {
            int any = 0;
            if (route.factored)
                eg_point_step(M, sums, sums + 10 * M, sums + 20 * M, lams, trial, promised);
            else
                eg_damped_point_step(M, b, (int)how->damping, sums, lams, scratch, trial,
                                     promised);
            for (ptrdiff_t j = 0; j < M; ++j) {
                if (frozen && frozen[p.chunk.point[j]])
                    promised[j] = 0.0;
                any |= promised[j] > how->tolerance * cost[j];
            }
            if (!any)
                break;
            eg_add(b * M, p.points, trial);
            normal(&p, gathered, trial, sums_trial, cost_trial);
            EG_SIMD
            for (ptrdiff_t j = 0; j < M; ++j)
                better[j] = promised[j] > how->tolerance * cost[j] && cost_trial[j] < cost[j]
                                ? 1.0 : 0.0;
            EG_SIMD
            for (ptrdiff_t j = 0; j < M; ++j) {
                cost[j] = better[j] > 0.0 ? cost_trial[j] : cost[j];
                lams[j] = better[j] > 0.0 ? lams[j] / how->factor : lams[j] * how->factor;
            }
            replace(M, n, better, sums_trial, sums);
            replace(M, b, better, trial, p.points);
        }
        eg_scatter(&p.chunk, b, p.points, points);
        eg_scatter(&p.chunk, 1, cost, costs);
    }
    eg_release(p.memory);
    return 0;
}
