/* The coupling of cameras and points: Schur complement, products. */
#include <math.h>

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

/* A pass that eliminates points: its group, and sums W T half in rows of the padded width. */
typedef struct {
    eg_pass pass;
    eg_route route;
    eg_group group;
    double *reduced;
} elimination;

/* The lower triangles of the pairs of a view with itself, of which the direct route sums the upper;
   nothing where there are no pairs (NULL). */
static void mirror(const eg_route *route, const eg_envelope *envelope, double *pairs)
{
    const ptrdiff_t K = route->tangent, length = route->pair_sums.length;
    for (ptrdiff_t i = 0; pairs && !route->factored && i < envelope->n; ++i) {
        double *own = pairs + route->pair_sums.size * (envelope->slot[i + 1] - 1);
        for (ptrdiff_t k = 0; k < K; ++k)
            for (ptrdiff_t l = 0; l < k; ++l)
                own[length * k + l] = own[length * l + k];
    }
}

static void elimination_end(elimination *e, double *reduced)
{
    const ptrdiff_t K = e->route.tangent, wide = e->route.padded;
    for (ptrdiff_t i = 0; reduced && i < e->pass.bundle->n_views; ++i)
        for (ptrdiff_t k = 0; k < K; ++k)
            reduced[K * i + k] += e->reduced[wide * i + k];
    eg_release(e->reduced);
    eg_release(e->group.turned);
    eg_release(e->pass.memory);
}

/* Begin with so many doubles a lane beside roots and half; 1 where there is no memory. */
static int elimination_begin(elimination *e, const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end,
                             ptrdiff_t a_lane)
{
    e->route = eg_route_of(bundle);
    const ptrdiff_t b = e->route.point, size = bundle->n_views * e->route.padded;
    e->reduced = eg_aligned(size);
    const int failed = eg_group_begin(&e->group, bundle, &e->route, begin, end)
                       | eg_pass_begin(&e->pass, bundle, &e->route, begin, end, b + b * b + a_lane,
                                       e->route.kept);
    if (failed || !e->reduced) {
        elimination_end(e, NULL);
        return 1;
    }
    memset(e->reduced, 0, (size_t)size * sizeof(double));
    return 0;
}

/* Add to the pairs of cameras what eliminating the points takes off them, W T T^T W^T; pairs outside
   the envelope are left out. Add W T half to the cameras. */
int eg_bundle_schur(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *cameras,
    const double *points, const double *T, const double *half, const eg_envelope *envelope,
    double *pairs, double *reduced)
{
    elimination e;
    eg_pass *p = &e.pass;
    if (elimination_begin(&e, bundle, begin, end, 0))
        return 1;
    const ptrdiff_t b = e.route.point;
    for (ptrdiff_t c = begin, last; c < end; c = last) {
        eg_group_clear(&e.group);
        last = eg_group_end(bundle, c, end, e.route.turned);
        for (; c < last; ++c) {
            eg_pass_chunk(p, c, points);
            const ptrdiff_t M = p->chunk.M;
            double *v = p->extra, *roots = v + b * M, *kept = roots + b * b * M;
            gather_roots(&p->chunk, b, T, roots);
            if (half)
                eg_gather(M, b, half, p->chunk.point, v);
            if (e.route.factored)
                eg_moments(M, p->points, p->moments);
            for (ptrdiff_t s = 0; s < p->chunk.L; ++s) {
                eg_pass_slot(p, s, cameras);
                eg_pass_keep(p, s, kept);
                e.route.evaluate(p);
            }
            e.route.turn(p, roots, half ? v : 0, kept, envelope, &e.group, pairs, e.reduced);
        }
        e.route.pairs(&e.route, envelope, &e.group, pairs);
    }
    mirror(&e.route, envelope, pairs);
    elimination_end(&e, reduced);
    return 0;
}

/* `eg_bundle_linearize`, `eg_bundle_inverse_roots` and `eg_bundle_schur` in one pass, with a known
   lambda: each observation is evaluated once. Without pairs (NULL) the last of these is left out.
   Returns 2 where a block is not positive definite. */
int eg_bundle_eliminate(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *cameras,
    const double *points, double lam, int damping, const eg_envelope *envelope, double *V, double *D,
    double *g, double *T, double *half, double *camera_sums, double *pairs, double *reduced)
{
    elimination e;
    eg_pass *p = &e.pass;
    int status = 0;
    const ptrdiff_t most_rows = 24 + 10; /* sums and scratch of points of four entries */
    if (elimination_begin(&e, bundle, begin, end, most_rows))
        return 1;
    const ptrdiff_t b = e.route.point, block = b * (b + 1) / 2;
    for (ptrdiff_t c = begin, last; c < end; c = last) {
        eg_group_clear(&e.group);
        last = eg_group_end(bundle, c, end, e.route.turned);
        for (; c < last; ++c) {
            eg_pass_chunk(p, c, points);
            const ptrdiff_t M = p->chunk.M, size = e.route.sums * M;
            double *v = p->extra, *roots = v + b * M, *sums = roots + b * b * M;
            double *scratch = sums + size, *kept = scratch + block * M;
            memset(sums, 0, (size_t)size * sizeof(double));
            if (e.route.factored)
                eg_moments(M, p->points, p->moments);
            for (ptrdiff_t s = 0; s < p->chunk.L; ++s) {
                eg_pass_slot(p, s, cameras);
                eg_pass_keep(p, s, kept);
                e.route.observe(p, sums, camera_sums);
            }
            eg_damped_roots(M, b, e.route.factored ? EG_DEPTHS : damping, sums, lam, scratch, roots, v);
            for (ptrdiff_t j = 0; j < M && p->chunk.count[j]; ++j)
                for (ptrdiff_t k = 0; k < b; ++k) /* the diagonal tells */
                    if (!isfinite(roots[(b + 1) * k * M + j]))
                        status = 2;
            eg_scatter_symmetric(&p->chunk, b, sums, V);
            if (e.route.factored)
                eg_scatter_symmetric(&p->chunk, b, sums + block * M, D);
            eg_scatter(&p->chunk, b, sums + size - b * M, g);
            eg_scatter(&p->chunk, b * b, roots, T);
            eg_scatter(&p->chunk, b, v, half);
            if (pairs)
                e.route.turn(p, roots, v, kept, envelope, &e.group, pairs, e.reduced);
        }
        if (pairs)
            e.route.pairs(&e.route, envelope, &e.group, pairs);
    }
    mirror(&e.route, envelope, pairs);
    elimination_end(&e, reduced);
    return status;
}

/* v = y + T^T W^T x, with y = 0 or x = 0 where NULL; moved = v and reduced += W T v unless NULL.
   T is the identity where NULL. All are `count` columns: x (n, tangent, count), y (m, b, count). */
int eg_bundle_couple(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *cameras,
    const double *points, const double *T, ptrdiff_t count, const double *x, const double *y,
    double *moved, double *reduced)
{
    const eg_route route = eg_route_of(bundle);
    const ptrdiff_t b = route.point, a = route.tangent;
    eg_pass p;
    if (eg_pass_begin(&p, bundle, &route, begin, end, ((a > 2 ? a : 2) + b) * count + b * b, 0))
        return 1;
    for (ptrdiff_t c = begin; c < end; ++c) {
        eg_pass_chunk(&p, c, points);
        const ptrdiff_t M = p.chunk.M;
        double *v = p.extra, *roots = v + b * count * M, *gathered = roots + b * b * M;
        gather_roots(&p.chunk, b, T, roots);
        if (route.factored)
            eg_moments(M, p.points, p.moments);
        if (y)
            eg_gather(M, b * count, y, p.chunk.point, v);
        else
            memset(v, 0, (size_t)(b * count * M) * sizeof(double));
        for (ptrdiff_t s = 0; x && s < p.chunk.L; ++s) {
            eg_pass_slot(&p, s, cameras);
            eg_gather(M, a * count, x, p.view, gathered);
            route.couple(&p, roots);
            for (ptrdiff_t k = 0; k < count; ++k)
                route.to_points(&p, roots, count, gathered + k * M, v + k * M);
        }
        if (moved)
            eg_scatter(&p.chunk, b * count, v, moved);
        for (ptrdiff_t s = 0; reduced && s < p.chunk.L; ++s) {
            eg_pass_slot(&p, s, cameras);
            route.couple(&p, roots);
            route.to_cameras(&p, roots, count, v, gathered, reduced);
        }
    }
    eg_release(p.memory);
    return 0;
}

/* T (I + Z) T^T for the lanes of a chunk that hold a point, Z and T (b, b) an array of lanes. */
static void around_roots(const eg_chunk *chunk, ptrdiff_t b, const double *roots, const double *Z,
                         double *blocks)
{
    const ptrdiff_t M = chunk->M;
    for (ptrdiff_t j = 0; j < M && chunk->count[j]; ++j, Z += b * b) {
        double T[16], half[16], *block = blocks + b * b * chunk->point[j];
        for (ptrdiff_t k = 0; k < b * b; ++k)
            T[k] = roots[k * M + j];
        for (ptrdiff_t i = 0; i < b; ++i)
            for (ptrdiff_t k = 0; k < b; ++k) {
                half[b * i + k] = T[b * i + k];
                for (ptrdiff_t l = 0; l < b; ++l)
                    half[b * i + k] += T[b * i + l] * 0.5 * (Z[b * l + k] + Z[b * k + l]);
            }
        for (ptrdiff_t i = 0; i < b; ++i)
            for (ptrdiff_t k = 0; k <= i; ++k) {
                double sum = 0.0;
                for (ptrdiff_t l = 0; l < b; ++l)
                    sum += half[b * i + l] * T[b * k + l];
                block[b * i + k] = block[b * k + i] = sum;
            }
    }
}

/* -X Y T^T of the observations of a chunk's lanes that hold a point, in the order of the points:
   (K, b) each, from b rows of the padded width. */
static void across_roots(const eg_route *route, const eg_chunk *chunk, const double *roots,
                         const ptrdiff_t *first, const double *coupled, double *blocks)
{
    const ptrdiff_t M = chunk->M, b = route->point, K = route->tangent;
    for (ptrdiff_t j = 0; j < M && chunk->count[j]; ++j)
        for (ptrdiff_t s = 0; s < chunk->count[j]; ++s, coupled += b * route->padded) {
            double *block = blocks + K * b * (first[chunk->point[j]] + s);
            for (ptrdiff_t i = 0; i < K; ++i)
                for (ptrdiff_t k = 0; k < b; ++k) {
                    double sum = 0.0;
                    for (ptrdiff_t l = 0; l < b; ++l)
                        sum += coupled[route->padded * l + i] * roots[(b * k + l) * M + j];
                    block[b * i + k] = -sum;
                }
        }
}

/* The points' diagonal blocks of the whole inverse, T (I + Y^T X Y) T^T with Y = W T, from the
   cameras' blocks X of all pairs of views that see common points, stored as sums of pairs. Unless
   NULL, `coupled` gets the blocks (camera, point) of each observation, those of a point from
   `first` on. Of the direct route. */
int eg_bundle_marginals(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *cameras,
    const double *points, const double *T, const double *X, const eg_envelope *envelope,
    double *marginals, const ptrdiff_t *first, double *coupled)
{
    elimination e;
    eg_pass *p = &e.pass;
    if (elimination_begin(&e, bundle, begin, end, 0))
        return 1;
    const ptrdiff_t b = e.route.point, size = b * e.route.padded;
    const ptrdiff_t lanes = eg_group_most(bundle, &e.route, begin, end, bundle->lanes);
    const ptrdiff_t rows = eg_group_most(bundle, &e.route, begin, end, bundle->rows);
    double *Z = eg_aligned(b * b * lanes + (coupled ? size * rows : 0));
    for (ptrdiff_t c = begin, last; Z && c < end; c = last) {
        eg_group_clear(&e.group);
        last = eg_group_end(bundle, c, end, e.route.turned);
        for (ptrdiff_t k = c; k < last; ++k) {
            eg_pass_chunk(p, k, points);
            const ptrdiff_t M = p->chunk.M;
            double *roots = p->extra + b * M, *kept = roots + b * b * M;
            gather_roots(&p->chunk, b, T, roots);
            for (ptrdiff_t s = 0; s < p->chunk.L; ++s) {
                eg_pass_slot(p, s, cameras);
                eg_pass_keep(p, s, kept);
                e.route.evaluate(p);
            }
            e.route.turn(p, roots, NULL, kept, envelope, &e.group, NULL, e.reduced);
        }
        double *sums = Z + b * b * lanes;
        for (ptrdiff_t lane = 0; lane < e.group.lanes; ++lane)
            e.route.marginal(&e.route, envelope, &e.group, lane, X, Z + b * b * lane,
                             coupled ? sums + size * e.group.first[lane] : NULL);
        const double *own = Z, *across = sums;
        for (ptrdiff_t k = c; k < last; ++k) {
            const eg_chunk chunk = eg_chunk_of(bundle, k);
            double *roots = p->extra;
            gather_roots(&chunk, b, T, roots);
            around_roots(&chunk, b, roots, own, marginals);
            if (coupled)
                across_roots(&e.route, &chunk, roots, first, across, coupled);
            for (ptrdiff_t j = 0; j < chunk.M && chunk.count[j]; ++j) {
                own += b * b;
                across += coupled ? size * chunk.count[j] : 0;
            }
        }
    }
    const int failed = !Z;
    eg_release(Z);
    elimination_end(&e, NULL);
    return failed;
}
