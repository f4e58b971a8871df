/* The whole minimisation over many views with the covariant damping, points refined after each step. */
#include <math.h>

#include "bundle_chunk.h"
#include "lm.h"

/* Least diagonal entry of a camera's damping, of the largest one of the same kind in any camera; as in
   epigauge.bundle.dampings. */
#define SMALL 1e-12

/* Homogeneous vectors whose scale has run away beyond this become unit vectors, as in
   epigauge.bundle.problem. */
#define LARGE 1e30

typedef struct {
    const eg_bundle *bundle;
    const eg_envelope *views, *panels;
    const eg_bundle_options *options;
    eg_route route;
    ptrdiff_t n, m, d, b;
    int failed;      /* memory ran out */
    double lam;      /* of the step being made */
    double reduced_for; /* lambda of the pairs and roots that there are */
    int singular;    /* these failed: a block of a point is not positive definite */
    double *statuses; /* of the parts of a pass, 0 where it was done */
    double *cameras, *points;             /* the estimate */
    double *trial_cameras, *trial_points; /* refined already */
    double *costs;                        /* of the trial's points */
    double *U, *V, *D, *g, *g_points, *D_points; /* normal equations; dampings */
    double *sums, *pairs, *blocks;        /* as the passes add up */
    double *A, *white, *S, *x, *step, *T, *half, *coupled_cameras, *coupled, *point_step;
    double *lanes; /* cameras, steps and moved cameras, observation-last */
} state;

static double total(state *s, const double *costs)
{
    double sum = 0.0;
    for (ptrdiff_t j = 0; j < s->m; ++j)
        sum += costs[j];
    return 0.5 * sum;
}

/* Do all parts of a pass; returns their statuses. */
static int together(state *s, eg_part *part, ptrdiff_t count)
{
    int failed = 0;
    if (s->options->share && count > 1)
        s->options->share(part, s, count);
    else
        for (ptrdiff_t k = 0; k < count; ++k)
            part(s, k);
    for (ptrdiff_t k = 0; k < count; ++k)
        failed |= (int)s->statuses[k];
    return failed;
}

/* A pass over observations, in parts of so many; one over pairs of observations of a point. */
static void pass(state *s, eg_part *part)
{
    s->failed |= together(s, part, s->options->n_passes);
}

/* Add up what the parts of a pass have summed, each at its own place. */
static void add_parts(ptrdiff_t parts, ptrdiff_t size, double *sums)
{
    for (ptrdiff_t k = 1; k < parts; ++k)
        eg_add(size, sums + k * size, sums);
}

static void cost_part(void *self, ptrdiff_t k)
{
    state *s = self;
    const ptrdiff_t *edge = s->options->passes + k;
    s->statuses[k] = eg_bundle_costs(s->bundle, edge[0], edge[1], s->cameras, s->points, s->costs);
}

static double cost_at_start(void *self)
{
    state *s = self;
    pass(s, cost_part);
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

/* Of numbers that are not negative; NaN is none of them. */
static inline double larger(double most, double value)
{
    return value > most ? value : most;
}

static double mean_diagonal(ptrdiff_t count, ptrdiff_t size, const double *blocks)
{
    double most = 0.0;
    for (ptrdiff_t i = 0; i < count; ++i) {
        double sum = 0.0;
        for (ptrdiff_t k = 0; k < size; ++k)
            sum += blocks[size * size * i + (size + 1) * k];
        most = larger(most, sum / (double)size);
    }
    return most;
}

static void linearize_part(void *self, ptrdiff_t k)
{
    state *s = self;
    const ptrdiff_t *edge = s->options->passes + k, size = s->n * s->route.camera_sums;
    double *sums = s->sums + k * size;
    memset(sums, 0, (size_t)size * sizeof(double));
    s->statuses[k] = eg_bundle_linearize(s->bundle, edge[0], edge[1], s->cameras, s->points, s->V,
                                         s->D_points, s->g_points, sums);
}

/* Sums of pairs and cameras of a part, zero to begin with. */
static double *pairs_of(state *s, ptrdiff_t k)
{
    const ptrdiff_t size = s->views->slot[s->n] * s->route.pair_sums.size;
    return memset(s->pairs + k * size, 0, (size_t)size * sizeof(double));
}

static double *coupled_of(state *s, ptrdiff_t k)
{
    const ptrdiff_t size = s->n * s->d;
    return memset(s->coupled_cameras + k * size, 0, (size_t)size * sizeof(double));
}

static void eliminate_part(void *self, ptrdiff_t k)
{
    state *s = self;
    const ptrdiff_t *edge = s->options->pairs + k, size = s->n * s->route.camera_sums;
    double *sums = s->sums + k * size;
    memset(sums, 0, (size_t)size * sizeof(double));
    s->statuses[k] = eg_bundle_eliminate(
        s->bundle, edge[0], edge[1], s->cameras, s->points, s->lam,
        (int)s->options->refinement.damping, s->views, s->V, s->D_points, s->g_points, s->T, s->half,
        sums, pairs_of(s, k), coupled_of(s, k));
}

/* Add up what the parts of a pass have summed over pairs. */
static void add_pairs(state *s)
{
    const ptrdiff_t parts = s->options->n_pairs;
    add_parts(parts, s->views->slot[s->n] * s->route.pair_sums.size, s->pairs);
    add_parts(parts, s->n * s->d, s->coupled_cameras);
    s->reduced_for = s->lam;
}

static eg_lm_system linearize(void *self, double lam)
{
    state *s = self;
    eg_lm_system system = {0.0, 0.0, INFINITY};
    s->reduced_for = -1.0;
    s->singular = 0;
    if (lam > 0.0) {
        s->lam = lam;
        const int statuses = together(s, eliminate_part, s->options->n_pairs);
        s->failed |= statuses & 1;
        s->singular = statuses & 2;
        add_parts(s->options->n_pairs, s->n * s->route.camera_sums, s->sums);
        add_pairs(s);
    } else {
        pass(s, linearize_part);
        add_parts(s->options->n_passes, s->n * s->route.camera_sums, s->sums);
    }
    eg_bundle_camera_blocks(s->bundle, s->sums, s->U, s->D, s->g);
    for (ptrdiff_t k = 0; k < s->n * s->d; ++k)
        system.steepest = larger(system.steepest, fabs(s->g[k]));
    for (ptrdiff_t k = 0; k < s->m * s->b; ++k)
        system.steepest = larger(system.steepest, fabs(s->g_points[k]));
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

static void in_range(ptrdiff_t count, ptrdiff_t size, double *vectors)
{
    for (ptrdiff_t i = 0; i < count; ++i, vectors += size) {
        double most = 0.0, sum = 0.0;
        for (ptrdiff_t k = 0; k < size; ++k)
            most = fmax(most, fabs(vectors[k]));
        if (!(most > LARGE || (most < 1.0 / LARGE && most > 0.0)) || isinf(most))
            continue;
        for (ptrdiff_t k = 0; k < size; ++k) {
            vectors[k] /= most;
            sum += vectors[k] * vectors[k];
        }
        for (ptrdiff_t k = 0; k < size; ++k)
            vectors[k] /= sqrt(sum);
    }
}

/* The cameras moved by their step; own tangents that are not computed with are zero. */
static void retract(state *s)
{
    const ptrdiff_t n = s->n, d = s->d, c = s->route.camera;
    if (s->route.factored) {
        for (ptrdiff_t k = 0; k < 12 * n; ++k)
            s->trial_cameras[k] = s->cameras[k] + s->step[k];
        in_range(n, 12, s->trial_cameras);
        in_range(s->m, 4, s->trial_points);
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

/* Inverse roots of the damped blocks of points. */
static void roots_part(void *self, ptrdiff_t k)
{
    state *s = self;
    const ptrdiff_t parts = s->options->n_passes, b = s->b, width = s->route.factored ? b * b : 1;
    const ptrdiff_t begin = s->m * k / parts, end = s->m * (k + 1) / parts;
    s->statuses[k] = eg_bundle_inverse_roots(
        end - begin, b, s->V + b * b * begin, s->D_points + width * begin, width, s->lam,
        s->g_points + b * begin, s->T + b * b * begin, s->half + b * begin);
}

static void schur_part(void *self, ptrdiff_t k)
{
    state *s = self;
    const ptrdiff_t *edge = s->options->pairs + k;
    s->statuses[k] = eg_bundle_schur(s->bundle, edge[0], edge[1], s->cameras, s->points, s->T,
                                     s->half, s->views, pairs_of(s, k), coupled_of(s, k));
}

static void couple_part(void *self, ptrdiff_t k)
{
    state *s = self;
    const ptrdiff_t *edge = s->options->passes + k;
    s->statuses[k] = eg_bundle_couple(s->bundle, edge[0], edge[1], s->cameras, s->points, s->T, 1,
                                      s->step, 0, s->coupled, 0);
}

/* The reduced system of the whitened unknowns of the cameras, and its factor. */
static int reduce(state *s)
{
    const ptrdiff_t n = s->n, d = s->d, count = s->views->slot[n];
    const eg_blocks dense = {d, d * d, d};
    const int expanded = s->route.factored;
    if (expanded)
        eg_bundle_pair_blocks(s->bundle, count, s->pairs, s->blocks);
    eg_skyline_reduce(s->views, s->panels, expanded ? &dense : &s->route.pair_sums, d,
                      expanded ? s->blocks : s->pairs, s->white, s->A, s->S);
    return eg_envelope_factor(s->panels, s->S);
}

/* The step of the cameras, from the factor; returns its squared length. */
static double step_of_cameras(state *s)
{
    const ptrdiff_t n = s->n, d = s->d;
    double sum = 0.0, *x = s->x;
    memset(x, 0, (size_t)(12 * s->panels->n) * sizeof(double));
    for (ptrdiff_t i = 0; i < n; ++i)
        for (ptrdiff_t k = 0; k < d; ++k)
            for (ptrdiff_t l = 0; l < d; ++l)
                x[d * i + k] += s->A[d * (d * i + l) + k]
                                * (s->coupled_cameras[d * i + l] - s->g[d * i + l]);
    eg_envelope_solve(s->panels, s->S, 1, x);
    for (ptrdiff_t i = 0; i < n; ++i)
        for (ptrdiff_t k = 0; k < d; ++k) {
            double value = 0.0;
            for (ptrdiff_t l = 0; l < d; ++l)
                value += s->A[d * (d * i + k) + l] * x[d * i + l];
            s->step[d * i + k] = value;
            sum += value * value;
        }
    return sum;
}

static int make_step(void *self, double lam, double *norm)
{
    state *s = self;
    const ptrdiff_t m = s->m, b = s->b;
    const volatile int *stop = s->options->stop;
    if (s->failed || (stop && *stop))
        return EG_STEP_HOPELESS;
    if (s->reduced_for != lam) {
        s->lam = lam;
        s->singular = together(s, roots_part, s->options->n_passes);
        if (!s->singular) {
            s->failed |= together(s, schur_part, s->options->n_pairs);
            add_pairs(s);
        }
    }
    if (s->singular || whiten(s, lam) || reduce(s))
        return EG_STEP_SINGULAR;
    double sum = step_of_cameras(s);
    pass(s, couple_part);
    eg_bundle_point_steps(m, b, s->T, s->half, s->coupled, 0, 0, s->point_step);
    for (ptrdiff_t k = 0; k < m * b; ++k) {
        sum += s->point_step[k] * s->point_step[k];
        s->trial_points[k] = s->points[k] + s->point_step[k];
    }
    retract(s);
    *norm = sqrt(sum);
    return s->failed ? EG_STEP_HOPELESS : EG_STEP_MADE;
}

/* The decrease that the quadratic model promises for the step, with (N + lam D) step = -g:
   (lam step^T D step - g^T step) / 2. */
static double promised(void *self)
{
    const state *s = self;
    const ptrdiff_t d = s->d, b = s->b;
    double slope = 0.0, energy = 0.0;
    for (ptrdiff_t i = 0; i < s->n; ++i)
        for (ptrdiff_t k = 0; k < d; ++k) {
            const double *row = s->D + d * (d * i + k), *step = s->step + d * i;
            double damped = 0.0;
            for (ptrdiff_t l = 0; l < d; ++l)
                damped += row[l] * step[l];
            slope += s->g[d * i + k] * step[k];
            energy += damped * step[k];
        }
    for (ptrdiff_t j = 0; j < s->m; ++j)
        for (ptrdiff_t k = 0; k < b; ++k) {
            const double *step = s->point_step + b * j;
            double damped = s->route.factored ? 0.0 : s->D_points[j] * step[k];
            for (ptrdiff_t l = 0; s->route.factored && l < b; ++l)
                damped += s->D_points[b * (b * j + k) + l] * step[l];
            slope += s->g_points[b * j + k] * step[k];
            energy += damped * step[k];
        }
    return 0.5 * (s->lam * energy - slope);
}

static void refine_part(void *self, ptrdiff_t k)
{
    state *s = self;
    const ptrdiff_t *edge = s->options->passes + k;
    s->statuses[k] = eg_bundle_refine_points(s->bundle, edge[0], edge[1], s->trial_cameras,
                                             s->trial_points, s->costs, 0,
                                             &s->options->refinement);
}

static double cost_at_trial(void *self)
{
    state *s = self;
    const eg_bundle_options *o = s->options;
    pass(s, refine_part);
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
    const eg_bundle_options *options, double *cameras, double *points,
    const eg_bundle_normal *normal, double *history, double *cost, ptrdiff_t *counts)
{
    state s = {.bundle = bundle, .views = views, .panels = panels, .options = options,
               .route = eg_route_of(bundle), .n = bundle->n_views, .m = bundle->n_points,
               .cameras = cameras, .points = points, .U = normal->U, .V = normal->V,
               .g = normal->g, .g_points = normal->g_points};
    const ptrdiff_t n = s.n, m = s.m, d = s.d = s.route.tangent, b = s.b = s.route.point;
    const ptrdiff_t count = views->slot[n], c = s.route.camera;
    const ptrdiff_t passes = options->n_passes, pairs = options->n_pairs;
    const struct { double **part; ptrdiff_t size; } parts[] = {
        {&s.statuses, passes > pairs ? passes : pairs}, {&s.trial_cameras, n * c},
        {&s.trial_points, m * b}, {&s.costs, m}, {&s.D, n * d * d}, {&s.D_points, m * b * b},
        {&s.sums, (passes > pairs ? passes : pairs) * n * s.route.camera_sums}, {&s.pairs, pairs * count * s.route.pair_sums.size},
        {&s.blocks, s.route.factored ? count * d * d : 0}, {&s.A, n * d * d},
        {&s.white, n * d * d}, {&s.S, 144 * panels->slot[panels->n]}, {&s.x, 12 * panels->n},
        {&s.step, n * d}, {&s.T, m * b * b}, {&s.half, m * b}, {&s.coupled_cameras, pairs * n * d},
        {&s.coupled, m * b}, {&s.point_step, m * b}, {&s.lanes, n * (2 * c + EG_MOST_TANGENT)},
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
                                   cost_at_trial, accept, promised, options->adaptive};
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
