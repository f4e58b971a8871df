/* What both routes and their loops over pairs of observations share. */
#ifndef EPIGAUGE_BUNDLE_PAIRS_H
#define EPIGAUGE_BUNDLE_PAIRS_H

#include "bundle_chunk.h"

/* Widths of rows that the loops over pairs are compiled for, up to EG_MOST_TANGENT. */
#define EG_WIDTHS(CASE) CASE(8) CASE(12) CASE(16) CASE(20) CASE(24) CASE(32)

static inline const eg_camera_model *eg_model_of(const eg_pass *p)
{
    return eg_camera_models + p->bundle->model;
}

/* Rows of both coordinates of a lane's Jacobian J (2, tangent of the model), filled up with zeros. */
EG_INLINE void eg_turn_camera(const eg_pass *p, ptrdiff_t padded, const double *J, ptrdiff_t j,
                               double *EG_RESTRICT first, double *EG_RESTRICT second)
{
    const ptrdiff_t M = p->chunk.M, K = p->route->tangent, d = eg_model_of(p)->tangent_size;
    const int32_t *column = p->bundle->columns;
    for (ptrdiff_t k = 0; k < K; ++k) {
        first[k] = J[column[k] * M + j];
        second[k] = J[(d + column[k]) * M + j];
    }
    for (ptrdiff_t k = K; k < padded; ++k)
        first[k] = second[k] = 0.0;
}

/* A function `pairs` of a route, see eg_route. */
typedef void eg_pairs(const eg_pass *, const eg_envelope *, const double *, double *, ptrdiff_t *,
                      int32_t *, double *);

/* In bundle_pairs.c: of the factored route, and of the direct one for a width of rows and points of
   b entries. */
eg_pairs eg_factored_pairs;
eg_pairs *eg_direct_pairs(ptrdiff_t padded, ptrdiff_t b);

#endif
