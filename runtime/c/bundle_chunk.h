/* What the loops over chunks share: a chunk, a pass over its slots, weights, and the two routes. */
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

typedef struct eg_route eg_route;
typedef struct eg_group eg_group;

/* A pass over chunks: where it is, and its memory. Arrays of lanes are observation-last. */
typedef struct {
    const eg_bundle *bundle;
    const eg_route *route;
    eg_chunk chunk;
    double *memory;
    double *points;  /* (b, M) */
    double *moments; /* of the factored route */
    double *cameras; /* (c, M), of the slot */
    /* The slot: one observation of every lane; lanes beyond `filled` have none. */
    ptrdiff_t filled;
    const int32_t *view;
    const double *q, *weights;
    double *loss, *squared, *w; /* 3 M, M, M: the loss, squared residuals, weights */
    double *work;
    double *kept;  /* what is kept of the slot, for `turn` */
    double *extra; /* what the caller has asked for */
} eg_pass;

/* What differs between the factored route of projective cameras, whose Jacobian is a (2, 3) times
   the point's coordinates, and the direct one of any model, which has the Jacobian itself. The point
   in a pass is where its lanes are. */
struct eg_route {
    int factored;
    ptrdiff_t camera, point; /* entries of a stored camera and of a point */
    ptrdiff_t tangent;       /* unknowns of a camera */
    ptrdiff_t padded;        /* width of the rows of sums */
    ptrdiff_t camera_sums;   /* doubles a camera */
    eg_blocks pair_sums;     /* how the sums of pairs of cameras are stored */
    ptrdiff_t sums;          /* rows of a point's sums: V, its damping where it has one, g */
    ptrdiff_t kept;          /* rows that are kept of an observation */
    ptrdiff_t turned;        /* doubles an observation when pairs are added */
    ptrdiff_t work;          /* rows of scratch */
    /* Squared residuals. */
    void (*squared)(const eg_pass *);
    /* Add to the sums of points; weights, squared residuals. */
    void (*sight)(const eg_pass *, const double *points, double *sums);
    /* Evaluate a slot for `turn`, and for `observe`, which adds to the sums of points and cameras. */
    void (*evaluate)(eg_pass *);
    void (*observe)(eg_pass *, double *sums, double *cameras);
    /* Evaluate a slot for the next two, of `count` columns; entries of one are `count` rows of lanes
       apart, entries of cameras so many apart. */
    void (*couple)(const eg_pass *, const double *roots);
    /* v += (W T)^T x of one column, x of the cameras, (tangent, M). */
    void (*to_points)(const eg_pass *, const double *roots, ptrdiff_t count, const double *x,
                      double *v);
    /* cameras += W T v of all columns; `scratch` has two rows a column. */
    void (*to_cameras)(const eg_pass *, const double *roots, ptrdiff_t count, const double *v,
                       double *scratch, double *cameras);
    /* Turn the factors W T of a chunk, what is kept of its first slot being at `kept`, into those of a
       group, behind what it has; cameras += W T v unless v is NULL. May add pairs on its own, and
       leave the group as it is. */
    void (*turn)(eg_pass *, const double *roots, const double *v, double *kept, const eg_envelope *,
                 eg_group *, double *pairs, double *cameras);
    /* Add W T T^T W^T of all pairs of observations of each point of a group to their pairs of
       views. */
    void (*pairs)(const eg_route *, const eg_envelope *, eg_group *, double *pairs);
    /* Of the direct route: the sum Z (b, b) of Y_s^T X_st Y_t over all pairs of observations of a
       lane of a group, Y = W T; unless NULL, `coupled` gets the sums of X_st Y_t over t, b rows of the
       padded width an observation. X is of pairs of views, stored as their sums. */
    void (*marginal)(const eg_route *, const eg_envelope *, const eg_group *, ptrdiff_t lane,
                     const double *X, double *Z, double *coupled);
    /* Of the direct route, for its width of rows: turn Jacobians J of a slot, lane by lane; add them
       and residuals r to the sums of cameras; turn those of slot s, lanes beginning at `first` in the
       group. */
    void (*turn_cameras)(const eg_pass *, const double *J);
    void (*add_cameras)(const eg_pass *, const double *r, double *cameras);
    void (*turn_slot)(const eg_pass *, const double *Z, const double *v, const int32_t *first,
                      ptrdiff_t s, eg_group *, double *cameras);
};

/* In bundle_factored.c and bundle_direct.c. */
extern const eg_route eg_factored_route;
eg_route eg_direct_route(const eg_bundle *bundle);

static inline eg_route eg_route_of(const eg_bundle *bundle)
{
    return bundle->model < 0 ? eg_factored_route : eg_direct_route(bundle);
}

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

/* Memory that begins at a cache line; NULL where there is none. To be released by `eg_release`. */
static inline double *eg_aligned(ptrdiff_t size)
{
    void *whole = malloc((size_t)(size + 16) * sizeof(double));
    if (!whole)
        return 0;
    double *aligned = (double *)(((uintptr_t)whole + 2 * 64) & ~(uintptr_t)63);
    ((void **)aligned)[-1] = whole;
    return aligned;
}

/* Such memory for the largest of some chunks, so many doubles a lane and a row. */
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
    return eg_aligned(size);
}

static inline void eg_release(double *scratch)
{
    if (scratch)
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
    for (ptrdiff_t j = 0; j < M; j += 4) { /* M is a multiple of EG_LANES */
        const double *EG_RESTRICT a = rows + width * index[j];
        const double *EG_RESTRICT b = rows + width * index[j + 1];
        const double *EG_RESTRICT c = rows + width * index[j + 2];
        const double *EG_RESTRICT d = rows + width * index[j + 3];
        double *EG_RESTRICT to = out + j;
        if (a == b && a == c && a == d) /* as of cameras, often */
            for (ptrdiff_t k = 0; k < width; ++k, to += M)
                to[0] = to[1] = to[2] = to[3] = a[k];
        else
            for (ptrdiff_t k = 0; k < width; ++k, to += M)
                to[0] = a[k], to[1] = b[k], to[2] = c[k], to[3] = d[k];
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

/* Symmetric (b, b) matrices from their upper triangles, observation-last, into rows. */
static inline void eg_scatter_symmetric(const eg_chunk *chunk, ptrdiff_t b,
                                        const double *EG_RESTRICT in, double *rows)
{
    const ptrdiff_t M = chunk->M;
    for (ptrdiff_t j = 0; j < M; ++j) {
        if (!chunk->count[j])
            continue;
        double *row = rows + b * b * chunk->point[j];
        for (ptrdiff_t i = 0, k = 0; i < b; ++i)
            for (ptrdiff_t l = i; l < b; ++l, ++k)
                row[b * i + l] = row[b * l + i] = in[k * M + j];
    }
}

static inline void eg_add(ptrdiff_t n, const double *EG_RESTRICT values, double *EG_RESTRICT sums)
{
    EG_SIMD
    for (ptrdiff_t i = 0; i < n; ++i)
        sums[i] += values[i];
}

/* A pass with so many more doubles a lane and a row; 1 where there is no memory. */
static inline int eg_pass_begin(eg_pass *p, const eg_bundle *bundle, const eg_route *route,
                                ptrdiff_t begin, ptrdiff_t end, ptrdiff_t a_lane, ptrdiff_t a_row)
{
    const ptrdiff_t own = route->point + route->camera + 5 + route->work + (route->factored ? 16 : 0);
    p->bundle = bundle;
    p->route = route;
    p->memory = eg_scratch(bundle, begin, end, own + a_lane, a_row);
    return !p->memory;
}

/* Go to a chunk: its points (rows of all of them are given), their moments. */
static inline void eg_pass_chunk(eg_pass *p, ptrdiff_t c, const double *points)
{
    p->chunk = eg_chunk_of(p->bundle, c);
    const ptrdiff_t M = p->chunk.M;
    p->points = p->memory;
    p->cameras = p->points + p->route->point * M;
    p->loss = p->cameras + p->route->camera * M;
    p->squared = p->loss + 3 * M;
    p->w = p->squared + M;
    p->work = p->w + M;
    p->moments = p->work + p->route->work * M;
    p->extra = p->moments + (p->route->factored ? 16 * M : 0);
    p->filled = M;
    eg_gather(M, p->route->point, points, p->chunk.point, p->points);
}

/* Go to a slot, rising; its cameras are at hand in `cameras`. */
static inline void eg_pass_slot_of(eg_pass *p, ptrdiff_t s, double *cameras)
{
    const ptrdiff_t M = p->chunk.M;
    p->filled = eg_filled(&p->chunk, s, s ? p->filled : M);
    p->view = p->chunk.view + s * M;
    p->q = p->chunk.q + 2 * s * M;
    p->weights = p->chunk.weights + s * M;
    p->cameras = cameras;
}

static inline void eg_pass_slot(eg_pass *p, ptrdiff_t s, const double *cameras)
{
    eg_pass_slot_of(p, s, p->points + p->route->point * p->chunk.M);
    eg_gather(p->chunk.M, p->route->camera, cameras, p->view, p->cameras);
}

/* Keep what is evaluated of slot s behind that of the slots before, its weights first. */
static inline void eg_pass_keep(eg_pass *p, ptrdiff_t s, double *kept)
{
    p->kept = p->w = kept + p->route->kept * s * p->chunk.M;
}

/* Weights in the normal equations of a slot, given its squared residuals unless the loss is
   linear. */
static inline void eg_weigh(const eg_pass *p)
{
    const eg_bundle *b = p->bundle;
    const double least = b->least, *weights = p->weights;
    const double *first = 0;
    const ptrdiff_t M = p->chunk.M;
    double *EG_RESTRICT w = p->w;
    if (b->loss != EG_LINEAR) {
        eg_losses((int)b->loss, b->scale2, M, p->squared, p->loss, p->loss + M, p->loss + 2 * M);
        first = p->loss + M;
    }
    for (ptrdiff_t j = 0; j < p->filled; ++j) {
        const double value = first ? weights[j] * first[j] : weights[j];
        w[j] = value < least ? least : value;
    }
    for (ptrdiff_t j = p->filled; j < M; ++j)
        w[j] = 0.0;
}

/* costs += weights rho(squared); the loss is as `eg_weigh` has left it. */
static inline void eg_charge(const eg_pass *p, double *EG_RESTRICT costs)
{
    const double *rho = p->bundle->loss != EG_LINEAR ? p->loss : p->squared;
    const double *weights = p->weights;
    EG_SIMD
    for (ptrdiff_t j = 0; j < p->chunk.M; ++j)
        costs[j] += weights[j] * rho[j];
}

/* End of the lanes from `begin` on that have the same view. */
static inline ptrdiff_t eg_run(const int32_t *view, ptrdiff_t begin, ptrdiff_t filled)
{
    ptrdiff_t end = begin + 1;
    while (end < filled && view[end] == view[begin])
        ++end;
    return end;
}

#endif
