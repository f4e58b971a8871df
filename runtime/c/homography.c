/* A homography of matches with points off the plane and wrong matches among them.

   The reference is runtime/epigauge/two_view/homography.py, which also says what the numbers mean. */
#include "small.h"
#include "two_view.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
    ptrdiff_t n;
    const double *q1, *q2, *weights; /* (2, n), (2, n), n */
    double *sorted;                  /* n */
} plane_t;

/* H that minimises the equations of weighed matches, each divided as the H given says, and their
   J^T J (81). */
static void least(ptrdiff_t n, const double *q1, const double *q2, const double *weights, double *H,
                  double *N)
{
    double packed[45], values[9], vectors[81];
    eg_homography_normal(n, H, q1, q2, weights, packed);
    for (int i = 0, k = 0; i < 9; ++i)
        for (int j = i; j < 9; ++j, ++k)
            N[9 * i + j] = N[9 * j + i] = packed[k];
    eg_eigen(9, N, values, vectors);
    for (int i = 0; i < 9; ++i)
        H[i] = vectors[9 * i];
}

/* Squared distances to H, and their median. */
static double measured(const plane_t *p, const double *H, double *squares)
{
    eg_homography_squared(p->n, H, p->q1, p->q2, squares);
    for (ptrdiff_t i = 0; i < p->n; ++i)
        if (isnan(squares[i]))
            squares[i] = INFINITY;
    memcpy(p->sorted, squares, (size_t)p->n * sizeof *squares);
    return eg_median(p->sorted, p->n);
}

/* Weights that fall where squares are so many times their median. */
static void falling(const plane_t *p, const double *squares, double scale, double *own)
{
    for (ptrdiff_t i = 0; i < p->n; ++i) {
        const double ratio = 1.0 + squares[i] / scale;
        own[i] = p->weights[i] / (ratio * ratio);
    }
}

/* Fit with the weights in own, and again with those that the distances give; returns the median. */
static double reweighted(const plane_t *p, const eg_plane_options *options, double reach,
                         double *own, double *H, double *squares)
{
    double last = INFINITY, median = INFINITY, N[81];
    memcpy(H, options->equal, 9 * sizeof *H);
    for (int round = 0; round < options->rounds; ++round) {
        least(p->n, p->q1, p->q2, own, H, N);
        median = measured(p, H, squares);
        const double middle = fmax(median, options->rounding2);
        if (fabs(middle - last) <= options->stands * middle)
            break;
        falling(p, squares, reach * middle, own);
        last = middle;
    }
    return median;
}

/* The homography (9) that fits matches q1, q2 (2, n), from what is in H, by so many fits; squared
   distances (n) and J^T J (81). */
EG_EXPORT void eg_fit_homography(ptrdiff_t n, const double *q1, const double *q2,
                                 const double *weights, ptrdiff_t fits, double *H, double *squares,
                                 double *N)
{
    for (ptrdiff_t k = 0; k < fits; ++k)
        least(n, q1, q2, weights, H, N);
    eg_homography_squared(n, H, q1, q2, squares);
}

/* The homography (9) of the plane that most matches q1, q2 (2, n) are in, and the squared distances
   (n) to it. It is tried from fours (samples, 4) of them. Returns 0 where memory ran out. */
EG_EXPORT int eg_robust_homography(ptrdiff_t n, const double *q1, const double *q2,
                                   const double *weights, ptrdiff_t samples,
                                   const ptrdiff_t *fours, const eg_plane_options *options,
                                   double *H, double *squares)
{
    double *room = malloc((size_t)(4 * n + 1) * sizeof *room);
    if (!room)
        return 0;
    const plane_t p = {n, q1, q2, weights, room};
    double *own = room + n, *other = room + 2 * n, *nearest = room + 3 * n, lowest = INFINITY;
    for (ptrdiff_t k = 0; k < samples; ++k) {
        const double equal[4] = {1.0, 1.0, 1.0, 1.0};
        double a[8], b[8], trial[9], N[81];
        for (int i = 0; i < 4; ++i) {
            const ptrdiff_t row = fours[4 * k + i];
            a[i] = q1[row], a[4 + i] = q1[n + row];
            b[i] = q2[row], b[4 + i] = q2[n + row];
        }
        memcpy(trial, options->equal, sizeof trial);
        least(4, a, b, equal, trial, N);
        const double median = measured(&p, trial, other);
        if (k && !(median < lowest))
            continue;
        lowest = median;
        memcpy(nearest, other, (size_t)n * sizeof *other);
    }
    memcpy(own, weights, (size_t)n * sizeof *own);
    const double all = reweighted(&p, options, options->sharp, own, H, squares);
    falling(&p, nearest, options->sharp * fmax(lowest, options->rounding2), own);
    double median = reweighted(&p, options, options->sharp, own, H, other);
    if (median < all)
        memcpy(squares, other, (size_t)n * sizeof *other);
    else
        median = all;
    falling(&p, squares, options->wide * fmax(median, options->rounding2), own);
    reweighted(&p, options, options->wide, own, H, squares);
    free(room);
    return 1;
}
