/* What both routes and their loops over pairs of observations share. */
#ifndef EPIGAUGE_BUNDLE_PAIRS_H
#define EPIGAUGE_BUNDLE_PAIRS_H

#include "bundle_group.h"

static inline const eg_camera_model *eg_model_of(const eg_pass *p)
{
    return eg_camera_models + p->bundle->model;
}

/* In bundle_pairs.c: `pairs` of the factored route, and of a chunk all of whose lanes, so many, are
   seen by the same views; its factors are F. */
void eg_factored_pairs(const eg_route *, const eg_envelope *, eg_group *, double *pairs);
void eg_factored_pairs_alike(const eg_pass *, const eg_envelope *, ptrdiff_t lanes, const double *F,
                             double *pairs);

/* Widths of rows, up to EG_MOST_TANGENT. */
#define EG_WIDTHS(CASE) CASE(8) CASE(12) CASE(16) CASE(20) CASE(24) CASE(32)

/* Fill in what the direct route has for its width of rows: in bundle_products.c `turn_cameras`,
   `add_cameras`, `turn_slot` and `pairs`, in bundle_marginals.c `marginal`. */
void eg_direct_loops(eg_route *route);
void eg_direct_marginal(eg_route *route);

#endif
