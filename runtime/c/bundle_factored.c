/* The factored route: a projective camera's Jacobian is a (x) Q^T, a (2, 3) = d q_hat / d h, so its
   sums are a few factors times the moments Q Q^T of the points. */
#include "bundle_moments.h"
#include "bundle_pairs.h"

static void squared(const eg_pass *p)
{
    eg_squared_distance(p->chunk.M, p->cameras, p->points, p->q, p->squared);
}

static void sight(const eg_pass *p, const double *points, double *sums)
{
    const ptrdiff_t M = p->chunk.M;
    double *own = p->work + 10 * M;
    if (p->bundle->loss != EG_LINEAR)
        eg_squared_distance(M, p->cameras, points, p->q, p->squared);
    eg_weigh(p);
    eg_point_normal(M, p->cameras, points, p->q, p->w, own, own + 10 * M, own + 20 * M, p->squared);
    eg_add(24 * M, own, sums);
}

/* Sums of a camera: for the six entries of w a^T a and for depth the moments Q Q^T, then e Q^T. */
static void observe(eg_pass *p, double *sums, double *cameras)
{
    const ptrdiff_t M = p->chunk.M;
    double *factors = p->work;
    memcpy(p->kept + M, p->cameras, (size_t)(12 * M) * sizeof(double));
    sight(p, p->points, sums);
    eg_camera_normal(M, p->cameras, p->points, p->q, p->w, factors, factors + 6 * M,
                     factors + 7 * M);
    for (ptrdiff_t j = 0, next; j < p->filled; j = next) {
        next = eg_run(p->view, j, p->filled);
        const double *moment = p->moments + 16 * j, *factor = factors + j;
        double *sum = cameras + EG_CAMERA * p->view[j], *low = sum + 7 * 8;
        eg_accumulate(next - j, factor, M, moment, sum, low);
        eg_accumulate(next - j, factor + 3 * M, M, moment, sum + 3 * 8, low + 3 * 4);
        eg_accumulate_one(next - j, factor + 6 * M, moment, sum + 6 * 8, low + 6 * 4);
        eg_accumulate_points(next - j, factor + 7 * M, M, moment, sum + 7 * EG_MOMENTS);
    }
}

/* Kept of an observation: its weight, then its camera. */
static void evaluate(eg_pass *p)
{
    memcpy(p->kept + p->chunk.M, p->cameras, (size_t)(12 * p->chunk.M) * sizeof(double));
    if (p->bundle->loss != EG_LINEAR)
        squared(p);
    eg_weigh(p);
}

/* F = w a^T a P T, (3, 4), behind ten rows of scratch. */
static void couple(const eg_pass *p, const double *roots)
{
    if (p->bundle->loss != EG_LINEAR)
        squared(p);
    eg_weigh(p);
    eg_coupling(p->chunk.M, p->cameras, p->points, p->w, roots, p->work + 10 * p->chunk.M);
}

static void to_points(const eg_pass *p, const double *roots, ptrdiff_t count, const double *x,
                      double *v)
{
    (void)roots;
    const ptrdiff_t M = p->chunk.M, step = count * M;
    const double *Q = p->points, *F = p->work + 10 * M;
    double *moved = p->work;
    for (int a = 0; a < 3; ++a) {
        const double *own = x + 4 * a * step;
        EG_SIMD
        for (ptrdiff_t j = 0; j < M; ++j)
            moved[a * M + j] = own[j] * Q[j] + own[step + j] * Q[M + j]
                               + own[2 * step + j] * Q[2 * M + j]
                               + own[3 * step + j] * Q[3 * M + j];
    }
    for (int k = 0; k < 4; ++k) {
        EG_SIMD
        for (ptrdiff_t j = 0; j < M; ++j)
            v[k * step + j] += F[k * M + j] * moved[j] + F[(4 + k) * M + j] * moved[M + j]
                               + F[(8 + k) * M + j] * moved[2 * M + j];
    }
}

/* F v, (3, M), in scratch. */
static const double *moved_by(const eg_pass *p, const double *F, ptrdiff_t step, const double *v)
{
    const ptrdiff_t M = p->chunk.M;
    double *y = p->work;
    for (int a = 0; a < 3; ++a) {
        EG_SIMD
        for (ptrdiff_t j = 0; j < M; ++j)
            y[a * M + j] = F[(4 * a) * M + j] * v[j] + F[(4 * a + 1) * M + j] * v[step + j]
                           + F[(4 * a + 2) * M + j] * v[2 * step + j]
                           + F[(4 * a + 3) * M + j] * v[3 * step + j];
    }
    return y;
}

static void add_to_cameras(const eg_pass *p, const double *F, const double *v, double *cameras)
{
    const ptrdiff_t M = p->chunk.M;
    const double *y = moved_by(p, F, M, v);
    for (ptrdiff_t j = 0, end; j < p->filled; j = end) {
        end = eg_run(p->view, j, p->filled);
        eg_accumulate_points(end - j, y + j, M, p->moments + 16 * j, cameras + 12 * p->view[j]);
    }
}

static void to_cameras(const eg_pass *p, const double *roots, ptrdiff_t count, const double *v,
                       double *scratch, double *cameras)
{
    (void)roots, (void)scratch;
    const ptrdiff_t M = p->chunk.M;
    const double *F = p->work + 10 * M;
    if (count == 1) {
        add_to_cameras(p, F, v, cameras);
        return;
    }
    for (ptrdiff_t c = 0; c < count; ++c) {
        const double *y = moved_by(p, F, count * M, v + c * M);
        for (ptrdiff_t j = 0; j < p->filled; ++j)
            for (int a = 0; a < 3; ++a)
                for (int k = 0; k < 4; ++k)
                    cameras[count * (12 * p->view[j] + 4 * a + k) + c] +=
                        y[a * M + j] * p->points[k * M + j];
    }
}

/* Lanes that hold a point, where all of these are seen by the same views, once; else 0. */
static ptrdiff_t alike(const eg_chunk *chunk)
{
    const ptrdiff_t M = chunk->M, lanes = eg_filled(chunk, 0, M);
    if (chunk->count[lanes - 1] < chunk->count[0])
        return 0;
    for (ptrdiff_t s = 0; s < chunk->L; ++s)
        if (eg_run(chunk->view + s * M, 0, lanes) < lanes
            || (s && chunk->view[s * M] == chunk->view[(s - 1) * M]))
            return 0;
    return lanes;
}

/* Copy the factors of a chunk behind those of a group: rows of 12 an observation. */
static void append(const eg_pass *p, const double *F, eg_group *group)
{
    const eg_chunk *chunk = &p->chunk;
    const ptrdiff_t M = chunk->M, lanes = eg_filled(chunk, 0, M);
    const int32_t *first = group->first + group->lanes;
    memcpy(group->moments + 16 * group->lanes, p->moments, (size_t)(16 * lanes) * sizeof(double));
    eg_group_append(group, chunk);
    for (ptrdiff_t s = 0; s < chunk->L; ++s)
        for (ptrdiff_t j = 0; j < lanes && s < chunk->count[j]; ++j)
            for (ptrdiff_t k = 0; k < 12; ++k)
                group->turned[12 * (first[j] + s) + k] = F[(13 * s + k) * M + j];
}

/* The factors take the place of the cameras. */
static void turn(eg_pass *p, const double *roots, const double *v, double *kept,
                 const eg_envelope *envelope, eg_group *group, double *pairs, double *cameras)
{
    const ptrdiff_t M = p->chunk.M, lanes = alike(&p->chunk);
    double *seen_by = p->cameras;
    for (ptrdiff_t s = 0; s < p->chunk.L; ++s) {
        eg_pass_slot_of(p, s, seen_by);
        eg_pass_keep(p, s, kept);
        double *own = p->kept + M;
        memcpy(seen_by, own, (size_t)(12 * M) * sizeof(double));
        eg_coupling(M, seen_by, p->points, p->w, roots, own);
        if (v)
            add_to_cameras(p, own, v, cameras);
    }
    if (lanes)
        eg_factored_pairs_alike(p, envelope, lanes, kept + M, pairs);
    else
        append(p, kept + M, group);
}

const eg_route eg_factored_route = {
    .factored = 1,
    .camera = 12,
    .point = 4,
    .tangent = 12,
    .padded = EG_MOMENTS,
    .camera_sums = EG_CAMERA,
    .pair_sums = {.d = 12, .size = EG_PAIR},
    .sums = 24,
    .kept = 13,
    .turned = 12,
    .work = 10 + 24,
    .squared = squared,
    .sight = sight,
    .evaluate = evaluate,
    .observe = observe,
    .couple = couple,
    .to_points = to_points,
    .to_cameras = to_cameras,
    .turn = turn,
    .pairs = eg_factored_pairs,
};
