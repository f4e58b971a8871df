/* Many views: the accumulation over observations, point by point, and the reduced system.

   The readable reference is Python: epigauge/bundle/numpy_linearizer.py. A test compares both.
   Nothing here is a formula of the geometry: projections and Jacobians are generated kernels, run
   over many points at once. A camera model is a row of eg_camera_models.

   Points are worked on in chunks of equal or similar numbers of observations. A chunk has M lanes
   (points, M a multiple of EG_LANES) and L slots: slot s holds the s-th observation of every lane,
   so that what is summed over the observations of a point is added lane by lane. Lanes are in
   falling order of their numbers of observations; what is missing repeats another observation
   without weight. */
#ifndef EPIGAUGE_BUNDLE_H
#define EPIGAUGE_BUNDLE_H

#include <stdint.h>

#include "skyline.h"

#define EG_LANES 8

/* The moments of a point, the ten entries of Q Q^T, are padded to twelve. A sum of r factors times
   moments holds, so that no vector crosses a cache line, the first eight moments of every factor,
   then the other four of every factor. Each lane has its moments and Q itself in 16 entries. */
#define EG_MOMENTS 12
#define EG_ENTRY(r, e, k) ((k) < 8 ? 8 * (e) + (k) : 8 * (r) + 4 * (e) + (k) - 8)

/* A camera: sums for the six entries of A and for depth, the gradient, filled up. */
#define EG_CAMERA 96

/* A pair of cameras: sums for the nine entries of a 3x3 matrix, filled up. */
#define EG_PAIR 112

typedef struct {
    ptrdiff_t n_views, n_points, n_chunks;
    const ptrdiff_t *lanes;  /* (n_chunks + 1): where the lanes of each chunk begin */
    const ptrdiff_t *rows;   /* (n_chunks + 1): where its observations begin, M L of them */
    const int32_t *point;    /* point of each lane */
    const int32_t *count;    /* observations of each lane, 0 for a lane that fills up */
    const int32_t *view;     /* view of each observation, slot by slot; rising within a point */
    const double *q;         /* measurements: for each slot M first and M second coordinates */
    const double *weights;
    double least;            /* least weight in the normal equations */
    double scale2;           /* squared scale of the loss */
    ptrdiff_t loss;          /* its number in losses.h */
    ptrdiff_t model;         /* row of eg_camera_models, or EG_FACTORED */
    ptrdiff_t width;         /* entries of a camera's tangent that are computed with */
    const int32_t *columns;  /* their numbers; not of the factored route */
} eg_bundle;

/* Projective cameras by the factors of their Jacobian, see bundle_factored.c. */
#define EG_FACTORED (-1)

/* How points are refined on their own: most iterations, first lambda and what it is divided or
   multiplied by, relative decrease that ends it; damping by tr(V) / b I or V. The factored route adds
   to V the blocks of depths. */
enum { EG_TRACE, EG_BLOCK, EG_DEPTHS };
typedef struct {
    ptrdiff_t iterations, damping;
    double lam, factor, tolerance;
} eg_refinement;

/* ---------------------------------------------------------------- bundle_lanes.c */

EG_EXPORT ptrdiff_t eg_bundle_chunks(
    ptrdiff_t n, ptrdiff_t m, const ptrdiff_t *first, const ptrdiff_t *view, ptrdiff_t *points,
    ptrdiff_t *lanes, ptrdiff_t *rows, int32_t *point, int32_t *count);

/* ---------------------------------------------------------------- bundle.c */

EG_EXPORT void eg_bundle_pack(
    eg_bundle *bundle, const ptrdiff_t *first, const ptrdiff_t *view, const double *q,
    const double *weights, int32_t *packed_view, double *packed_q, double *packed_weights);

EG_EXPORT void eg_bundle_widths(const eg_bundle *bundle, ptrdiff_t *camera, eg_blocks *pairs);

EG_EXPORT int eg_bundle_costs(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *cameras,
    const double *points, double *costs);

EG_EXPORT int eg_bundle_linearize(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *cameras,
    const double *points, double *V, double *D, double *g, double *camera_sums);

EG_EXPORT int eg_bundle_refine_points(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *cameras, double *points,
    double *costs, const unsigned char *frozen, const eg_refinement *how);

/* ---------------------------------------------------------------- bundle_direct.c */

EG_EXPORT ptrdiff_t eg_camera_model_row(const char *name);

/* ---------------------------------------------------------------- bundle_points.c */

EG_EXPORT int eg_bundle_inverse_roots(
    ptrdiff_t m, ptrdiff_t b, const double *V, const double *W, ptrdiff_t width, double lam,
    const double *g, double *T, double *half);

EG_EXPORT double eg_bundle_point_steps(
    ptrdiff_t m, ptrdiff_t b, const double *T, const double *half, const double *coupled,
    const double *W, ptrdiff_t width, double *steps);

/* ---------------------------------------------------------------- bundle_schur.c */

EG_EXPORT int eg_bundle_schur(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *cameras,
    const double *points, const double *T, const double *half, const eg_envelope *envelope,
    double *pairs, double *reduced);

EG_EXPORT int eg_bundle_eliminate(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *cameras,
    const double *points, double lam, int damping, const eg_envelope *envelope, double *V, double *D,
    double *g, double *T, double *half, double *camera_sums, double *pairs, double *reduced);

EG_EXPORT int eg_bundle_couple(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *cameras,
    const double *points, const double *T, ptrdiff_t count, const double *x, const double *y,
    double *moved, double *reduced);

EG_EXPORT int eg_bundle_marginals(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *cameras,
    const double *points, const double *T, const double *X, const eg_envelope *envelope,
    double *marginals, const ptrdiff_t *first, double *coupled);

/* ---------------------------------------------------------------- bundle_reduced.c */

EG_EXPORT void eg_bundle_camera_blocks(
    const eg_bundle *bundle, const double *cameras, double *U, double *D, double *g);

EG_EXPORT void eg_bundle_pair_blocks(
    const eg_bundle *bundle, ptrdiff_t count, const double *pairs, double *blocks);

EG_EXPORT int eg_bundle_whiten(
    ptrdiff_t n, const double *U, const double *W, double lam, double *A, double *white);

EG_EXPORT void eg_bundle_neighbours(const eg_bundle *bundle, unsigned char *together);

/* ---------------------------------------------------------------- bundle_start.c */

EG_EXPORT int eg_bundle_intersect(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *P, double *Q);

EG_EXPORT int eg_bundle_distances(
    const eg_bundle *bundle, ptrdiff_t begin, ptrdiff_t end, const double *P, const double *Q,
    const ptrdiff_t *first, double *distances);

EG_EXPORT int eg_spreading_basis(ptrdiff_t m, const double *Q, double *T);

/* ---------------------------------------------------------------- frames.c */

EG_EXPORT int eg_change_basis(
    ptrdiff_t n, ptrdiff_t m, const double *T, int fit, double *gamma, double *alpha, const double *P,
    const double *Q, double *moved_P, double *moved_Q);

EG_EXPORT double eg_image_frame(
    ptrdiff_t n, ptrdiff_t count, const ptrdiff_t *view, const double *xy, double *origins);

/* ---------------------------------------------------------------- bundle_start.c */

EG_EXPORT int eg_resect(
    ptrdiff_t count, const double *q, const double *Q, double scale2, double ftol,
    ptrdiff_t max_iter, double *P);

/* ---------------------------------------------------------------- bundle_minimize.c */

/* Do `part` of `work` for all numbers below `count`, at the same time if possible. */
typedef void eg_part(void *work, ptrdiff_t number);
typedef void eg_share(eg_part *part, void *work, ptrdiff_t count);

/* How cameras and points are minimised over, all of them free. */
typedef struct {
    eg_refinement refinement;
    double ftol, xtol, gtol;
    double start, least;    /* first lambda, and the least relative to it */
    double floor;           /* a cost this low is rounding error */
    ptrdiff_t max_iter;
    const int32_t *focal;   /* places of focal lengths in a stored camera */
    ptrdiff_t focals;
    double min_focal, max_focal;
    eg_share *share;          /* NULL where one thread does all */
    ptrdiff_t n_passes, n_pairs;
    const ptrdiff_t *passes;  /* (n_passes + 1): edges of the threads' ranges of chunks */
    const ptrdiff_t *pairs;   /* (n_pairs + 1): the same for passes over pairs of observations */
    const volatile int *stop; /* the loop ends before its next step where this is not zero */
    int adaptive;             /* whether lambda follows the gain ratio once a step was rejected */
} eg_bundle_options;

/* The normal equations at the end, as of `eg_bundle_linearize` and `eg_bundle_camera_blocks`. */
typedef struct {
    double *U, *V, *g, *g_points;
} eg_bundle_normal;

EG_EXPORT int eg_bundle_minimize(
    const eg_bundle *bundle, const eg_envelope *views, const eg_envelope *panels,
    const eg_bundle_options *options, double *cameras, double *points,
    const eg_bundle_normal *normal, double *history, double *cost, ptrdiff_t *counts);

#endif
