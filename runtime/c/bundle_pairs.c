/* The sums of pairs of views of the factored route: what most of its time is spent with.

   Only sums over observations are made here: where the processor has fused multiply-adds, they are
   used (see CMakeLists.txt). */
#include "bundle_moments.h"
#include "bundle_pairs.h"

/* Pair by pair, the factors F_s F_t^T of all points at once (in work), the sums in registers. F has
   what is kept of an observation to the next slot. */
void eg_factored_pairs_alike(const eg_pass *p, const eg_envelope *envelope, ptrdiff_t lanes,
                             const double *F, double *pairs)
{
    const eg_chunk *chunk = &p->chunk;
    const ptrdiff_t M = chunk->M;
    double *X = p->work;
    for (ptrdiff_t t = 0; t < chunk->L; ++t)
        for (ptrdiff_t s = 0; s <= t; ++s) {
            const ptrdiff_t kept = p->route->kept * M;
            const double *Fs = F + kept * s, *Ft = F + kept * t;
            const int32_t row = chunk->view[t * M], column = chunk->view[s * M];
            if (column < envelope->first[row])
                continue;
            double *sum = pairs + EG_PAIR * (envelope->slot[row] + column - envelope->first[row]);
            for (int a = 0; a < 3; ++a)
                for (int b = 0; b < 3; ++b) {
                    EG_SIMD
                    for (ptrdiff_t j = 0; j < M; ++j)
                        X[(3 * a + b) * M + j] =
                            Fs[(4 * a) * M + j] * Ft[(4 * b) * M + j]
                            + Fs[(4 * a + 1) * M + j] * Ft[(4 * b + 1) * M + j]
                            + Fs[(4 * a + 2) * M + j] * Ft[(4 * b + 2) * M + j]
                            + Fs[(4 * a + 3) * M + j] * Ft[(4 * b + 3) * M + j];
                }
            for (int e = 0; e < 9; e += 3)
                eg_accumulate(lanes, X + e * M, M, p->moments, sum + 8 * e, sum + 9 * 8 + 4 * e);
        }
}

/* Y (3, 4) turned. */
EG_INLINE void turn(const double *Y, double *across)
{
    for (int b = 0; b < 3; ++b)
        for (int c = 0; c < 4; ++c)
            across[4 * c + b] = Y[4 * b + c];
}

/* sum += X x moments for the nine entries of X = Ys Yt^T: Ys (3, 4), and Yt (4, 4) turned. */
EG_INLINE void add_pair(const double *EG_RESTRICT Ys, const double *EG_RESTRICT Yt,
                        const double *EG_RESTRICT moments, double *EG_RESTRICT sum)
{
    for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b) {
            const double x = Ys[4 * a] * Yt[b] + Ys[4 * a + 1] * Yt[4 + b]
                             + Ys[4 * a + 2] * Yt[8 + b] + Ys[4 * a + 3] * Yt[12 + b];
            EG_SIMD
            for (int k = 0; k < 8; ++k)
                sum[8 * (3 * a + b) + k] += x * moments[k];
            EG_SIMD
            for (int k = 0; k < 4; ++k)
                sum[9 * 8 + 4 * (3 * a + b) + k] += x * moments[8 + k];
        }
}

/* (F_s F_t^T) x Q Q^T: nine rows of moments a pair, row (a, b) for row a of the view with the lower
   number. Row by row of the envelope, so that the sums of a row stay in the fast cache meanwhile. */
void eg_factored_pairs(const eg_route *route, const eg_envelope *envelope, eg_group *group,
                       double *pairs)
{
    if (!group->count)
        return;
    (void)route;
    int32_t high, row = eg_sort_by_view(group, &high);
    for (ptrdiff_t next = 0; row <= high; ++row) {
        const int32_t lowest = envelope->first[row];
        double *sums = pairs + EG_PAIR * (envelope->slot[row] - lowest);
        for (; next < group->end[row]; ++next) {
            const ptrdiff_t t = group->sorted[next], lane = group->lane[t];
            const double *moments = group->moments + 16 * lane;
            double across[16];
            turn(group->turned + 12 * t, across);
            for (ptrdiff_t s = group->first[lane]; s <= t; ++s) {
                const int32_t column = group->view[s];
                if (column < lowest)
                    continue;
                add_pair(group->turned + 12 * s, across, moments, sums + EG_PAIR * column);
                if (s == t || column != row)
                    continue;
                double own[16]; /* a repetition stands for both orders */
                turn(group->turned + 12 * s, own);
                add_pair(group->turned + 12 * t, own, moments, sums + EG_PAIR * column);
            }
        }
    }
}
