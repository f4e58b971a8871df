/* Changes of basis of projective cameras and points, and the coordinates that images are computed in. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "bundle.h"
#include "small.h"

/* Multiply by the scale, which is found first where vectors are to have unit norm. */
static void scaled(int size, int fit, double *scale, double *x)
{
    if (fit) {
        double squared = 0.0;
        for (int k = 0; k < size; ++k)
            squared += x[k] * x[k];
        *scale = 1.0 / sqrt(squared);
    }
    for (int k = 0; k < size; ++k)
        x[k] *= *scale;
}

/* P_i <- gamma_i P_i T (n, 3, 4) and Q_j <- alpha_j T^-1 Q_j (m, 4). With `fit` the scales are those that
   make all of unit norm. Returns 1 if T is singular. */
int eg_change_basis(ptrdiff_t n, ptrdiff_t m, const double *T, int fit, double *gamma, double *alpha,
                    const double *P, const double *Q, double *moved_P, double *moved_Q)
{
    double A[16];
    int rows[4];
    memcpy(A, T, sizeof A);
    if (eg_lu(4, A, rows))
        return 1;
    for (ptrdiff_t i = 0; i < n; ++i) {
        const double *from = P + 12 * i;
        double *to = moved_P + 12 * i;
        for (int r = 0; r < 3; ++r)
            for (int c = 0; c < 4; ++c)
                to[4 * r + c] = from[4 * r] * T[c] + from[4 * r + 1] * T[4 + c]
                                + from[4 * r + 2] * T[8 + c] + from[4 * r + 3] * T[12 + c];
        scaled(12, fit, gamma + i, to);
    }
    memcpy(moved_Q, Q, (size_t)(4 * m) * sizeof(double));
    for (ptrdiff_t j = 0; j < m; ++j) {
        eg_lu_solve(4, A, rows, moved_Q + 4 * j);
        scaled(4, fit, alpha + j, moved_Q + 4 * j);
    }
    return 0;
}

/* Centroid of the image points of each view (n, 2), and the RMS of all coordinates about them. Every view
   has a point. Returns a negative number without memory. */
double eg_image_frame(ptrdiff_t n, ptrdiff_t count, const ptrdiff_t *view, const double *xy,
                      double *origins)
{
    ptrdiff_t *seen = calloc((size_t)n, sizeof(ptrdiff_t));
    double sum = 0.0;
    if (!seen)
        return -1.0;
    memset(origins, 0, (size_t)(2 * n) * sizeof(double));
    for (ptrdiff_t k = 0; k < count; ++k) {
        seen[view[k]] += 1;
        origins[2 * view[k]] += xy[2 * k];
        origins[2 * view[k] + 1] += xy[2 * k + 1];
    }
    for (ptrdiff_t i = 0; i < n; ++i) {
        origins[2 * i] /= (double)seen[i];
        origins[2 * i + 1] /= (double)seen[i];
    }
    free(seen);
    for (ptrdiff_t k = 0; k < count; ++k) {
        const double x = xy[2 * k] - origins[2 * view[k]];
        const double y = xy[2 * k + 1] - origins[2 * view[k] + 1];
        sum += x * x + y * y;
    }
    return sqrt(sum / (2.0 * (double)count));
}
