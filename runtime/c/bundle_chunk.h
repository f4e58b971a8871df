/* What the loops over chunks share: a chunk, its scratch memory, gathering, weights. */
#ifndef EPIGAUGE_BUNDLE_CHUNK_H
#define EPIGAUGE_BUNDLE_CHUNK_H

#include <stdlib.h>
#include <string.h>

#include "bundle.h"
#include "losses.h"

typedef struct {
    ptrdiff_t M, L;
    const int32_t *point, *count, *view;
    const double *q, *weights;
} eg_chunk;

static inline eg_chunk eg_chunk_of(const eg_bundle *b, ptrdiff_t c)
{
    eg_chunk chunk;
    const ptrdiff_t lane = b->lanes[c], row = b->rows[c];
    chunk.M = b->lanes[c + 1] - lane;
    chunk.L = (b->rows[c + 1] - row) / chunk.M;
    chunk.point = b->point + lane;
    chunk.count = b->count + lane;
    chunk.view = b->view + row;
    chunk.q = b->q + 2 * row;
    chunk.weights = b->weights + row;
    return chunk;
}

/* Scratch memory for the largest of some chunks, so many doubles a lane and a row; aligned to cache
   lines. NULL where there is none. To be released by `eg_release`. */
static inline double *eg_scratch(const eg_bundle *b, ptrdiff_t begin, ptrdiff_t end,
                                 ptrdiff_t a_lane, ptrdiff_t a_row)
{
    ptrdiff_t size = 1;
    for (ptrdiff_t c = begin; c < end; ++c) {
        const ptrdiff_t own = a_lane * (b->lanes[c + 1] - b->lanes[c])
                              + a_row * (b->rows[c + 1] - b->rows[c]);
        if (own > size)
            size = own;
    }
    void *whole = malloc((size_t)(size + 16) * sizeof(double));
    if (!whole)
        return 0;
    double *aligned = (double *)(((uintptr_t)whole + 2 * 64) & ~(uintptr_t)63);
    ((void **)aligned)[-1] = whole;
    return aligned;
}

static inline void eg_release(double *scratch)
{
    free(((void **)scratch)[-1]);
}

/* Lanes of a slot that hold an observation, given those of the slot before. */
static inline ptrdiff_t eg_filled(const eg_chunk *chunk, ptrdiff_t s, ptrdiff_t before)
{
    while (before > 0 && chunk->count[before - 1] <= s)
        --before;
    return before;
}

/* Observation-last copies of rows of an array: out[k M + j] = rows[width index[j] + k]. */
static inline void eg_gather(ptrdiff_t M, ptrdiff_t width, const double *rows, const int32_t *index,
                             double *EG_RESTRICT out)
{
    for (ptrdiff_t j = 0; j < M; ++j) {
        const double *row = rows + width * index[j];
        for (ptrdiff_t k = 0; k < width; ++k)
            out[k * M + j] = row[k];
    }
}

/* out[k M + j] back to rows[width index[j] + k], for the lanes that hold a point. */
static inline void eg_scatter(const eg_chunk *chunk, ptrdiff_t width, const double *EG_RESTRICT in,
                              double *rows)
{
    for (ptrdiff_t j = 0; j < chunk->M; ++j) {
        if (!chunk->count[j])
            continue;
        double *row = rows + width * chunk->point[j];
        for (ptrdiff_t k = 0; k < width; ++k)
            row[k] = in[k * chunk->M + j];
    }
}

static inline void eg_add(ptrdiff_t n, const double *EG_RESTRICT values, double *EG_RESTRICT sums)
{
    EG_SIMD
    for (ptrdiff_t i = 0; i < n; ++i)
        sums[i] += values[i];
}

/* Weights in the normal equations of a slot, given its squared residuals unless the loss is linear.
   `work` has 3 M entries. */
static inline void eg_weigh(const eg_bundle *b, ptrdiff_t M, ptrdiff_t filled,
                            const double *EG_RESTRICT weights, const double *EG_RESTRICT squared,
                            double *EG_RESTRICT work, double *EG_RESTRICT w)
{
    const double least = b->least;
    const double *first = 0;
    if (b->loss != EG_LINEAR) {
        eg_losses((int)b->loss, b->scale2, M, squared, work, work + M, work + 2 * M);
        first = work + M;
    }
    for (ptrdiff_t j = 0; j < filled; ++j) {
        const double value = first ? weights[j] * first[j] : weights[j];
        w[j] = value < least ? least : value;
    }
    for (ptrdiff_t j = filled; j < M; ++j)
        w[j] = 0.0;
}

/* costs += weights rho(squared); `work` is as `eg_weigh` has left it. */
static inline void eg_charge(const eg_bundle *b, ptrdiff_t M, const double *EG_RESTRICT weights,
                             const double *EG_RESTRICT squared, const double *EG_RESTRICT work,
                             double *EG_RESTRICT costs)
{
    const double *rho = b->loss != EG_LINEAR ? work : squared;
    EG_SIMD
    for (ptrdiff_t j = 0; j < M; ++j)
        costs[j] += weights[j] * rho[j];
}

/* Loss and weights of a slot: squared residuals first where the loss needs them. */
static inline void eg_weigh_at(const eg_bundle *b, ptrdiff_t M, ptrdiff_t filled, const double *P,
                               const double *Q, const double *q, const double *weights,
                               double *squared, double *work, double *w)
{
    if (b->loss != EG_LINEAR)
        eg_squared_distance(M, P, Q, q, squared);
    eg_weigh(b, M, filled, weights, squared, work, w);
}

/* Moments of the points of a chunk and the points themselves, 16 entries a lane. */
static inline void eg_moments(ptrdiff_t M, const double *EG_RESTRICT points,
                              double *EG_RESTRICT moments)
{
    for (ptrdiff_t j = 0; j < M; ++j) {
        double *row = moments + 16 * j;
        ptrdiff_t k = 0;
        for (int i = 0; i < 4; ++i)
            for (int l = i; l < 4; ++l)
                row[k++] = points[i * M + j] * points[l * M + j];
        row[10] = row[11] = 0.0;
        for (int i = 0; i < 4; ++i)
            row[12 + i] = points[i * M + j];
    }
}

/* Add three factors (rows of `factors`, M apart) times the moments of one or more neighbouring lanes
   to their sums: eight moments to `high`, four to `low`. The sums stay in registers meanwhile. */
static inline void eg_accumulate(ptrdiff_t lanes, const double *EG_RESTRICT factors, ptrdiff_t M,
                                 const double *EG_RESTRICT moments, double *EG_RESTRICT high,
                                 double *EG_RESTRICT low)
{
    double a[8], b[8], c[8], d[4], e[4], f[4];
    EG_SIMD
    for (int k = 0; k < 8; ++k)
        a[k] = high[k], b[k] = high[8 + k], c[k] = high[16 + k];
    EG_SIMD
    for (int k = 0; k < 4; ++k)
        d[k] = low[k], e[k] = low[4 + k], f[k] = low[8 + k];
    ptrdiff_t j = 0;
    do {
        const double *EG_RESTRICT moment = moments + 16 * j;
        const double x = factors[j], y = factors[M + j], z = factors[2 * M + j];
        EG_SIMD
        for (int k = 0; k < 8; ++k)
            a[k] += x * moment[k], b[k] += y * moment[k], c[k] += z * moment[k];
        EG_SIMD
        for (int k = 0; k < 4; ++k)
            d[k] += x * moment[8 + k], e[k] += y * moment[8 + k], f[k] += z * moment[8 + k];
    } while (++j < lanes);
    EG_SIMD
    for (int k = 0; k < 8; ++k)
        high[k] = a[k], high[8 + k] = b[k], high[16 + k] = c[k];
    EG_SIMD
    for (int k = 0; k < 4; ++k)
        low[k] = d[k], low[4 + k] = e[k], low[8 + k] = f[k];
}

/* The same for one factor. */
static inline void eg_accumulate_one(ptrdiff_t lanes, const double *EG_RESTRICT factors,
                                     const double *EG_RESTRICT moments, double *EG_RESTRICT high,
                                     double *EG_RESTRICT low)
{
    double a[8], d[4];
    EG_SIMD
    for (int k = 0; k < 8; ++k)
        a[k] = high[k];
    EG_SIMD
    for (int k = 0; k < 4; ++k)
        d[k] = low[k];
    ptrdiff_t j = 0;
    do {
        EG_SIMD
        for (int k = 0; k < 8; ++k)
            a[k] += factors[j] * moments[16 * j + k];
        EG_SIMD
        for (int k = 0; k < 4; ++k)
            d[k] += factors[j] * moments[16 * j + 8 + k];
    } while (++j < lanes);
    EG_SIMD
    for (int k = 0; k < 8; ++k)
        high[k] = a[k];
    EG_SIMD
    for (int k = 0; k < 4; ++k)
        low[k] = d[k];
}

/* Add three factors times Q of one or more neighbouring lanes: twelve sums. */
static inline void eg_accumulate_points(ptrdiff_t lanes, const double *EG_RESTRICT factors,
                                        ptrdiff_t M, const double *EG_RESTRICT moments,
                                        double *EG_RESTRICT sums)
{
    double a[4], b[4], c[4];
    EG_SIMD
    for (int k = 0; k < 4; ++k)
        a[k] = sums[k], b[k] = sums[4 + k], c[k] = sums[8 + k];
    ptrdiff_t j = 0;
    do {
        const double *EG_RESTRICT point = moments + 16 * j + 12;
        const double x = factors[j], y = factors[M + j], z = factors[2 * M + j];
        EG_SIMD
        for (int k = 0; k < 4; ++k)
            a[k] += x * point[k], b[k] += y * point[k], c[k] += z * point[k];
    } while (++j < lanes);
    EG_SIMD
    for (int k = 0; k < 4; ++k)
        sums[k] = a[k], sums[4 + k] = b[k], sums[8 + k] = c[k];
}

/* End of the lanes from `begin` on that have the same view. */
static inline ptrdiff_t eg_run(const int32_t *view, ptrdiff_t begin, ptrdiff_t filled)
{
    ptrdiff_t end = begin + 1;
    while (end < filled && view[end] == view[begin])
        ++end;
    return end;
}

/* In bundle_pairs.c. */
void eg_add_to_pairs(const eg_chunk *chunk, const eg_envelope *envelope, const double *Y,
                     const double *moments, double *X, double *turned, ptrdiff_t *views,
                     int32_t *sorted, double *pairs);

#endif
