/* Algebra of the small symmetric matrices of points, in lanes. */
#ifndef EPIGAUGE_BUNDLE_POINTS_H
#define EPIGAUGE_BUNDLE_POINTS_H

#include "bundle.h"

/* Moments of the points of a chunk and the points themselves, 16 entries a lane. */
void eg_moments(ptrdiff_t M, const double *points, double *moments);

/* steps = -(V + lam W)^-1 g with W = tr(V) / b I (EG_TRACE) or V (EG_BLOCK), and -g^T steps, for sums
   V (upper triangles) and g; NaN where a matrix is not positive definite. b is 3 or 4, and 26 rows
   of scratch are enough. */
void eg_damped_point_step(ptrdiff_t M, ptrdiff_t b, int damping, const double *sums,
                          const double *lams, double *scratch, double *steps, double *promised);

/* T with T T^T = (V + lam W)^-1 in lanes, and T^T g, for sums V, for EG_DEPTHS also D, and g; W is as
   above, or V + D. Scratch has rows for an upper triangle. NaN where a matrix is not positive
   definite. */
void eg_damped_roots(ptrdiff_t M, ptrdiff_t b, int damping, const double *sums, double lam,
                     double *scratch, double *T, double *half);

#endif
