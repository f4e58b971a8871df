/* The sums of pairs of views: what most of the time of many views is spent with. */
#include "bundle_chunk.h"

/* Where the sums of a pair of views are; NULL outside the envelope. */
static inline double *pair_of(const eg_envelope *envelope, int32_t row, int32_t column, double *pairs)
{
    const int32_t first = envelope->first[row];
    return column < first ? 0 : pairs + EG_PAIR * (envelope->slot[row] + column - first);
}

/* Lanes that hold a point, where all of these are seen by the same views; else 0. */
static ptrdiff_t alike(const eg_chunk *chunk)
{
    const ptrdiff_t M = chunk->M, lanes = eg_filled(chunk, 0, M);
    if (chunk->count[lanes - 1] < chunk->count[0])
        return 0;
    for (ptrdiff_t s = 0; s < chunk->L; ++s)
        if (eg_run(chunk->view + s * M, 0, lanes) < lanes)
            return 0;
    return lanes;
}

/* Add to the pairs of a chunk whose points are seen by the same views: pair by pair, the factors
   Y_s Y_t^T of all points at once (X has 9 M entries), the sums in registers. */
static void add_alike(const eg_chunk *chunk, const eg_envelope *envelope, ptrdiff_t lanes,
                      const double *Y, const double *moments, double *X, double *pairs)
{
    const ptrdiff_t M = chunk->M;
    for (ptrdiff_t t = 0; t < chunk->L; ++t)
        for (ptrdiff_t s = 0; s <= t; ++s) {
            const double *Ys = Y + 12 * s * M, *Yt = Y + 12 * t * M;
            double *sum = pair_of(envelope, chunk->view[t * M], chunk->view[s * M], pairs);
            for (int a = 0; sum && a < 3; ++a)
                for (int b = 0; b < 3; ++b) {
                    EG_SIMD
                    for (ptrdiff_t j = 0; j < M; ++j)
                        X[(3 * a + b) * M + j] =
                            Ys[(4 * a) * M + j] * Yt[(4 * b) * M + j]
                            + Ys[(4 * a + 1) * M + j] * Yt[(4 * b + 1) * M + j]
                            + Ys[(4 * a + 2) * M + j] * Yt[(4 * b + 2) * M + j]
                            + Ys[(4 * a + 3) * M + j] * Yt[(4 * b + 3) * M + j];
                }
            for (int e = 0; sum && e < 9; e += 3)
                eg_accumulate(lanes, X + e * M, M, moments, sum + 8 * e, sum + 9 * 8 + 4 * e);
        }
}

/* The observations of a chunk view by view, entry L j + s for slot s of lane j; `end` has an entry a
   view and one more. Returns the lowest view, and the highest by its address. */
static int32_t sort_by_view(const eg_chunk *chunk, ptrdiff_t *EG_RESTRICT end,
                            int32_t *EG_RESTRICT sorted, int32_t *highest)
{
    const ptrdiff_t M = chunk->M, L = chunk->L, lanes = eg_filled(chunk, 0, M);
    int32_t low = chunk->view[0], high = low;
    for (ptrdiff_t j = 0; j < lanes; ++j) {
        const int32_t first = chunk->view[j], last = chunk->view[(chunk->count[j] - 1) * M + j];
        low = first < low ? first : low;
        high = last > high ? last : high;
    }
    for (ptrdiff_t v = low; v <= high + 1; ++v)
        end[v] = 0;
    for (ptrdiff_t j = 0; j < lanes; ++j)
        for (ptrdiff_t s = 0; s < chunk->count[j]; ++s)
            ++end[chunk->view[s * M + j] + 1];
    for (ptrdiff_t v = low; v <= high; ++v)
        end[v + 1] += end[v];
    for (ptrdiff_t j = 0; j < lanes; ++j)
        for (ptrdiff_t s = 0; s < chunk->count[j]; ++s)
            sorted[end[chunk->view[s * M + j]]++] = (int32_t)(L * j + s);
    *highest = high;
    return low;
}

/* sum += X x moments for the nine entries of X = Ys Yt^T: Ys (3, 4), and Yt (4, 4) turned. */
static inline void add_pair(const double *EG_RESTRICT Ys, const double *EG_RESTRICT Yt,
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

/* Add to the pairs of any chunk, row by row of the envelope, so that the sums of a row stay in the
   fast cache meanwhile. `turned` has room for Y. */
static void add_by_view(const eg_chunk *chunk, const eg_envelope *envelope, const double *Y,
                        const double *moments, double *EG_RESTRICT turned, ptrdiff_t *end,
                        int32_t *sorted, double *pairs)
{
    const ptrdiff_t M = chunk->M, L = chunk->L;
    int32_t high, row = sort_by_view(chunk, end, sorted, &high);
    for (ptrdiff_t s = 0; s < L; ++s)
        for (ptrdiff_t j = 0; j < M && s < chunk->count[j]; ++j)
            for (ptrdiff_t k = 0; k < 12; ++k)
                turned[12 * (L * j + s) + k] = Y[(12 * s + k) * M + j];
    for (ptrdiff_t next = 0; row <= high; ++row)
        for (; next < end[row]; ++next) {
            const ptrdiff_t j = sorted[next] / L, t = sorted[next] % L;
            const double *own = turned + 12 * L * j;
            double across[16];
            for (int b = 0; b < 3; ++b)
                for (int c = 0; c < 4; ++c)
                    across[4 * c + b] = own[12 * t + 4 * b + c];
            for (ptrdiff_t s = 0; s <= t; ++s) {
                double *sum = pair_of(envelope, row, chunk->view[s * M + j], pairs);
                if (sum)
                    add_pair(own + 12 * s, across, moments + 16 * j, sum);
            }
        }
}

/* Add (Y_s Y_t^T) x Q Q^T of all pairs of observations of each point of a chunk to the sums of their
   pairs of views. X has 9 M entries, `turned` as many as Y, `views` one a view and one more,
   `sorted` one an observation. */
void eg_add_to_pairs(const eg_chunk *chunk, const eg_envelope *envelope, const double *Y,
                     const double *moments, double *X, double *turned, ptrdiff_t *views,
                     int32_t *sorted, double *pairs)
{
    const ptrdiff_t lanes = alike(chunk);
    if (lanes)
        add_alike(chunk, envelope, lanes, Y, moments, X, pairs);
    else
        add_by_view(chunk, envelope, Y, moments, turned, views, sorted, pairs);
}
