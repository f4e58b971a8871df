/* The one Levenberg-Marquardt loop in C; runtime/epigauge/lm.py is its readable reference. */
#ifndef EPIGAUGE_LM_H
#define EPIGAUGE_LM_H

#include <stddef.h>

/* iteration, cost, lambda, length of the step, accepted, seconds */
#define EG_ROW 6

/* What the loop asks of a problem linearised at its estimate: largest entries of the gradient and of
   the Hessian's diagonal, and the decrease that the undamped step promises (infinity: unknown). */
typedef struct {
    double steepest, size, decrement;
} eg_lm_system;

/* What a step comes to: a trial; a singular system, which more damping mends; nothing can. */
enum { EG_STEP_MADE, EG_STEP_SINGULAR, EG_STEP_HOPELESS };

/* A problem with an estimate and a trial of its own. Costs are half of what is minimised; infinity
   rejects. `linearize` is told the lambda of the first step that follows, 0 where none does or it is
   not known yet. */
typedef struct {
    void *self;
    double floor; /* a cost this low is rounding error */
    double (*cost_at_start)(void *self);
    eg_lm_system (*linearize)(void *self, double lam);
    int (*step)(void *self, double lam, double *norm);
    double (*cost_at_trial)(void *self);
    void (*accept)(void *self);
    double (*promised)(void *self); /* the decrease that the step last made promises, or NULL */
    int adaptive; /* whether the schedule is lm.py's Adaptive, which asks for promises; else Classic */
} eg_lm_problem;

typedef struct {
    double ftol, xtol, gtol;
    double start, floor; /* first lambda, and the least relative to it */
    int relative;        /* whether the first one is in units of the system's size */
    int max_iter;
} eg_lm_options;

typedef struct {
    int nfev, njev, nit, status;
    int current; /* whether the cost last computed is that of the estimate */
    double cost;
} eg_lm_outcome;

/* Minimise; the history has max_iter + 1 rows, or is NULL. Statuses are those of lm.py. */
void eg_lm(const eg_lm_problem *problem, const eg_lm_options *options, double *history,
           eg_lm_outcome *outcome);

#endif
