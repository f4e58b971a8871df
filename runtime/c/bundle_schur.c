/* The coupling of cameras and points: Schur complement, products. */
#include "bundle_group.h"
#include "bundle_points.h"

/* Identity matrices, or those of the lanes' points, observation-last. */
static void gather_roots(const eg_chunk *chunk, ptrdiff_t b, const double *T,
                         double *EG_RESTRICT out)
{
    if (T) {
        eg_gather(chunk->M, b * b, T, chunk->point, out);
        return;
    }
    for (ptrdiff_t k = 0; k < b * b; ++k)
        for (ptrdiff_t j = 0; j < chunk->M; ++j)
            out[k * chunk->M + j] = k % (b + 1) ? 0.0 : 1.0;
}

/* Add to the pairs of cameras what eliminating the points takes off them, W T T^T W^T; pairs outside
   the envelope are left out. Add W T half to the cameras. */
int eg_bundle_schur(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *cameras,
    const double *points, const double *T, const double *half, const eg_envelope *envelope,
    double *pairs, double *reduced)
{
    const eg_route route = eg_route_of(bundle);
    const ptrdiff_t b = route.point, n = bundle->n_views, K = route.tangent, wide = route.padded;
    eg_pass p;
    eg_group group;
    double *own = calloc((size_t)(n * wide), sizeof *own);
    int failed = !own || eg_group_begin(&group, bundle, &route, begin, end);
    if (failed || eg_pass_begin(&p, bundle, &route, begin, end, b + b * b, route.factors)) {
        if (!failed)
            eg_release(group.turned);
        free(own);
        return 1;
    }
    for (ptrdiff_t c = begin, last; c < end; c = last) {
        eg_group_clear(&group);
        for (last = eg_group_end(bundle, c, end, route.turned); c < last; ++c) {
            eg_pass_chunk(&p, c, points);
            double *v = p.extra, *roots = v + b * p.chunk.M;
            gather_roots(&p.chunk, b, T, roots);
            if (half)
                eg_gather(p.chunk.M, b, half, p.chunk.point, v);
            route.turn(&p, cameras, roots, half ? v : 0, envelope, &group, pairs, own);
        }
        route.pairs(&route, envelope, &group, pairs);
    }
    for (ptrdiff_t i = 0; i < n; ++i)
        for (ptrdiff_t k = 0; k < K; ++k)
            reduced[K * i + k] += own[wide * i + k];
    free(own);
    eg_release(group.turned);
    eg_release(p.memory);
    return 0;
}

/* v = y + T^T W^T x, with y = 0 or x = 0 where NULL; moved = v and reduced += W T v unless NULL.
   T is the identity where NULL. */
int eg_bundle_couple(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *cameras,
    const double *points, const double *T, const double *x, const double *y, double *moved,
    double *reduced)
{
    const eg_route route = eg_route_of(bundle);
    const ptrdiff_t b = route.point, a = route.tangent;
    eg_pass p;
    if (eg_pass_begin(&p, bundle, &route, begin, end, a + b + b * b, 0))
        return 1;
    for (ptrdiff_t c = begin; c < end; ++c) {
        eg_pass_chunk(&p, c, points);
        const ptrdiff_t M = p.chunk.M;
        double *v = p.extra, *roots = v + b * M, *gathered = roots + b * b * M;
        gather_roots(&p.chunk, b, T, roots);
        if (route.factored)
            eg_moments(M, p.points, p.moments);
        if (y)
            eg_gather(M, b, y, p.chunk.point, v);
        else
            memset(v, 0, (size_t)(b * M) * sizeof(double));
        for (ptrdiff_t s = 0; x && s < p.chunk.L; ++s) {
            eg_pass_slot(&p, s, cameras);
            eg_gather(M, a, x, p.view, gathered);
            route.to_points(&p, roots, gathered, v);
        }
        if (moved)
            eg_scatter(&p.chunk, b, v, moved);
        for (ptrdiff_t s = 0; reduced && s < p.chunk.L; ++s) {
            eg_pass_slot(&p, s, cameras);
            route.to_cameras(&p, roots, v, reduced);
        }
    }
    eg_release(p.memory);
    return 0;
}
