/* Minimisation over F: linear.py and eliminated.py for at most seven unknowns.

   Statuses, stopping rules and the rows of the history are those of runtime/epigauge/lm.py. */
#include "lm.h"
#include "small.h"
#include "two_view.h"

#include <float.h>
#include <math.h>
#include <string.h>

/* As in lm.py and linear.py. */
#define LAM_FLOOR 1e-11
#define LAM_START 1e-3
#define LIFT 1e-3
#define BENT (0.375 * 0.375)

/* Cholesky pivots above this ratio prove a condition far below that of a singular matrix. */
#define WELL_CONDITIONED 1e-8

/* Parameters of the representation itself, before a basis selects some. */
static int own_parameters(const eg_options *options)
{
    return options->chart == EG_ESSENTIAL ? 5 : 7;
}

static void fundamental(const eg_options *options, const eg_chart *chart, const double *motion,
                        double *F)
{
    const double *U = motion, *V = motion + 9, *rest = motion + 18;
    double own[9];
    if (options->chart != EG_BLOCKS) /* sigma = 1 of an essential matrix, too */
        eg_fundamental_from_factors(1, U, V, rest, own);
    else
        eg_block_fundamental(1, U, V, rest, own);
    if (chart->entries)
        eg_product(9, 9, 1, chart->entries, own, F);
    else
        memcpy(F, own, sizeof own);
}

static void retract(const eg_options *options, const eg_chart *chart, const double *motion,
                    const double *step, double *moved)
{
    double delta[7] = {0.0};
    if (chart->basis)
        eg_product(own_parameters(options), chart->p, 1, chart->basis, step, delta);
    else
        memcpy(delta, step, (size_t)chart->p * sizeof(double));
    if (options->chart == EG_ORTHO) {
        eg_retract_factors(1, motion, motion + 9, motion + 18, delta, moved, moved + 9, moved + 18);
    } else if (options->chart == EG_ESSENTIAL) {
        eg_essential_retract(1, motion, motion + 9, delta, moved, moved + 9);
        moved[18] = motion[18];
    } else {
        eg_block_retract(1, motion, motion + 9, motion + 18, delta, moved, moved + 9, moved + 18);
    }
}

/* J^T r'' with r'' ~ (dr/dF) d2F, from N dF (9, p) and d2F (9, n, n). */
static inline void bend(int p, int n, const eg_chart *chart, const double *ND, const double *d2F,
                        double *result)
{
    double inner[63], own[343], half[49];
    memcpy(inner, ND, (size_t)(9 * p) * sizeof(double));
    if (chart->entries)
        eg_transposed_product(9, 9, p, chart->entries, ND, inner);
    eg_transposed_product(p, 9, n * n, inner, d2F, chart->basis ? own : result);
    if (!chart->basis)
        return;
    for (int k = 0; k < p; ++k) {
        eg_product(n, n, p, own + k * n * n, chart->basis, half);
        eg_transposed_product(p, n, p, chart->basis, half, result + k * p * p);
    }
}

/* Gradient, Hessian and diagonal of J^T J by the p parameters. */
static inline void chain_rule(int p, int n, eg_matches *matches, const eg_options *options,
                              const eg_chart *chart, const double *motion, eg_outcome *state)
{
    double g[9], H[81], own[9], dF[63], d2F[441], DF[63], HD[63], second[49];
    eg_normal(matches, options, state->F, g, state->normal, H);
    if (options->chart == EG_ORTHO)
        eg_fundamental_derivatives(1, motion, motion + 9, motion + 18, own, dF, d2F);
    else if (options->chart == EG_ESSENTIAL)
        eg_essential_derivatives(1, motion, motion + 9, own, dF, d2F);
    else
        eg_block_derivatives(1, motion, motion + 9, motion + 18, own, dF, d2F);
    const double *first = dF;
    double inner[9];
    memcpy(inner, g, sizeof inner);
    if (chart->entries) {
        eg_product(9, 9, n, chart->entries, dF, DF);
        eg_transposed_product(9, 9, 1, chart->entries, g, inner);
        memcpy(dF, DF, (size_t)(9 * n) * sizeof(double));
    }
    if (options->exact)
        eg_transposed_product(1, 9, n * n, inner, d2F, second);
    if (chart->basis) {
        double half[49];
        eg_product(9, n, p, dF, chart->basis, DF);
        first = DF;
        if (options->exact) {
            eg_product(n, n, p, second, chart->basis, half);
            eg_transposed_product(p, n, p, chart->basis, half, second);
        }
    }
    eg_transposed_product(p, 9, 1, first, g, state->gradient);
    eg_product(9, 9, p, state->normal, first, HD);
    for (int j = 0; j < p; ++j) {
        state->diagonal[j] = 0.0;
        for (int k = 0; k < 9; ++k)
            state->diagonal[j] += first[k * p + j] * HD[k * p + j];
    }
    if (options->exact) {
        bend(p, n, chart, HD, d2F, state->bend);
        eg_product(9, 9, p, H, first, HD);
    }
    eg_transposed_product(p, 9, p, first, HD, state->hessian);
    for (int i = 0; i < p; ++i)
        for (int j = 0; j < i; ++j) {
            const double mean = 0.5 * (state->hessian[i * p + j] + state->hessian[j * p + i]);
            state->hessian[i * p + j] = state->hessian[j * p + i] = mean;
        }
    if (options->exact)
        for (int k = 0; k < p * p; ++k)
            state->hessian[k] += second[k];
}

/* Compiled for the usual number of parameters, and for any. */
static void linearize(eg_matches *matches, const eg_options *options, const eg_chart *chart,
                      const double *motion, eg_outcome *state)
{
    if (chart->p == 7)
        chain_rule(7, 7, matches, options, chart, motion, state);
    else
        chain_rule(chart->p, own_parameters(options), matches, options, chart, motion, state);
}

static double largest(const eg_outcome *state, int p)
{
    double value = state->diagonal[0];
    for (int i = 1; i < p; ++i)
        value = fmax(value, state->diagonal[i]);
    return value;
}

static int all_finite(int count, const double *values)
{
    for (int k = 0; k < count; ++k)
        if (!isfinite(values[k]))
            return 0;
    return 1;
}

/* g^T H^-1 g / 2; infinity where H is not positive definite to rounding. */
static double decrement(const eg_outcome *state, int p)
{
    double L[49], x[7], vectors[49], values[7], sum = 0.0;
    const double *g = state->gradient;
    memcpy(x, g, (size_t)p * sizeof(double));
    const double ratio = eg_cholesky(p, state->hessian, 0.0, L);
    if (!(ratio > 0.0))
        return INFINITY;
    if (ratio > WELL_CONDITIONED) {
        eg_cholesky_solve(p, L, x);
        for (int i = 0; i < p; ++i)
            sum += g[i] * x[i];
        return 0.5 * sum;
    }
    eg_eigen(p, state->hessian, values, vectors);
    if (!(values[0] > DBL_EPSILON * values[p - 1]))
        return INFINITY;
    eg_transposed_product(p, p, 1, vectors, g, x);
    for (int i = 0; i < p; ++i)
        sum += x[i] * x[i] / values[i];
    return 0.5 * sum;
}

/* The damped Hessian in units of the damping: its Cholesky factor, or eigenvectors. */
typedef struct {
    int factored;
    double L[49], damped[7], vectors[49], scale[7];
} damped_t;

/* x <- -(damped Hessian)^-1 (x / scale). */
static void apply(const damped_t *system, int p, double *x)
{
    double projected[7];
    for (int i = 0; i < p; ++i)
        x[i] /= -system->scale[i];
    if (system->factored) {
        eg_cholesky_solve(p, system->L, x);
        return;
    }
    eg_transposed_product(p, p, 1, system->vectors, x, projected);
    for (int i = 0; i < p; ++i)
        projected[i] /= system->damped[i];
    eg_product(p, p, 1, system->vectors, projected, x);
}

/* The damped step, bent; lambda is lifted until the damped Hessian is definite (linear.py). */
static void solve(const eg_outcome *state, int p, double lam, const eg_options *options,
                  double *step)
{
    damped_t system;
    double A[49], values[7];
    const double floor = DBL_EPSILON * fmax(largest(state, p), DBL_MIN);
    for (int i = 0; i < p; ++i)
        system.scale[i] = options->scaled ? sqrt(fmax(state->diagonal[i], floor)) : 1.0;
    for (int i = 0; i < p; ++i)
        for (int j = 0; j < p; ++j)
            A[i * p + j] = state->hessian[i * p + j] / (system.scale[i] * system.scale[j]);
    system.factored = eg_cholesky(p, A, lam, system.L) > WELL_CONDITIONED;
    if (!system.factored) {
        eg_eigen(p, A, values, system.vectors);
        const double shift = values[0] + lam > 0.0 ? lam : lam - (1.0 + LIFT) * values[0];
        for (int i = 0; i < p; ++i)
            system.damped[i] = fmax(values[i] + shift, DBL_MIN);
    }
    memcpy(step, state->gradient, (size_t)p * sizeof(double));
    apply(&system, p, step);
    double v[7], bent[7], outer[49], straight2 = 0.0, bent2 = 0.0;
    if (options->exact) {
        for (int i = 0; i < p; ++i)
            v[i] = step[i] / system.scale[i];
        eg_product(p, 1, p, v, v, outer);
        eg_product(p, p * p, 1, state->bend, outer, bent);
        apply(&system, p, bent);
        for (int i = 0; i < p; ++i) {
            bent[i] *= 0.5;
            straight2 += step[i] * step[i];
            bent2 += bent[i] * bent[i];
        }
        if (bent2 <= BENT * straight2)
            for (int i = 0; i < p; ++i)
                step[i] += bent[i];
    }
    for (int i = 0; i < p; ++i)
        step[i] /= system.scale[i];
}

static double cost_of(eg_matches *matches, const eg_options *options, const double *F)
{
    const double cost = eg_distances(matches, options, F);
    return isfinite(cost) ? cost : INFINITY;
}

/* A minimisation over F: the estimate, and a trial. */
typedef struct {
    eg_matches *matches;
    const eg_options *options;
    const eg_chart *chart;
    double *motion, moved[EG_MOTION], F[9];
    eg_outcome *state;
} minimization;

static double cost_at_start(void *self)
{
    minimization *m = self;
    fundamental(m->options, m->chart, m->motion, m->state->F);
    return cost_of(m->matches, m->options, m->state->F);
}

static eg_lm_system linearized(void *self, double lam)
{
    (void)lam;
    minimization *m = self;
    const int p = m->chart->p;
    eg_lm_system system = {0.0, 0.0, 0.0};
    linearize(m->matches, m->options, m->chart, m->motion, m->state);
    for (int i = 0; i < p; ++i)
        system.steepest = fmax(system.steepest, fabs(m->state->gradient[i]));
    system.size = largest(m->state, p);
    system.decrement = decrement(m->state, p);
    return system;
}

static int step_of(void *self, double lam, double *norm)
{
    minimization *m = self;
    const int p = m->chart->p;
    double step[7], sum = 0.0;
    if (!all_finite(p * p, m->state->hessian) || !all_finite(p, m->state->gradient))
        return EG_STEP_HOPELESS;
    solve(m->state, p, lam, m->options, step);
    retract(m->options, m->chart, m->motion, step, m->moved);
    for (int i = 0; i < p; ++i)
        sum += step[i] * step[i];
    *norm = sqrt(sum);
    return EG_STEP_MADE;
}

static double cost_at_trial(void *self)
{
    minimization *m = self;
    fundamental(m->options, m->chart, m->moved, m->F);
    return cost_of(m->matches, m->options, m->F);
}

static void accept(void *self)
{
    minimization *m = self;
    memcpy(m->motion, m->moved, sizeof m->moved);
    memcpy(m->state->F, m->F, sizeof m->F);
}

void eg_minimize(eg_matches *matches, const eg_options *options, const eg_chart *chart,
                 double *motion, double *history, eg_outcome *outcome)
{
    double total = 0.0;
    EG_SUM(total)
    for (ptrdiff_t i = 0; i < matches->m; ++i)
        total += matches->weights[i];
    memset(outcome, 0, sizeof *outcome);
    minimization own = {matches, options, chart, motion, {0.0}, {0.0}, outcome};
    /* Rounding of coordinates of size ~2 moves a distance by ~1e-15, as in eliminated.py. */
    const eg_lm_problem problem = {&own, 0.5 * total * 1e-30, cost_at_start, linearized, step_of,
                                   cost_at_trial, accept, NULL, 0};
    const eg_lm_options how = {options->ftol, options->xtol, options->gtol, LAM_START, LAM_FLOOR,
                               !options->scaled, options->max_iter};
    eg_lm_outcome found;
    eg_lm(&problem, &how, history, &found);
    outcome->nfev = found.nfev;
    outcome->njev = found.njev;
    outcome->nit = found.nit;
    outcome->status = found.status;
    outcome->current = found.current;
    outcome->cost = found.cost;
}
