/* The coupling of cameras and points: Schur complement, products. */
#include "bundle_chunk.h"
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

/* Factors of the coupling for all slots of a chunk. */
static void couplings(eg_pass *p, const double *cameras, const double *roots, double *F)
{
    const ptrdiff_t M = p->chunk.M;
    if (p->route->factored)
        eg_moments(M, p->points, p->moments);
    for (ptrdiff_t s = 0; s < p->chunk.L; ++s) {
        eg_pass_slot(p, s, cameras);
        p->route->couple(p, roots, F + p->route->factors * s * M);
    }
}

/* cameras += W T v, over all slots of a chunk. */
static void to_cameras(eg_pass *p, const double *F, const double *v, double *cameras)
{
    for (ptrdiff_t s = 0; s < p->chunk.L; ++s) {
        eg_pass_slot_of(p, s, p->cameras);
        p->route->to_cameras(p, F + p->route->factors * s * p->chunk.M, v, cameras);
    }
}

/* Add to the pairs of cameras what eliminating the points takes off them, W T T^T W^T; pairs outside
   the envelope are left out. Add W T half to the cameras. */
int eg_bundle_schur(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *cameras,
    const double *points, const double *T, const double *half, const eg_envelope *envelope,
    double *pairs, double *reduced)
{
    const eg_route route = eg_route_of(bundle);
    const ptrdiff_t b = route.point;
    eg_pass p;
    ptrdiff_t *views = malloc(((size_t)bundle->n_views + 2) * sizeof *views);
    const ptrdiff_t a_row = route.factors + route.turned + 1;
    if (!views || eg_pass_begin(&p, bundle, &route, begin, end, b + b * b, a_row)) {
        free(views);
        return 1;
    }
    for (ptrdiff_t c = begin; c < end; ++c) {
        eg_pass_chunk(&p, c, points);
        const ptrdiff_t M = p.chunk.M, rows = M * p.chunk.L;
        double *v = p.extra, *roots = v + b * M, *turned = roots + b * b * M;
        double *F = turned + route.turned * rows;
        int32_t *sorted = (int32_t *)(F + route.factors * rows);
        gather_roots(&p.chunk, b, T, roots);
        couplings(&p, cameras, roots, F);
        if (half) {
            eg_gather(M, b, half, p.chunk.point, v);
            to_cameras(&p, F, v, reduced);
        }
        route.pairs(&p, envelope, F, turned, views, sorted, pairs);
    }
    free(views);
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
    if (eg_pass_begin(&p, bundle, &route, begin, end, a + b + b * b, route.factors))
        return 1;
    for (ptrdiff_t c = begin; c < end; ++c) {
        eg_pass_chunk(&p, c, points);
        const ptrdiff_t M = p.chunk.M;
        double *v = p.extra, *roots = v + b * M, *gathered = roots + b * b * M;
        double *F = gathered + a * M;
        gather_roots(&p.chunk, b, T, roots);
        couplings(&p, cameras, roots, F);
        if (y)
            eg_gather(M, b, y, p.chunk.point, v);
        else
            memset(v, 0, (size_t)(b * M) * sizeof(double));
        for (ptrdiff_t s = 0; x && s < p.chunk.L; ++s) {
            eg_gather(M, a, x, p.chunk.view + s * M, gathered);
            eg_pass_slot_of(&p, s, p.cameras);
            route.to_points(&p, F + route.factors * s * M, gathered, v);
        }
        if (moved)
            eg_scatter(&p.chunk, b, v, moved);
        if (reduced)
            to_cameras(&p, F, v, reduced);
    }
    eg_release(p.memory);
    return 0;
}
