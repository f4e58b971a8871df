/* The whole minimisation over many views with the covariant damping, points refined after each step:
   for problems so small that calls from Python between its parts would cost more than they. */
#include <math.h>

#include "bundle_chunk.h"
#include "lm.h"

/* Least diagonal entry of a camera's damping, of the largest one of the same kind in any camera; as in
   epigauge.bundle.dampings. */
#define SMALL 1e-12

typedef struct {
    const eg_bundle *bundle;
    const eg_envelope *views, *panels;
    const eg_bundle_options *options;
    eg_route route;
    ptrdiff_t n, m, d, b;
    int failed; /* memory ran out */
    double *cameras, *points;             /* the estimate */
    double *trial_cameras, *trial_points; /* refined already */
    double *costs;                        /* of the trial's points */
    double *U, *V, *D, *g, *g_points, *D_points; /* normal equations; dampings */
    double *sums, *pairs, *blocks;        /* as the passes add up */
    double *A, *white, *S, *x, *step, *T, *half, *coupled, *point_step;
    double *lanes; /* cameras, steps and moved cameras, observation-last */
} state;

static double total(state *s, const double *costs)
{
    double sum = 0.0;
    for (ptrdiff_t j = 0; j < s->m; ++j)
        sum += costs[j];
    return 0.5 * sum;
}

static double cost_at_start(void *self)
{
    state *s = self;
    s->failed |= eg_bundle_costs(s->bundle, 0, s->bundle->n_chunks, s->cameras, s->points, s->costs);
    return total(s, s->costs);
}

/* Dampings D of cameras and D_points: with the factored route N + Z^T Z by block, else the diagonal
   and the trace (a multiple of I), or for models without a pose the blocks. */
static void dampings(state *s)
{
    const ptrdiff_t d = s->d, b = s->b;
    if (s->route.factored) {
        for (ptrdiff_t k = 0; k < s->n * d * d; ++k)
            s->D[k] += s->U[k];
        for (ptrdiff_t k = 0; k < s->m * b * b; ++k)
            s->D_points[k] += s->V[k];
        return;
    }
    memset(s->D, 0, (size_t)(s->n * d * d) * sizeof(double));
    for (ptrdiff_t k = 0; k < d; ++k) {
        double most = 0.0;
        for (ptrdiff_t i = 0; i < s->n; ++i)
            most = fmax(most, s->U[d * d * i + (d + 1) * k]);
        for (ptrdiff_t i = 0; i < s->n; ++i) {
            const double value = fmax(s->U[d * d * i + (d + 1) * k], SMALL * most);
            s->D[d * d * i + (d + 1) * k] = value > 0.0 ? value : 1.0;
        }
    }
    for (ptrdiff_t j = 0; j < s->m; ++j) {
        double trace = 0.0;
        for (ptrdiff_t k = 0; k < b; ++k)
            trace += s->V[b * b * j + (b + 1) * k];
        s->D_points[j] = trace / (double)b;
    }
}

static double mean_diagonal(ptrdiff_t count, ptrdiff_t size, const double *blocks)
{
    double most = 0.0;
    for (ptrdiff_t i = 0; i < count; ++i) {
        double sum = 0.0;
        for (ptrdiff_t k = 0; k < size; ++k)
            sum += blocks[size * size * i + (size + 1) * k];
        most = fmax(most, sum / (double)size);
    }
    return most;
}

static eg_lm_system linearize(void *self)
{
    state *s = self;
    eg_lm_system system = {0.0, 0.0, INFINITY};
    memset(s->sums, 0, (size_t)(s->n * s->route.camera_sums) * sizeof(double));
    s->failed |= eg_bundle_linearize(s->bundle, 0, s->bundle->n_chunks, s->cameras, s->points, s->V,
                                     s->D_points, s->g_points, s->sums);
    eg_bundle_camera_blocks(s->bundle, s->sums, s->U, s->D, s->g);
    for (ptrdiff_t k = 0; k < s->n * s->d; ++k)
        system.steepest = fmax(system.steepest, fabs(s->g[k]));
    for (ptrdiff_t k = 0; k < s->m * s->b; ++k)
        system.steepest = fmax(system.steepest, fabs(s->g_points[k]));
    system.size = fmax(mean_diagonal(s->n, s->d, s->U), mean_diagonal(s->m, s->b, s->V));
    dampings(s);
    return system;
}

/* A with A^T D A = I, and white = A^T U A + lam I, where D is diagonal. */
static int whiten(state *s, double lam)
{
    const ptrdiff_t d = s->d;
    if (s->route.factored)
        return eg_bundle_whiten(s->n, s->U, s->D, lam, s->A, s->white);
    memset(s->A, 0, (size_t)(s->n * d * d) * sizeof(double));
    for (ptrdiff_t i = 0; i < s->n; ++i) {
        double *A = s->A + d * d * i, *white = s->white + d * d * i;
        const double *U = s->U + d * d * i, *D = s->D + d * d * i;
        for (ptrdiff_t k = 0; k < d; ++k)
            A[(d + 1) * k] = 1.0 / sqrt(D[(d + 1) * k]);
        for (ptrdiff_t k = 0; k < d; ++k)
            for (ptrdiff_t l = 0; l < d; ++l)
                white[d * k + l] = U[d * k + l] * A[(d + 1) * k] * A[(d + 1) * l]
                                   + (k == l ? lam : 0.0);
    }
    return 0;
}

/* The cameras moved by their step; own tangents that are not computed with are zero. */
static void retract(state *s)
{
    const ptrdiff_t n = s->n, d = s->d, c = s->route.camera;
    if (s->route.factored) {
        for (ptrdiff_t k = 0; k < 12 * n; ++k)
            s->trial_cameras[k] = s->cameras[k] + s->step[k];
        return;
    }
    const eg_camera_model *model = eg_camera_models + s->bundle->model;
    double *from = s->lanes, *delta = from + c * n, *to = delta + model->tangent_size * n;
    memset(delta, 0, (size_t)(model->tangent_size * n) * sizeof(double));
    for (ptrdiff_t i = 0; i < n; ++i) {
        for (ptrdiff_t k = 0; k < c; ++k)
            from[n * k + i] = s->cameras[c * i + k];
        for (ptrdiff_t k = 0; k < d; ++k)
            delta[n * s->bundle->columns[k] + i] = s->step[d * i + k];
    }
    model->retract(n, from, delta, to);
    for (ptrdiff_t i = 0; i < n; ++i)
        for (ptrdiff_t k = 0; k < c; ++k)
            s->trial_cameras[c * i + k] = to[n * k + i];
}

static int make_step(void *self, double lam, double *norm)
{
    state *s = self;
    const ptrdiff_t n = s->n, m = s->m, d = s->d, b = s->b, chunks = s->bundle->n_chunks;
    const ptrdiff_t count = s->views->slot[n], width = s->route.factored ? b * b : 1;
    double *reduced = s->x;
    if (s->failed)
        return EG_STEP_HOPELESS;
    if (whiten(s, lam) || eg_bundle_inverse_roots(m, b, s->V, s->D_points, width, lam, s->g_points,
                                                  s->T, s->half))
        return EG_STEP_SINGULAR;
    memset(s->pairs, 0, (size_t)(count * s->route.pair_sums) * sizeof(double));
    memset(reduced, 0, (size_t)(12 * s->panels->n) * sizeof(double));
    memset(s->coupled, 0, (size_t)(n * d) * sizeof(double));
    s->failed |= eg_bundle_schur(s->bundle, 0, chunks, s->cameras, s->points, s->T, s->half, s->views,
                                 s->pairs, s->coupled);
    for (ptrdiff_t i = 0; i < n; ++i)
        for (ptrdiff_t k = 0; k < d; ++k)
            for (ptrdiff_t l = 0; l < d; ++l)
                reduced[d * i + k] += s->A[d * (d * i + l) + k] * (s->coupled[d * i + l] - s->g[d * i + l]);
    const double *blocks = s->pairs;
    ptrdiff_t size = s->route.pair_sums, length = s->route.padded;
    if (s->route.factored) {
        eg_bundle_pair_blocks(s->bundle, count, s->pairs, s->blocks);
        blocks = s->blocks;
        size = d * d;
        length = d;
    }
    eg_skyline_reduce(s->views, s->panels, d, d, blocks, size, length, s->white, s->A, s->S);
    if (eg_envelope_factor(s->panels, s->S))
        return EG_STEP_SINGULAR;
    eg_envelope_solve(s->panels, s->S, 1, reduced);
    double sum = 0.0;
    for (ptrdiff_t i = 0; i < n; ++i)
        for (ptrdiff_t k = 0; k < d; ++k) {
            double value = 0.0;
            for (ptrdiff_t l = 0; l < d; ++l)
                value += s->A[d * (d * i + k) + l] * reduced[d * i + l];
            s->step[d * i + k] = value;
            sum += value * value;
        }
    s->failed |= eg_bundle_couple(s->bundle, 0, chunks, s->cameras, s->points, s->T, s->step, 0,
                                  s->coupled, 0);
    eg_bundle_point_steps(m, b, s->T, s->half, s->coupled, 0, 0, s->point_step);
    for (ptrdiff_t k = 0; k < m * b; ++k) {
        sum += s->point_step[k] * s->point_step[k];
        s->trial_points[k] = s->points[k] + s->point_step[k];
    }
    retract(s);
    *norm = sqrt(sum);
    return s->failed ? EG_STEP_HOPELESS : EG_STEP_MADE;
}

static double cost_at_trial(void *self)
{
    state *s = self;
    const eg_bundle_options *o = s->options;
    s->failed |= eg_bundle_refine_points(s->bundle, 0, s->bundle->n_chunks, s->trial_cameras,
                                         s->trial_points, s->costs, 0, &o->refinement);
    for (ptrdiff_t i = 0; i < s->n; ++i)
        for (ptrdiff_t k = 0; k < o->focals; ++k) {
            const double focal = s->trial_cameras[s->route.camera * i + o->focal[k]];
            if (!(focal >= o->min_focal && focal <= o->max_focal))
                return INFINITY;
        }
    return total(s, s->costs);
}

static void accept(void *self)
{
    state *s = self;
    memcpy(s->cameras, s->trial_cameras, (size_t)(s->n * s->route.camera) * sizeof(double));
    memcpy(s->points, s->trial_points, (size_t)(s->m * s->b) * sizeof(double));
}

/* Minimise over cameras, in the order of the envelope of views, and points, both of which are updated;
   the history has max_iter + 1 rows. Counts are nfev, njev, nit, status. Returns 1 where there is no
   memory. */
int eg_bundle_minimize(
    const eg_bundle *bundle, const eg_envelope *views, const eg_envelope *panels,
    const eg_bundle_options *options, double *cameras, double *points, double *history, double *cost,
    ptrdiff_t *counts)
{
    state s = {.bundle = bundle, .views = views, .panels = panels, .options = options,
               .route = eg_route_of(bundle), .n = bundle->n_views, .m = bundle->n_points,
               .cameras = cameras, .points = points};
    const ptrdiff_t n = s.n, m = s.m, d = s.d = s.route.tangent, b = s.b = s.route.point;
    const ptrdiff_t count = views->slot[n], c = s.route.camera;
    const ptrdiff_t larger = m * b > n * d ? m * b : n * d;
    const struct { double **part; ptrdiff_t size; } parts[] = {
        {&s.trial_cameras, n * c}, {&s.trial_points, m * b}, {&s.costs, m}, {&s.U, n * d * d},
        {&s.V, m * b * b}, {&s.D, n * d * d}, {&s.g, n * d}, {&s.g_points, m * b},
        {&s.D_points, m * b * b}, {&s.sums, n * s.route.camera_sums},
        {&s.pairs, count * s.route.pair_sums}, {&s.blocks, s.route.factored ? count * d * d : 0},
        {&s.A, n * d * d}, {&s.white, n * d * d}, {&s.S, 144 * panels->slot[panels->n]},
        {&s.x, 12 * panels->n}, {&s.step, n * d}, {&s.T, m * b * b}, {&s.half, m * b},
        {&s.coupled, larger}, {&s.point_step, m * b}, {&s.lanes, n * (2 * c + EG_MOST_TANGENT)},
    };
    const size_t kinds = sizeof parts / sizeof parts[0];
    ptrdiff_t size = 8;
    for (size_t k = 0; k < kinds; ++k)
        size += (parts[k].size + 7) / 8 * 8;
    void *whole = malloc((size_t)size * sizeof(double));
    if (!whole)
        return 1;
    double *next = (double *)(((uintptr_t)whole + 63) & ~(uintptr_t)63);
    for (size_t k = 0; k < kinds; next += (parts[k].size + 7) / 8 * 8, ++k)
        *parts[k].part = next;
    const eg_lm_problem problem = {&s, options->floor, cost_at_start, linearize, make_step,
                                   cost_at_trial, accept};
    const eg_lm_options how = {options->ftol, options->xtol, options->gtol, options->start,
                               options->least, 0, (int)options->max_iter};
    eg_lm_outcome outcome;
    eg_lm(&problem, &how, history, &outcome);
    *cost = outcome.cost;
    counts[0] = outcome.nfev;
    counts[1] = outcome.njev;
    counts[2] = outcome.nit;
    counts[3] = outcome.status;
    free(whole);
    return s.failed;
}
