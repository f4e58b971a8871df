/* Two views with points as unknowns: the sums over the matches that a step of bundle adjustment
   needs, block by block, so that no Jacobian is kept.

   The readable reference is Python: joint.py and free.py of epigauge.two_view, and Arrow of
   linear.py. A test compares both, evaluation by evaluation. */
#include <string.h>

#include "two_view.h"

/* Matches of a block: what the kernels of a pass write stays in the cache. */
#define LANES 128

/* Most entries of a factor: ten rows with their upper triangle. */
#define MOST_LEFT 65

enum { RIGHT = 14, MOMENTS = 10, POINT = 4 };

/* Kernels of models/joint.py for one problem. */
typedef struct {
    int unknowns; /* of a point */
    int views;    /* that move */
    int rows;     /* of the reduced equations' factors */
    void (*squared)(ptrdiff_t, const double *, const double *, const double *, double *);
    void (*normal)(ptrdiff_t, const double *, const double *, const double *, const double *,
                   double *, double *, double *, double *);
    void (*reduced)(ptrdiff_t, const double *, const double *, const double *, const double *,
                    const double *, double *, double *);
    void (*step)(ptrdiff_t, const double *, const double *, const double *, const double *,
                 const double *, const double *, double *);
    void (*curvature)(ptrdiff_t, const double *, const double *, const double *, const double *,
                      const double *, double *);
} problem_t;

static const problem_t problems[] = {
    {3, 1, 3, eg_canonic_squared, eg_canonic_normal, eg_canonic_reduced, eg_canonic_step,
     eg_canonic_change},
    {4, 2, 6, eg_free_squared, eg_free_normal, eg_free_reduced, eg_free_step, eg_free_change},
    {4, 2, 10, eg_free_squared, eg_free_normal, eg_normalized_reduced, eg_free_step,
     eg_free_change},
};

/* Matches and how they are fitted, as fused.py has it. */
typedef struct {
    ptrdiff_t m;
    const double *q;       /* (4, m) */
    const double *weights; /* (m) */
    double loss_scale2;
    int problem, loss;
} eg_joint;

static ptrdiff_t block(const eg_joint *joint, ptrdiff_t begin)
{
    return joint->m - begin < LANES ? joint->m - begin : LANES;
}

/* Columns begin.. of rows as long as all matches, and back. */
static void gather(const eg_joint *joint, int rows, ptrdiff_t begin, ptrdiff_t n,
                   const double *whole, double *part)
{
    for (int k = 0; k < rows; ++k)
        memcpy(part + k * n, whole + k * joint->m + begin, (size_t)n * sizeof(double));
}

static void scatter(const eg_joint *joint, int rows, ptrdiff_t begin, ptrdiff_t n,
                    const double *part, double *whole)
{
    for (int k = 0; k < rows; ++k)
        memcpy(whole + k * joint->m + begin, part + k * n, (size_t)n * sizeof(double));
}

static void zero(ptrdiff_t count, double *values)
{
    memset(values, 0, (size_t)count * sizeof(double));
}

/* Sums of L x Q Q^T, with `factors` entries of L, and of e x Q, with `rows` of e. */
static void add_products(int factors, int rows, ptrdiff_t n, const double *left,
                         const double *right, double *matrix, double *vector)
{
    double sums[MOMENTS];
    for (int k = 0; k < factors; ++k) {
        eg_factor_products(n, left + k * n, right, sums);
        for (int l = 0; l < MOMENTS; ++l)
            matrix[MOMENTS * k + l] += sums[l];
    }
    for (int k = 0; k < rows; ++k) {
        eg_factor_points(n, left + (factors + k) * n, right + MOMENTS * n, sums);
        for (int l = 0; l < POINT; ++l)
            vector[POINT * k + l] += sums[l];
    }
}

/* Half the weighted robust sum of squares; weights in the normal equations of each match. */
EG_EXPORT double eg_joint_cost(const eg_joint *joint, const double *cameras, const double *points,
                               double *weight)
{
    const problem_t *problem = &problems[joint->problem];
    double own[4 * LANES], q[4 * LANES], squared[LANES], value[LANES], first[LANES], second[LANES];
    double sum = 0.0;
    for (ptrdiff_t begin = 0; begin < joint->m; begin += LANES) {
        const ptrdiff_t n = block(joint, begin);
        const double *weights = joint->weights + begin;
        double part = 0.0;
        gather(joint, problem->unknowns, begin, n, points, own);
        gather(joint, 4, begin, n, joint->q, q);
        problem->squared(n, cameras, own, q, squared);
        eg_losses(joint->loss, joint->loss_scale2, n, squared, value, first, second);
        for (ptrdiff_t i = 0; i < n; ++i) {
            part += weights[i] * value[i];
            weight[begin + i] = weights[i] * first[i];
        }
        sum += part;
    }
    return 0.5 * sum;
}

/* Gradient and diagonal by the points (unknowns, m), and sums over the points for each camera:
   J^T J (6 a view, 10) and gradient (3 a view, 4). */
EG_EXPORT void eg_joint_normal(const eg_joint *joint, const double *cameras, const double *points,
                               const double *weight, double *gradient, double *diagonal,
                               double *matrix, double *vector)
{
    const problem_t *problem = &problems[joint->problem];
    const int k = problem->unknowns, factors = 6 * problem->views, rows = 3 * problem->views;
    double own[4 * LANES], q[4 * LANES], by_point[4 * LANES], own_diagonal[4 * LANES];
    double left[18 * LANES], right[RIGHT * LANES];
    zero(factors * MOMENTS, matrix);
    zero(rows * POINT, vector);
    for (ptrdiff_t begin = 0; begin < joint->m; begin += LANES) {
        const ptrdiff_t n = block(joint, begin);
        gather(joint, k, begin, n, points, own);
        gather(joint, 4, begin, n, joint->q, q);
        problem->normal(n, cameras, own, q, weight + begin, by_point, own_diagonal, left, right);
        scatter(joint, k, begin, n, by_point, gradient);
        scatter(joint, k, begin, n, own_diagonal, diagonal);
        add_products(factors, rows, n, left, right, matrix, vector);
    }
}

/* The same for the Schur complement, its factor's upper triangle, and the reduced gradient. */
EG_EXPORT void eg_joint_reduce(const eg_joint *joint, const double *cameras, const double *points,
                               const double *weight, const double *damping, double *matrix,
                               double *vector)
{
    const problem_t *problem = &problems[joint->problem];
    const int rows = problem->rows, factors = rows * (rows + 1) / 2;
    double own[4 * LANES], q[4 * LANES], left[MOST_LEFT * LANES], right[RIGHT * LANES];
    zero(factors * MOMENTS, matrix);
    zero(rows * POINT, vector);
    for (ptrdiff_t begin = 0; begin < joint->m; begin += LANES) {
        const ptrdiff_t n = block(joint, begin);
        gather(joint, problem->unknowns, begin, n, points, own);
        gather(joint, 4, begin, n, joint->q, q);
        problem->reduced(n, cameras, own, q, weight + begin, damping, left, right);
        add_products(factors, rows, n, left, right, matrix, vector);
    }
}

/* Steps of the points (unknowns, m), given that of the cameras. */
EG_EXPORT void eg_joint_step(const eg_joint *joint, const double *cameras, const double *points,
                             const double *weight, const double *damping, const double *move,
                             double *step)
{
    const problem_t *problem = &problems[joint->problem];
    double own[4 * LANES], q[4 * LANES], part[4 * LANES];
    for (ptrdiff_t begin = 0; begin < joint->m; begin += LANES) {
        const ptrdiff_t n = block(joint, begin);
        gather(joint, problem->unknowns, begin, n, points, own);
        gather(joint, 4, begin, n, joint->q, q);
        problem->step(n, cameras, own, q, weight + begin, damping, move, part);
        scatter(joint, problem->unknowns, begin, n, part, step);
    }
}

/* |J step|^2 with the weights. */
EG_EXPORT double eg_joint_curvature(const eg_joint *joint, const double *cameras,
                                    const double *points, const double *weight,
                                    const double *move, const double *step)
{
    const problem_t *problem = &problems[joint->problem];
    double own[4 * LANES], part[4 * LANES], curvature, sum = 0.0;
    for (ptrdiff_t begin = 0; begin < joint->m; begin += LANES) {
        const ptrdiff_t n = block(joint, begin);
        gather(joint, problem->unknowns, begin, n, points, own);
        gather(joint, problem->unknowns, begin, n, step, part);
        problem->curvature(n, cameras, own, weight + begin, move, part, &curvature);
        sum += curvature;
    }
    return sum;
}
