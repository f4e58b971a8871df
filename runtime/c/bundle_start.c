/* What a first reconstruction is made of: linear intersection, resection, a spread basis. */
#include <math.h>

#include "bundle_chunk.h"
#include "bundle_moments.h"
#include "lm.h"
#include "skyline.h"
#include "small.h"

/* Points of least algebraic error: the lines of sight's linear meeting, unit vectors. */
int eg_bundle_intersect(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *P, double *Q)
{
    double *scratch = eg_scratch(bundle, begin, end, 12 + 1 + 10 + 10 + 4, 0);
    if (!scratch)
        return 1;
    for (ptrdiff_t c = begin; c < end; ++c) {
        const eg_chunk chunk = eg_chunk_of(bundle, c);
        const ptrdiff_t M = chunk.M;
        double *cameras = scratch, *ones = cameras + 12 * M, *sums = ones + M;
        double *own = sums + 10 * M, *points = own + 10 * M;
        ptrdiff_t filled = M;
        for (ptrdiff_t s = 0; s < chunk.L; ++s) {
            filled = eg_filled(&chunk, s, filled);
            for (ptrdiff_t j = 0; j < M; ++j)
                ones[j] = j < filled || !s ? 1.0 : 0.0;
            eg_gather(M, 12, P, chunk.view + s * M, cameras);
            eg_sight_normal(M, cameras, chunk.q + 2 * s * M, ones, s ? own : sums);
            if (s)
                eg_add(10 * M, own, sums);
        }
        eg_least_eigenvector(M, sums, points);
        eg_scatter(&chunk, 4, points, Q);
    }
    eg_release(scratch);
    return 0;
}

/* Distance of each observation to its projected point, at the row of its point's first observation
   and on. */
int eg_bundle_distances(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *P, const double *Q,
    const ptrdiff_t *first, double *distances)
{
    double *scratch = eg_scratch(bundle, begin, end, 12 + 4 + 1, 0);
    if (!scratch)
        return 1;
    for (ptrdiff_t c = begin; c < end; ++c) {
        const eg_chunk chunk = eg_chunk_of(bundle, c);
        const ptrdiff_t M = chunk.M;
        double *points = scratch, *cameras = points + 4 * M, *squared = cameras + 12 * M;
        eg_gather(M, 4, Q, chunk.point, points);
        ptrdiff_t filled = M;
        for (ptrdiff_t s = 0; s < chunk.L; ++s) {
            filled = eg_filled(&chunk, s, filled);
            eg_gather(M, 12, P, chunk.view + s * M, cameras);
            eg_squared_distance(M, cameras, points, chunk.q + 2 * s * M, squared);
            for (ptrdiff_t j = 0; j < filled; ++j)
                distances[first[chunk.point[j]] + s] = sqrt(squared[j]);
        }
    }
    eg_release(scratch);
    return 0;
}

/* Move points (observation-last, padded with zeros) by `across`, scale them to unit norm, and return
   the sum of their x x^T. */
static void spread(ptrdiff_t padded, const double *across, double *EG_RESTRICT points,
                   double *moment)
{
    double *x = points, *y = x + padded, *z = y + padded, *w = z + padded, sums[10][EG_LANES];
    memset(sums, 0, sizeof sums);
    for (ptrdiff_t begin = 0; begin < padded; begin += EG_LANES) {
        EG_SIMD
        for (int j = 0; j < EG_LANES; ++j) {
            const ptrdiff_t i = begin + j;
            const double a = x[i], b = y[i], c = z[i], d = w[i];
            const double p = a * across[0] + b * across[4] + c * across[8] + d * across[12];
            const double q = a * across[1] + b * across[5] + c * across[9] + d * across[13];
            const double r = a * across[2] + b * across[6] + c * across[10] + d * across[14];
            const double t = a * across[3] + b * across[7] + c * across[11] + d * across[15];
            const double squared = p * p + q * q + r * r + t * t;
            const double scale = squared > 0.0 ? 1.0 / sqrt(squared) : 0.0;
            const double e = p * scale, f = q * scale, g = r * scale, h = t * scale;
            x[i] = e, y[i] = f, z[i] = g, w[i] = h;
            sums[0][j] += e * e, sums[1][j] += e * f, sums[2][j] += e * g, sums[3][j] += e * h;
            sums[4][j] += f * f, sums[5][j] += f * g, sums[6][j] += f * h;
            sums[7][j] += g * g, sums[8][j] += g * h, sums[9][j] += h * h;
        }
    }
    for (int k = 0, i = 0; i < 4; ++i)
        for (int l = i; l < 4; ++l, ++k) {
            double sum = 0.0;
            for (int j = 0; j < EG_LANES; ++j)
                sum += sums[k][j];
            moment[4 * i + l] = moment[4 * l + i] = sum;
        }
}

/* T such that the points T^-1 Q, of unit norm, have sum Q Q^T = (m / 4) I: the fixed point that
   epigauge.scatter.spreading_basis describes. T (4, 4). Returns 1 where there is no memory. */
int eg_spreading_basis(ptrdiff_t m, const double *Q, double *T)
{
    const ptrdiff_t padded = (m + EG_LANES - 1) / EG_LANES * EG_LANES;
    double *points = malloc(4 * (size_t)padded * sizeof(double));
    double across[16], moment[16], values[4], vectors[16], root[16], product[16];
    if (!points)
        return 1;
    for (ptrdiff_t k = 0; k < 4; ++k)
        for (ptrdiff_t j = 0; j < padded; ++j)
            points[k * padded + j] = j < m ? Q[4 * j + k] : 0.0;
    for (int k = 0; k < 16; ++k)
        T[k] = across[k] = k % 5 ? 0.0 : 1.0;
    for (int pass = 0; pass <= 200; ++pass) {
        double worst = 0.0;
        spread(padded, across, points, moment);
        for (int k = 0; k < 16; ++k)
            moment[k] *= 4.0 / (double)m;
        eg_eigen(4, moment, values, vectors);
        for (int k = 0; k < 4; ++k)
            worst = fmax(worst, fabs(values[k] - 1.0));
        if (pass == 200 || !(values[0] > 1e-14) || worst <= 1e-13)
            break;
        for (int i = 0; i < 4; ++i)
            for (int l = 0; l < 4; ++l) {
                root[4 * i + l] = across[4 * i + l] = 0.0;
                for (int k = 0; k < 4; ++k) {
                    const double both = vectors[4 * i + k] * vectors[4 * l + k];
                    root[4 * i + l] += both * sqrt(values[k]);
                    across[4 * i + l] += both / sqrt(values[k]);
                }
            }
        eg_product(4, 4, 4, T, root, product);
        memcpy(T, product, sizeof product);
    }
    free(points);
    return 0;
}

/* One camera: measurements and points in batches of lanes, the camera repeated in every lane. */
#define BATCH 40

typedef struct {
    ptrdiff_t count;
    double scale2;
    double *points, *measured, *moments; /* batch by batch, padded */
} resection;

/* Half the robust sum at a camera; sums as of a camera in `eg_bundle_linearize` unless NULL. */
static double resection_cost(const resection *r, const double *P, double *sums)
{
    double cameras[12 * BATCH], squared[BATCH], rho[3 * BATCH], w[BATCH], factors[10 * BATCH];
    double cost = 0.0;
    for (int k = 0; k < 12; ++k)
        for (int j = 0; j < BATCH; ++j)
            cameras[BATCH * k + j] = P[k];
    if (sums)
        memset(sums, 0, EG_CAMERA * sizeof(double));
    for (ptrdiff_t begin = 0; begin < r->count; begin += BATCH) {
        const ptrdiff_t n = r->count - begin < BATCH ? r->count - begin : BATCH;
        const double *points = r->points + 4 * begin, *q = r->measured + 2 * begin;
        const double *moments = r->moments + 16 * begin;
        eg_squared_distance(BATCH, cameras, points, q, squared);
        eg_loss_cauchy(BATCH, squared, &r->scale2, rho, rho + BATCH, rho + 2 * BATCH);
        for (ptrdiff_t j = 0; j < n; ++j)
            cost += rho[j];
        if (!sums)
            continue;
        for (ptrdiff_t j = 0; j < BATCH; ++j)
            w[j] = j < n ? rho[BATCH + j] : 0.0;
        eg_camera_normal(BATCH, cameras, points, q, w, factors, factors + 6 * BATCH,
                         factors + 7 * BATCH);
        eg_accumulate(n, factors, BATCH, moments, sums, sums + 7 * 8);
        eg_accumulate(n, factors + 3 * BATCH, BATCH, moments, sums + 3 * 8, sums + 7 * 8 + 3 * 4);
        eg_accumulate_points(n, factors + 7 * BATCH, BATCH, moments, sums + 7 * EG_MOMENTS);
    }
    return 0.5 * cost;
}

static double largest(ptrdiff_t n, const double *values, ptrdiff_t stride)
{
    double result = 0.0;
    for (ptrdiff_t k = 0; k < n; ++k)
        result = fmax(result, fabs(values[stride * k]));
    return result;
}

/* A minimisation over one camera: the estimate, a trial, normal equations. */
typedef struct {
    const resection *r;
    double *P, trial[12], N[144], g[12];
} one_camera;

static double cost_at_start(void *self)
{
    one_camera *own = self;
    return resection_cost(own->r, own->P, NULL);
}

static eg_lm_system linearize(void *self, double lam)
{
    (void)lam;
    static const eg_bundle one = {.n_views = 1, .model = EG_FACTORED};
    one_camera *own = self;
    double sums[EG_CAMERA], depth[144];
    resection_cost(own->r, own->P, sums);
    eg_bundle_camera_blocks(&one, sums, own->N, depth, own->g);
    const eg_lm_system system = {largest(12, own->g, 1), largest(12, own->N, 13), INFINITY};
    return system;
}

static int make_step(void *self, double lam, double *norm)
{
    static const int32_t first[1] = {0};
    static const ptrdiff_t slot[2] = {0, 1};
    const eg_envelope alone = {1, first, slot};
    one_camera *own = self;
    double damped[144], step[12], sum = 0.0;
    memcpy(damped, own->N, sizeof damped);
    for (int k = 0; k < 12; ++k) {
        damped[13 * k] += lam;
        step[k] = -own->g[k];
    }
    if (eg_envelope_factor(&alone, damped))
        return EG_STEP_SINGULAR;
    eg_envelope_solve(&alone, damped, 1, step);
    for (int k = 0; k < 12; ++k) {
        own->trial[k] = own->P[k] + step[k];
        sum += step[k] * step[k];
    }
    *norm = sqrt(sum);
    return EG_STEP_MADE;
}

static double cost_at_trial(void *self)
{
    one_camera *own = self;
    return resection_cost(own->r, own->trial, NULL);
}

static void accept(void *self)
{
    one_camera *own = self;
    memcpy(own->P, own->trial, sizeof own->trial);
}

/* The camera (3, 4) of least Cauchy loss, of squared scale `scale2`, for measurements (2, count) of
   points (4, count), from a start. Returns 1 where there is no memory. */
int eg_resect(ptrdiff_t count, const double *q, const double *Q, double scale2, double ftol,
              ptrdiff_t max_iter, double *P)
{
    const ptrdiff_t padded = (count + BATCH - 1) / BATCH * BATCH;
    double *memory = malloc(22 * (size_t)padded * sizeof(double));
    if (!memory)
        return 1;
    resection r = {count, scale2, memory, memory + 4 * padded, memory + 6 * padded};
    for (ptrdiff_t i = 0; i < padded; ++i) {
        const ptrdiff_t from = i < count ? i : count - 1, lane = i % BATCH, begin = i - lane;
        for (int k = 0; k < 4; ++k)
            r.points[4 * begin + BATCH * k + lane] = Q[count * k + from];
        for (int k = 0; k < 2; ++k)
            r.measured[2 * begin + BATCH * k + lane] = q[count * k + from];
    }
    for (ptrdiff_t begin = 0; begin < padded; begin += BATCH)
        eg_moments(BATCH, r.points + 4 * begin, r.moments + 16 * begin);
    one_camera own = {.r = &r, .P = P};
    const eg_lm_problem problem = {&own, 0.0, cost_at_start, linearize, make_step, cost_at_trial,
                                   accept, NULL, 0};
    const eg_lm_options how = {ftol, 1e-12, 1e-14, 1e-3, 1e-8, 1, (int)max_iter};
    eg_lm_outcome outcome;
    eg_lm(&problem, &how, NULL, &outcome);
    free(memory);
    return 0;
}
