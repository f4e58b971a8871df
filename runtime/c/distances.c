/* Distances of the matches from an epipolar geometry, and the sums that a step needs.

   The reference is runtime/epigauge/two_view/criteria.py. */
#include "two_view.h"

#include <math.h>
#include <string.h>

/* As in criteria.py. */
#define SETTLED 1e-6
#define SINGULAR 1e14

#define PACKED 45

typedef struct {
    double R1[4], R2[4], s[2], b1[2], b2[2], f[1];
} frame_t;

static frame_t frame_of(const double *F)
{
    frame_t frame;
    eg_bilinear_frame(1, F, frame.R1, frame.R2, frame.s, frame.b1, frame.b2, frame.f);
    return frame;
}

static int is_settled(double change, double multiplier, double d)
{
    return fabs(change * d) <= (SETTLED * fabs(d) + 1e-15) * fabs(multiplier);
}

/* More iterations, then bracketed ones, for the foot points that the fast ones have not settled. */
static void settle(const frame_t *f, ptrdiff_t n, const double *q1, const double *q2,
                   const double *change, double *multiplier, double *d)
{
    for (ptrdiff_t i = 0; i < n; ++i) {
        if (is_settled(change[i], multiplier[i], d[i]))
            continue;
        const double first[2] = {q1[i], q1[n + i]}, second[2] = {q2[i], q2[n + i]};
        double last;
        eg_foot_point_more(1, f->R1, f->R2, f->s, f->b1, f->b2, f->f, first, second,
                           multiplier + i, &last, d + i);
        if (!is_settled(last, multiplier[i], d[i]))
            eg_foot_point_safe(1, f->R1, f->R2, f->s, f->b1, f->b2, f->f, first, second,
                               multiplier + i, &last, d + i);
    }
}

/* Signed distances of a block of matches, and their squares. */
static void block_distances(const eg_matches *matches, const eg_options *options, const double *F,
                            const frame_t *f, ptrdiff_t begin, ptrdiff_t n, double *squared)
{
    const double *q1 = eg_block_points(matches, begin), *q2 = q1 + 2 * n;
    double *d = matches->d + begin;
    double change[2 * EG_BLOCK], unused[18 * EG_BLOCK];
    switch (options->criterion) {
    case EG_REPROJECTION:
        eg_foot_point(n, f->R1, f->R2, f->s, f->b1, f->b2, f->f, q1, q2,
                      matches->multiplier + begin, change, d);
        settle(f, n, q1, q2, change, matches->multiplier + begin, d);
        break;
    case EG_SAMPSON:
        eg_sampson(n, F, q1, q2, d, unused);
        break;
    default:
        eg_epipolar(n, F, q1, q2, change, unused);
        for (ptrdiff_t i = 0; i < n; ++i)
            d[i] = copysign(sqrt(change[i] * change[i] + change[n + i] * change[n + i]), change[i]);
    }
    for (ptrdiff_t i = 0; i < n; ++i)
        squared[i] = d[i] * d[i];
}

double eg_distances(eg_matches *matches, const eg_options *options, const double *F)
{
    double squared[EG_BLOCK], value[EG_BLOCK], first[EG_BLOCK], second[EG_BLOCK], sum = 0.0;
    const frame_t frame = frame_of(F);
    for (ptrdiff_t begin = 0; begin < matches->m; begin += EG_BLOCK) {
        const ptrdiff_t n = eg_block_size(matches, begin);
        const double *weights = matches->weights + begin;
        double part = 0.0;
        block_distances(matches, options, F, &frame, begin, n, squared);
        eg_losses(options->loss, options->loss_scale2, n, squared, value, first, second);
        EG_SUM(part)
        for (ptrdiff_t i = 0; i < n; ++i)
            part += weights[i] * value[i];
        sum += part;
    }
    return 0.5 * sum;
}

/* Weights of the block's squared distances, and 2 rho'' where the Hessian is exact. */
static void block_weights(const eg_matches *matches, const eg_options *options, ptrdiff_t begin,
                          ptrdiff_t n, double *weight, double *curvature)
{
    double squared[EG_BLOCK], value[EG_BLOCK], first[EG_BLOCK], second[EG_BLOCK];
    const double *weights = matches->weights + begin, *d = matches->d + begin;
    for (ptrdiff_t i = 0; i < n; ++i)
        squared[i] = d[i] * d[i];
    eg_losses(options->loss, options->loss_scale2, n, squared, value, first, second);
    for (ptrdiff_t i = 0; i < n; ++i) {
        weight[i] = weights[i] * first[i];
        curvature[i] = 2.0 * weights[i] * second[i];
    }
}

/* Take the weight of matches on both epipoles, where the distance has no derivative. */
static int drop_singular(const frame_t *f, ptrdiff_t n, const double *q1, const double *q2,
                         const double *multiplier, double *weight, double *curvature)
{
    double hat[4 * EG_BLOCK], by_entries[9 * EG_BLOCK];
    int dropped = 0;
    eg_foot_point_derivative(n, f->R1, f->R2, f->s, f->b1, f->b2, f->f, q1, q2, multiplier, hat,
                             hat + 2 * n, by_entries);
    for (ptrdiff_t i = 0; i < n; ++i) {
        double square = 0.0;
        for (int k = 0; k < 9; ++k)
            square += by_entries[k * n + i] * by_entries[k * n + i];
        if (!(square < SINGULAR)) {
            weight[i] = curvature[i] = 0.0;
            dropped = 1;
        }
    }
    return dropped;
}

static void add(int count, const double *part, double *sum)
{
    for (int k = 0; k < count; ++k)
        sum[k] += part[k];
}

/* Sums over all blocks; returns whether some match was left out as singular. */
static int sums(eg_matches *matches, const eg_options *options, const double *F, const frame_t *f,
                int careful, double *g, double *N, double *H)
{
    double weight[EG_BLOCK], curvature[EG_BLOCK];
    double g_part[9], N_part[PACKED], H_part[PACKED], cost;
    int dropped = 0;
    memset(g, 0, 9 * sizeof(double));
    memset(N, 0, PACKED * sizeof(double));
    memset(H, 0, PACKED * sizeof(double));
    for (ptrdiff_t begin = 0; begin < matches->m; begin += EG_BLOCK) {
        const ptrdiff_t n = eg_block_size(matches, begin);
        const double *q1 = eg_block_points(matches, begin), *q2 = q1 + 2 * n;
        const double *l = matches->multiplier + begin;
        block_weights(matches, options, begin, n, weight, curvature);
        if (careful)
            dropped |= drop_singular(f, n, q1, q2, l, weight, curvature);
        if (options->criterion == EG_REPROJECTION && options->exact)
            eg_reprojection_newton(n, f->R1, f->R2, f->s, f->b1, f->b2, f->f, q1, q2, l, weight,
                                   curvature, g_part, N_part, H_part);
        else if (options->criterion == EG_REPROJECTION)
            eg_reprojection_gauss_newton(n, f->R1, f->R2, f->s, f->b1, f->b2, f->f, q1, q2, l,
                                         weight, g_part, N_part);
        else if (options->criterion == EG_SAMPSON && options->exact)
            eg_sampson_newton(n, F, q1, q2, weight, curvature, &cost, g_part, N_part, H_part);
        else if (options->criterion == EG_SAMPSON)
            eg_sampson_gauss_newton(n, F, q1, q2, weight, &cost, g_part, N_part);
        else if (options->exact)
            eg_epipolar_newton(n, F, q1, q2, weight, curvature, &cost, g_part, N_part, H_part);
        else
            eg_epipolar_gauss_newton(n, F, q1, q2, weight, &cost, g_part, N_part);
        add(9, g_part, g);
        add(PACKED, N_part, N);
        if (options->exact)
            add(PACKED, H_part, H);
    }
    return dropped;
}

static void unpack(const double *packed, double *matrix)
{
    for (int i = 0, k = 0; i < 9; ++i)
        for (int j = i; j < 9; ++j, ++k)
            matrix[9 * i + j] = matrix[9 * j + i] = packed[k];
}

/* Turn rows of vect(F) in the rotated images back: X -> R2 X R1^T for each, of `count`. */
static void turn_rows(const frame_t *f, int count, double *rows)
{
    for (int r = 0; r < count; ++r, rows += 9) {
        double half[9];
        for (int j = 0; j < 3; ++j) {
            half[j] = f->R2[0] * rows[j] + f->R2[1] * rows[3 + j];
            half[3 + j] = f->R2[2] * rows[j] + f->R2[3] * rows[3 + j];
            half[6 + j] = rows[6 + j];
        }
        for (int i = 0; i < 3; ++i) {
            rows[3 * i] = f->R1[0] * half[3 * i] + f->R1[1] * half[3 * i + 1];
            rows[3 * i + 1] = f->R1[2] * half[3 * i] + f->R1[3] * half[3 * i + 1];
            rows[3 * i + 2] = half[3 * i + 2];
        }
    }
}

static void turn_both(const frame_t *f, double *matrix)
{
    turn_rows(f, 9, matrix);
    for (int i = 0; i < 9; ++i)
        for (int j = 0; j < i; ++j) {
            const double kept = matrix[9 * i + j];
            matrix[9 * i + j] = matrix[9 * j + i];
            matrix[9 * j + i] = kept;
        }
    turn_rows(f, 9, matrix);
}

void eg_normal(eg_matches *matches, const eg_options *options, const double *F, double *g,
               double *N, double *H)
{
    double N_packed[PACKED], H_packed[PACKED];
    const frame_t frame = frame_of(F);
    sums(matches, options, F, &frame, 0, g, N_packed, H_packed);
    if (options->criterion == EG_REPROJECTION) {
        double trace = 0.0;
        for (int i = 0, k = 0; i < 9; k += 9 - i, ++i)
            trace += N_packed[k];
        if (!(trace < SINGULAR))
            sums(matches, options, F, &frame, 1, g, N_packed, H_packed);
    }
    unpack(N_packed, N);
    unpack(options->exact ? H_packed : N_packed, H);
    if (options->criterion == EG_REPROJECTION) {
        turn_rows(&frame, 1, g);
        turn_both(&frame, N);
        turn_both(&frame, H);
    }
}
