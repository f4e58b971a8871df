/* Pairs in pixels: conditioning, start value, minimum, and back; and matches already conditioned.

   The references are conditioning.py, initial.py and refine.py of epigauge.two_view. Whatever is not
   plainly in order (NaN, points on a line, a start of rank one, ...) is left to them, with their
   error messages. */
#include "small.h"
#include "two_view.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* Points are plainly spread in two dimensions when their scatter has eigenvalues above this ratio,
   and an extent above this much of their largest coordinate. */
#define SPREAD 1e-8
#define EXTENT 1e-6

/* Doubles a pair: F, U, V in pixels, sigma, cost and sum of squared distances in conditioned units,
   number of matches that count, origins and scale, motion, conditioned F, J^T J by its entries. */
enum { PAIR_F = 0, PAIR_U = 9, PAIR_V = 18, PAIR_SIGMA = 27, PAIR_COST = 28, PAIR_SQUARES = 29,
       PAIR_COUNT = 30, PAIR_FRAME = 31, PAIR_MOTION = 36, PAIR_CONDITIONED = 55,
       PAIR_NORMAL = 64, PAIR_DOUBLES = 145 };

/* Integers a pair: 1 where it was left alone; evaluations, linearisations, steps, status. */
enum { PAIR_LEFT = 0, PAIR_NFEV, PAIR_NJEV, PAIR_NIT, PAIR_STATUS, PAIR_INTS };

typedef struct {
    double o1[2], o2[2], scale;
} conditioning_t;

static int counts(const double *weights, ptrdiff_t i)
{
    return !weights || weights[i] > 0.0;
}

/* Centroid and mean squared deviation a coordinate; 0 where the points are not plainly spread. */
static int centre(ptrdiff_t m, const double *x, const double *weights, double *origin,
                  double *square, ptrdiff_t *number)
{
    double sx = 0.0, sy = 0.0, size = 0.0;
    ptrdiff_t n = 0;
    EG_SUM(sx, sy, n)
    for (ptrdiff_t i = 0; i < m; ++i)
        if (counts(weights, i)) {
            sx += x[2 * i];
            sy += x[2 * i + 1];
            ++n;
        }
    if (n < 8)
        return 0;
    origin[0] = sx / (double)n;
    origin[1] = sy / (double)n;
    double xx = 0.0, xy = 0.0, yy = 0.0, total = 0.0;
    EG_SUM(xx, xy, yy, total)
    for (ptrdiff_t i = 0; i < m; ++i) {
        const double a = x[2 * i] - origin[0], b = x[2 * i + 1] - origin[1];
        total += a + b; /* NaN and infinity of matches that do not count, too */
        if (counts(weights, i)) {
            xx += a * a;
            xy += a * b;
            yy += b * b;
        }
    }
    size = fmax(fabs(origin[0]), fabs(origin[1]));
    const double trace = xx + yy, determinant = xx * yy - xy * xy;
    *square = trace / (2.0 * (double)n);
    *number = n;
    return isfinite(trace) && isfinite(total) && isfinite(determinant) &&
           determinant > SPREAD * trace * trace && sqrt(*square) > EXTENT * size;
}

static void from_pixels(const conditioning_t *c, const double *F, double *conditioned)
{
    const double one = 1.0;
    eg_fundamental_of_coordinates(1, F, &c->scale, &one, c->o1, c->o2, conditioned);
}

static void to_pixels(const double *o1, const double *o2, double scale, const double *F,
                      double *pixels)
{
    const double one = 1.0, shift1[2] = {-o1[0], -o1[1]}, shift2[2] = {-o2[0], -o2[1]};
    eg_fundamental_of_coordinates(1, F, &one, &scale, shift1, shift2, pixels);
}

/* The matches in coordinates of their own origin and scale for each image. */
static void fill(eg_matches *matches, const double *o1, const double *o2, double s1, double s2,
                 const double *x1, const double *x2, const double *weights)
{
    for (ptrdiff_t begin = 0; begin < matches->m; begin += EG_BLOCK) {
        const ptrdiff_t n = eg_block_size(matches, begin);
        double *q = eg_block_points(matches, begin);
        for (ptrdiff_t i = 0; i < n; ++i) {
            const double *first = x1 + 2 * (begin + i), *second = x2 + 2 * (begin + i);
            q[i] = (first[0] - o1[0]) / s1;
            q[n + i] = (first[1] - o1[1]) / s1;
            q[2 * n + i] = (second[0] - o2[0]) / s2;
            q[3 * n + i] = (second[1] - o2[1]) / s2;
            matches->weights[begin + i] = weights ? weights[begin + i] : 1.0;
        }
    }
}

/* The normalised 8-point estimate in pixels (initial.py). Weights only tell which matches count:
   the estimate is a start value. */
static void eight_point(eg_matches *matches, const double *x1, const double *x2,
                        const double *weights, const double *o1, const double *o2, double s1,
                        double s2, double *F)
{
    double N[45] = {0.0}, part[45], A[81], values[9], vectors[81], U[9], V[9], sigma, f[9];
    fill(matches, o1, o2, s1, s2, x1, x2, weights);
    for (ptrdiff_t i = 0; i < matches->m; ++i)
        matches->weights[i] = counts(weights, i);
    for (ptrdiff_t begin = 0; begin < matches->m; begin += EG_BLOCK) {
        const ptrdiff_t n = eg_block_size(matches, begin);
        const double *q = eg_block_points(matches, begin);
        eg_algebraic_normal(n, q, q + 2 * n, matches->weights + begin, part);
        for (int k = 0; k < 45; ++k)
            N[k] += part[k];
    }
    for (int i = 0, k = 0; i < 9; ++i)
        for (int j = i; j < 9; ++j, ++k)
            A[9 * i + j] = A[9 * j + i] = N[k];
    eg_eigen(9, A, values, vectors);
    for (int k = 0; k < 9; ++k)
        f[k] = vectors[9 * k];
    /* A^T A squares the condition; its product with f from the matches themselves restores the
       digits that this costs (corrected seminormal equations). */
    double gradient[9] = {0.0};
    for (ptrdiff_t begin = 0; begin < matches->m; begin += EG_BLOCK) {
        const ptrdiff_t n = eg_block_size(matches, begin);
        const double *q = eg_block_points(matches, begin);
        eg_algebraic_gradient(n, f, q, q + 2 * n, matches->weights + begin, part);
        for (int k = 0; k < 9; ++k)
            gradient[k] += part[k];
    }
    for (int l = 1; l < 9; ++l) {
        double along = 0.0;
        for (int k = 0; k < 9; ++k)
            along += vectors[9 * k + l] * gradient[k];
        for (int k = 0; k < 9; ++k)
            f[k] -= along / (values[l] - values[0]) * vectors[9 * k + l];
    }
    /* As in initial.py: the first large entry is positive. */
    double size = 0.0, sign = 0.0;
    for (int k = 0; k < 9; ++k)
        size = fmax(size, fabs(f[k]));
    for (int k = 0; k < 9 && sign == 0.0; ++k)
        if (fabs(f[k]) > 0.5 * size)
            sign = copysign(1.0, f[k]);
    for (int k = 0; k < 9; ++k)
        f[k] *= sign;
    if (eg_factorize(f, U, V, &sigma))
        for (int i = 0; i < 3; ++i) {
            double along = 0.0;
            for (int j = 0; j < 3; ++j)
                along += f[3 * i + j] * V[3 * j + 2];
            for (int j = 0; j < 3; ++j)
                f[3 * i + j] -= along * V[3 * j + 2];
        }
    /* Own scale for each image: lower the second to the first's, then map both. */
    for (int k = 0; k < 6; ++k)
        f[k] *= s1 / s2;
    to_pixels(o1, o2, s1, f, F);
}

/* Move the second origin off the centroid, across the epipolar lines (conditioning.py). */
static void displace(conditioning_t *c, const double *F, double offset)
{
    double x = F[2], y = F[5];
    const double length = sqrt(x * x + y * y);
    if (length > 0.0) {
        x /= length;
        y /= length;
    } else {
        x = 1.0;
        y = 0.0;
    }
    if ((fabs(x) >= fabs(y) ? x : y) < 0.0) {
        x = -x;
        y = -y;
    }
    c->o2[0] -= c->scale * offset * x;
    c->o2[1] -= c->scale * offset * y;
}

/* Returns 0 where the pair is left alone. */
static int refine(eg_matches *matches, const double *x1, const double *x2, const double *weights,
                  const double *F0, const eg_options *options, double *result, int *numbers,
                  double *distances, double *history)
{
    const ptrdiff_t m = matches->m;
    conditioning_t c;
    double square1, square2, F[9], sigma, motion[EG_MOTION];
    ptrdiff_t number;
    if (!centre(m, x1, weights, c.o1, &square1, &number) ||
        !centre(m, x2, weights, c.o2, &square2, &number))
        return 0;
    c.scale = sqrt(0.5 * (square1 + square2)) / options->rms;
    if (F0) {
        double norm = 0.0;
        for (int k = 0; k < 9; ++k)
            norm += F0[k] * F0[k];
        if (!(norm > 1e-200 && norm < 1e200))
            return 0;
        memcpy(F, F0, sizeof F);
    } else {
        eight_point(matches, x1, x2, weights, c.o1, c.o2, sqrt(square1), sqrt(square2), F);
    }
    double *conditioned = result + PAIR_CONDITIONED;
    from_pixels(&c, F, conditioned);
    displace(&c, conditioned, options->offset);
    from_pixels(&c, F, conditioned);
    if (!eg_factorize(conditioned, motion, motion + 9, motion + 18))
        return 0;
    fill(matches, c.o1, c.o2, c.scale, c.scale, x1, x2, weights);
    const eg_chart chart = {7, NULL, NULL};
    eg_outcome outcome;
    eg_minimize(matches, options, &chart, motion, history, &outcome);
    if (!isfinite(outcome.cost))
        return 0;

    double squares = 0.0;
    eg_options exact = *options;
    exact.criterion = EG_REPROJECTION;
    if (!outcome.current || options->criterion != EG_REPROJECTION)
        eg_distances(matches, &exact, outcome.F);
    for (ptrdiff_t i = 0; i < m; ++i)
        if (counts(weights, i))
            squares += matches->d[i] * matches->d[i];
    if (options->criterion != EG_REPROJECTION)
        eg_distances(matches, options, outcome.F);
    for (ptrdiff_t i = 0; i < m; ++i)
        distances[i] = c.scale * matches->d[i];
    memcpy(conditioned, outcome.F, 9 * sizeof(double));
    memcpy(result + PAIR_MOTION, motion, 19 * sizeof(double));
    memcpy(result + PAIR_NORMAL, outcome.normal, 81 * sizeof(double));
    memcpy(result + PAIR_FRAME, &c, 5 * sizeof(double));
    to_pixels(c.o1, c.o2, c.scale, outcome.F, result + PAIR_F);
    if (!eg_factorize(result + PAIR_F, result + PAIR_U, result + PAIR_V, &sigma))
        return 0;
    result[PAIR_SIGMA] = sigma;
    result[PAIR_COST] = outcome.cost;
    result[PAIR_SQUARES] = squares;
    result[PAIR_COUNT] = (double)number;
    numbers[PAIR_NFEV] = outcome.nfev;
    numbers[PAIR_NJEV] = outcome.njev;
    numbers[PAIR_NIT] = outcome.nit;
    numbers[PAIR_STATUS] = outcome.status;
    return 1;
}

/* Room for matches; q is NULL where there is none. */
static eg_matches allocated(ptrdiff_t m)
{
    eg_matches matches = {m, NULL, NULL, NULL, NULL};
    matches.q = malloc((size_t)(7 * m + 1) * sizeof(double));
    if (matches.q) {
        matches.weights = matches.q + 4 * m;
        matches.multiplier = matches.weights + m;
        matches.d = matches.multiplier + m;
    }
    return matches;
}

/* Refine pairs first .. last - 1; pair k has the matches offsets[k] .. offsets[k + 1] - 1 of x1 and
   x2, (m, 2) each in pixels. Weights and F0 may be NULL; so may the history, of one pair. Returns 0
   where memory ran out. */
EG_EXPORT int eg_refine_pairs(ptrdiff_t first, ptrdiff_t last, const ptrdiff_t *offsets,
                              const double *x1, const double *x2, const double *weights,
                              const double *F0, const eg_options *options, double *results,
                              int *numbers, double *distances, double *history)
{
    ptrdiff_t most = 0;
    for (ptrdiff_t k = first; k < last; ++k)
        most = offsets[k + 1] - offsets[k] > most ? offsets[k + 1] - offsets[k] : most;
    eg_matches matches = allocated(most);
    if (!matches.q)
        return 0;
    for (ptrdiff_t k = first; k < last; ++k) {
        const ptrdiff_t begin = offsets[k];
        int *own = numbers + PAIR_INTS * k;
        matches.m = offsets[k + 1] - begin;
        own[PAIR_LEFT] = !refine(&matches, x1 + 2 * begin, x2 + 2 * begin,
                                 weights ? weights + begin : NULL, F0 ? F0 + 9 * k : NULL, options,
                                 results + PAIR_DOUBLES * k, own, distances + begin, history);
    }
    free(matches.q);
    return 1;
}

/* Minimise over conditioned matches q1, q2 (2, m) from a motion; distances (m) are those at the end.
   Returns 0 where memory ran out. */
EG_EXPORT int eg_minimize_matches(ptrdiff_t m, const double *q1, const double *q2,
                                  const double *weights, const eg_options *options, int p,
                                  const double *basis, const double *entries, double *motion,
                                  double *history, eg_outcome *outcome)
{
    const eg_chart chart = {p, basis, entries};
    eg_matches matches = allocated(m);
    if (!matches.q)
        return 0;
    for (ptrdiff_t begin = 0; begin < m; begin += EG_BLOCK) {
        const ptrdiff_t n = eg_block_size(&matches, begin);
        double *q = eg_block_points(&matches, begin);
        for (int k = 0; k < 2; ++k) {
            memcpy(q + k * n, q1 + k * m + begin, (size_t)n * sizeof(double));
            memcpy(q + (2 + k) * n, q2 + k * m + begin, (size_t)n * sizeof(double));
        }
    }
    memcpy(matches.weights, weights, (size_t)m * sizeof(double));
    eg_minimize(&matches, options, &chart, motion, history, outcome);
    free(matches.q);
    return 1;
}
