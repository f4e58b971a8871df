/* A whole damped step, for systems small enough that the calls between its parts would cost more. */
#include <stdlib.h>
#include <string.h>

#include "bundle.h"
#include "skyline.h"

/* step = -(N + lam W)^-1 g for cameras (n, 12), then points (m, 4), solved where W = I; energy =
   step^T W step. Cameras are in the order of the envelope, whose blocks are 12x12. Returns 1 where
   there is no memory, 2 where a matrix is not positive definite. */
int eg_bundle_step(
    const eg_bundle *bundle, const eg_envelope *envelope, const double *P, const double *Q,
    const double *U, const double *V, const double *g_cameras, const double *g_points,
    const double *W_cameras, const double *W_points, double lam, double *step, double *energy)
{
    const ptrdiff_t n = bundle->n_views, m = bundle->n_points, blocks = envelope->slot[n];
    const ptrdiff_t sizes[] = {EG_PAIR * blocks, 144 * blocks, 144 * n, 144 * n, 12 * n, 12 * n,
                               16 * m, 4 * m, 4 * m};
    enum { PAIRS, REDUCED, ROOTS, WHITE, ELIMINATED, SOLVED, T, HALF, COUPLED, PARTS };
    double *part[PARTS];
    ptrdiff_t size = 8;
    for (int k = 0; k < PARTS; ++k)
        size += sizes[k];
    void *whole = malloc((size_t)size * sizeof(double));
    if (!whole)
        return 1;
    part[0] = (double *)(((uintptr_t)whole + 63) & ~(uintptr_t)63);
    for (int k = 1; k < PARTS; ++k)
        part[k] = part[k - 1] + sizes[k - 1];
    memset(part[PAIRS], 0, (size_t)sizes[PAIRS] * sizeof(double));
    memset(part[ELIMINATED], 0, (size_t)sizes[ELIMINATED] * sizeof(double));
    const ptrdiff_t chunks = bundle->n_chunks;
    int status = 2;
    if (!eg_bundle_whiten(n, U, W_cameras, lam, part[ROOTS], part[WHITE]) &&
        !eg_bundle_inverse_roots(m, 4, V, W_points, 16, lam, g_points, part[T], part[HALF])) {
        status = eg_bundle_schur(bundle, 0, chunks, P, Q, part[T], part[HALF], envelope,
                                 part[PAIRS], part[ELIMINATED]);
    }
    if (!status) {
        double *z = part[SOLVED];
        for (ptrdiff_t i = 0; i < n; ++i) {
            const double *A = part[ROOTS] + 144 * i;
            for (ptrdiff_t k = 0; k < 12; ++k) {
                z[12 * i + k] = 0.0;
                for (ptrdiff_t l = 0; l <= k; ++l)
                    z[12 * i + k] += A[12 * l + k] * (part[ELIMINATED][12 * i + l] - g_cameras[12 * i + l]);
            }
        }
        eg_bundle_reduce(envelope, part[PAIRS], part[WHITE], part[ROOTS], part[REDUCED]);
        if (eg_envelope_factor(envelope, part[REDUCED]))
            status = 2;
    }
    if (!status) {
        double *z = part[SOLVED];
        eg_envelope_solve(envelope, part[REDUCED], 1, z);
        *energy = 0.0;
        for (ptrdiff_t i = 0; i < n; ++i) {
            const double *A = part[ROOTS] + 144 * i;
            for (ptrdiff_t k = 0; k < 12; ++k) {
                step[12 * i + k] = 0.0;
                for (ptrdiff_t l = k; l < 12; ++l)
                    step[12 * i + k] += A[12 * k + l] * z[12 * i + l];
                *energy += z[12 * i + k] * z[12 * i + k];
            }
        }
        status = eg_bundle_couple(bundle, 0, chunks, P, Q, part[T], step, 0, part[COUPLED], 0);
        if (!status)
            *energy += eg_bundle_point_steps(m, 4, part[T], part[HALF], part[COUPLED],
                                             W_points, 16, step + 12 * n);
    }
    free(whole);
    return status;
}
