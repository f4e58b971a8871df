#define _POSIX_C_SOURCE 199309L

#include "lm.h"

#include <math.h>
#include <string.h>
#include <time.h>

/* As in lm.py. */
#define LAM_CEILING 1e16
#define LAM_FACTOR 10.0
#define TINIEST 1e-300
#define ROUNDING 1e-15
#define NOISE 1e-12

static double now(void)
{
#ifdef CLOCK_MONOTONIC
    struct timespec moment;
    clock_gettime(CLOCK_MONOTONIC, &moment);
    return (double)moment.tv_sec + 1e-9 * (double)moment.tv_nsec;
#else
    return (double)clock() / CLOCKS_PER_SEC;
#endif
}

/* Lambda, and how the next one is chosen: by a constant factor, then, once a step has been rejected
   and the problem is adaptive, by the gain ratio with a growth that doubles (Nielsen). */
typedef struct {
    double lam, growth;
    int smooth;
} schedule;

static void rejected(schedule *s, const eg_lm_problem *problem)
{
    if (s->smooth) {
        s->lam *= s->growth;
        s->growth *= 2.0;
        return;
    }
    s->lam *= LAM_FACTOR;
    s->smooth = problem->adaptive;
    s->growth = 2.0;
}

static void accepted(schedule *s, const eg_lm_problem *problem, double decrease)
{
    if (!s->smooth) {
        s->lam /= LAM_FACTOR;
        return;
    }
    const double promised = problem->promised(problem->self);
    const double gain = 2.0 * (promised > 0.0 ? decrease / promised : 1.0) - 1.0;
    s->growth = 2.0;
    s->lam *= fmax(1.0 / 3.0, 1.0 - gain * gain * gain);
}

static double finite_or_infinity(double cost)
{
    return isfinite(cost) ? cost : INFINITY;
}

static void record(double *history, eg_lm_outcome *outcome, double cost, double lam, double norm,
                   int accepted, double begun)
{
    if (history) {
        double *row = history + (ptrdiff_t)EG_ROW * outcome->nfev;
        row[0] = outcome->nit;
        row[1] = cost;
        row[2] = lam;
        row[3] = norm;
        row[4] = accepted;
        row[5] = now() - begun;
    }
    outcome->nfev += 1;
    outcome->current = accepted;
}

static int loop(const eg_lm_problem *problem, const eg_lm_options *options, double *history,
                eg_lm_outcome *outcome)
{
    void *self = problem->self;
    const double begun = history ? now() : 0.0;
    outcome->cost = finite_or_infinity(problem->cost_at_start(self));
    record(history, outcome, outcome->cost, 0.0, 0.0, 1, begun);
    const int known = !options->relative && options->max_iter > 0;
    eg_lm_system system = problem->linearize(self, known ? options->start : 0.0);
    outcome->njev = 1;
    if (!isfinite(outcome->cost))
        return -3;
    schedule next = {options->start * (options->relative ? fmax(system.size, TINIEST) : 1.0), 2.0, 0};
    const double least = options->floor * next.lam;
    for (;;) {
        double trial = 0.0, decrease = 0.0, norm = 0.0;
        if (outcome->cost <= problem->floor)
            return 5;
        if (system.steepest <= options->gtol)
            return 1;
        if (system.decrement <= options->ftol * outcome->cost)
            return 4;
        const double ceiling = fmin(LAM_CEILING * fmax(system.size, TINIEST), 1e300);
        for (int tried = 0;;) {
            if (outcome->nit >= options->max_iter)
                return 0;
            const int made = problem->step(self, next.lam, &norm);
            if (made == EG_STEP_HOPELESS)
                return -1;
            if (made == EG_STEP_MADE) {
                outcome->nit += 1;
                trial = finite_or_infinity(problem->cost_at_trial(self));
                decrease = outcome->cost - trial;
                record(history, outcome, trial, next.lam, norm, decrease > 0.0, begun);
                if (decrease > 0.0)
                    break;
                if (fabs(decrease) <= ROUNDING * outcome->cost)
                    return 2;
                /* More damping makes any promise small: only that of the first step tells. */
                if (!tried && problem->promised && -decrease <= NOISE * outcome->cost
                    && problem->promised(self) <= ROUNDING * outcome->cost)
                    return 2;
                tried = 1;
            }
            rejected(&next, problem);
            if (!(next.lam <= ceiling))
                return -1;
        }
        accepted(&next, problem, decrease);
        next.lam = fmax(next.lam, least);
        outcome->cost = trial;
        problem->accept(self);
        const int status = decrease <= options->ftol * outcome->cost ? 2 : norm <= options->xtol ? 3 : 0;
        system = problem->linearize(self, status || outcome->nit >= options->max_iter ? 0.0 : next.lam);
        outcome->njev += 1;
        if (status)
            return status;
    }
}

void eg_lm(const eg_lm_problem *problem, const eg_lm_options *options, double *history,
           eg_lm_outcome *outcome)
{
    memset(outcome, 0, sizeof *outcome);
    outcome->status = loop(problem, options, history, outcome);
}
