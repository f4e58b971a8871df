/* The sums of pairs of views: what most of the time of many views is spent with.

   Only sums over observations are made here: where the processor has fused multiply-adds, they are
   used (see CMakeLists.txt). */
#include "bundle_moments.h"
#include "bundle_pairs.h"

/* Where the sums of a pair of views are; NULL outside the envelope. */
static inline double *eg_pair_of(const eg_envelope *envelope, ptrdiff_t size, int32_t row,
                                 int32_t column, double *pairs)
{
    const int32_t first = envelope->first[row];
    return column < first ? 0 : pairs + size * (envelope->slot[row] + column - first);
}

/* The observations of a chunk view by view, entry L j + s for slot s of lane j; `end` has an entry a
   view and one more. Returns the lowest view, and the highest by its address. */
static inline int32_t eg_sort_by_view(const eg_chunk *chunk, ptrdiff_t *EG_RESTRICT end,
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

/* Whether an observation is a repetition: of the same point in the same view as the one before. */
static inline int eg_repeated(const eg_chunk *chunk, ptrdiff_t s, ptrdiff_t j)
{
    return s > 0 && chunk->view[s * chunk->M + j] == chunk->view[(s - 1) * chunk->M + j];
}

/* Most lanes whose pairs are added at once; most doubles that are prepared of an observation. */
#define EG_RUN 8
#define EG_MOST_PREPARED 16

/* Lanes from the next of the sorted observations on that are neighbours, and are seen by the same
   views up to that of slot t; at most so many. */
static inline ptrdiff_t eg_run_of_lanes(const eg_chunk *chunk, const int32_t *sorted, ptrdiff_t left,
                                        ptrdiff_t t, ptrdiff_t most)
{
    const ptrdiff_t M = chunk->M, L = chunk->L, j = sorted[0] / L;
    ptrdiff_t run = 1;
    for (; run < most && run < left && sorted[run] == sorted[0] + L * run; ++run)
        for (ptrdiff_t s = 0; s < t; ++s)
            if (chunk->view[s * M + j + run] != chunk->view[s * M + j])
                return run;
    return run;
}

/* Add to the pairs of any chunk, row by row of the envelope, so that the sums of a row stay in the
   fast cache meanwhile. `turned` holds `size` doubles of each observation; `add` adds those of slots
   s and t of a run of up to `most` lanes, t's as `prepare` (unless NULL) has made them. */
EG_INLINE void eg_add_by_view(
    const eg_pass *p, const eg_envelope *envelope, ptrdiff_t size, ptrdiff_t most,
    const double *turned, ptrdiff_t *end, int32_t *sorted, double *pairs,
    void (*prepare)(const double *, double *),
    void (*add)(const eg_route *, ptrdiff_t, ptrdiff_t, const double *, const double *,
                const double *, double *))
{
    const eg_chunk *chunk = &p->chunk;
    const ptrdiff_t M = chunk->M, L = chunk->L, sums = p->route->pair_sums, stride = size * L;
    int32_t high, row = eg_sort_by_view(chunk, end, sorted, &high);
    for (ptrdiff_t next = 0, run; row <= high; ++row)
        for (; next < end[row]; next += run) {
            const ptrdiff_t j = sorted[next] / L, t = sorted[next] % L;
            const double *own = turned + stride * j;
            const double *across = own + size * t;
            double kept[EG_MOST_PREPARED];
            run = eg_run_of_lanes(chunk, sorted + next, end[row] - next, t, most);
            if (prepare) {
                prepare(across, kept);
                across = kept;
            }
            for (ptrdiff_t s = 0; s <= t; ++s) {
                double *sum = eg_pair_of(envelope, sums, row, chunk->view[s * M + j], pairs);
                if (!sum)
                    continue;
                add(p->route, run, stride, own + size * s, across, p->moments + 16 * j, sum);
                /* A repetition stands for both orders. */
                for (ptrdiff_t k = 0; s < t && chunk->view[s * M + j] == row && k < run; ++k) {
                    const double *first = own + stride * k + size * s, *second = first + size * (t - s);
                    double turned_first[EG_MOST_PREPARED];
                    if (prepare)
                        prepare(first, turned_first);
                    add(p->route, 1, stride, second, prepare ? turned_first : first,
                        p->moments + 16 * (j + k), sum);
                }
            }
        }
}

/* ---------------------------------------------------------------- the factored route */

/* Lanes that hold a point, where all of these are seen by the same views, once; else 0. */
static ptrdiff_t alike(const eg_chunk *chunk)
{
    const ptrdiff_t M = chunk->M, lanes = eg_filled(chunk, 0, M);
    if (chunk->count[lanes - 1] < chunk->count[0])
        return 0;
    for (ptrdiff_t s = 0; s < chunk->L; ++s)
        if (eg_run(chunk->view + s * M, 0, lanes) < lanes || eg_repeated(chunk, s, 0))
            return 0;
    return lanes;
}

/* Add to the pairs of a chunk whose points are seen by the same views: pair by pair, the factors
   F_s F_t^T of all points at once (in work), the sums in registers. */
static void add_alike(const eg_pass *p, const eg_envelope *envelope, ptrdiff_t lanes,
                      const double *F, double *pairs)
{
    const eg_chunk *chunk = &p->chunk;
    const ptrdiff_t M = chunk->M;
    double *X = p->work;
    for (ptrdiff_t t = 0; t < chunk->L; ++t)
        for (ptrdiff_t s = 0; s <= t; ++s) {
            const double *Fs = F + 12 * s * M, *Ft = F + 12 * t * M;
            double *sum = eg_pair_of(envelope, EG_PAIR, chunk->view[t * M], chunk->view[s * M], pairs);
            for (int a = 0; sum && a < 3; ++a)
                for (int b = 0; b < 3; ++b) {
                    EG_SIMD
                    for (ptrdiff_t j = 0; j < M; ++j)
                        X[(3 * a + b) * M + j] =
                            Fs[(4 * a) * M + j] * Ft[(4 * b) * M + j]
                            + Fs[(4 * a + 1) * M + j] * Ft[(4 * b + 1) * M + j]
                            + Fs[(4 * a + 2) * M + j] * Ft[(4 * b + 2) * M + j]
                            + Fs[(4 * a + 3) * M + j] * Ft[(4 * b + 3) * M + j];
                }
            for (int e = 0; sum && e < 9; e += 3)
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
EG_INLINE void add_pair(const eg_route *route, ptrdiff_t run, ptrdiff_t stride,
                        const double *EG_RESTRICT Ys, const double *EG_RESTRICT Yt,
                        const double *EG_RESTRICT moments, double *EG_RESTRICT sum)
{
    (void)route, (void)run, (void)stride;
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
   number. */
void eg_factored_pairs(const eg_pass *p, const eg_envelope *envelope, const double *F,
                       double *EG_RESTRICT turned, ptrdiff_t *views, int32_t *sorted, double *sums)
{
    const eg_chunk *chunk = &p->chunk;
    const ptrdiff_t M = chunk->M, L = chunk->L, lanes = alike(chunk);
    if (lanes) {
        add_alike(p, envelope, lanes, F, sums);
        return;
    }
    for (ptrdiff_t s = 0; s < L; ++s)
        for (ptrdiff_t j = 0; j < M && s < chunk->count[j]; ++j)
            for (ptrdiff_t k = 0; k < 12; ++k)
                turned[12 * (L * j + s) + k] = F[(12 * s + k) * M + j];
    eg_add_by_view(p, envelope, 12, 1, turned, views, sorted, sums, turn, add_pair);
}

/* ---------------------------------------------------------------- the direct route */

/* Y = J^T Z of every observation of a chunk, turned: b rows of the padded width. */
EG_INLINE void turn_direct(const eg_pass *p, ptrdiff_t padded, ptrdiff_t b, const double *F,
                        double *EG_RESTRICT turned)
{
    const eg_chunk *chunk = &p->chunk;
    const ptrdiff_t M = chunk->M, L = chunk->L, d = eg_model_of(p)->tangent_size;
    for (ptrdiff_t s = 0; s < L; ++s, F += p->route->factors * M) {
        const double *Z = F + 2 * d * M;
        for (ptrdiff_t j = 0; j < M && s < chunk->count[j]; ++j) {
            double first[EG_MOST_TANGENT], second[EG_MOST_TANGENT];
            double *EG_RESTRICT Y = turned + padded * b * (L * j + s);
            eg_turn_camera(p, padded, F, j, first, second);
            for (ptrdiff_t k = 0; k < b; ++k) {
                const double x = Z[k * M + j], y = Z[(b + k) * M + j];
                EG_SIMD
                for (ptrdiff_t c = 0; c < padded; ++c)
                    Y[padded * k + c] = x * first[c] + y * second[c];
            }
        }
    }
}

/* Three rows and twelve columns, or eight, of Y_s Y_t^T over a run of lanes; the sums stay in
   registers meanwhile. */
EG_INLINE void add_three(int twelve, ptrdiff_t padded, ptrdiff_t b, ptrdiff_t run, ptrdiff_t stride,
                         const double *EG_RESTRICT Ys, const double *EG_RESTRICT Yt,
                         double *EG_RESTRICT sum)
{
    double p[8] = {0.0}, q[8] = {0.0}, r[8] = {0.0}, u[4] = {0.0}, v[4] = {0.0}, w[4] = {0.0};
    ptrdiff_t j = 0;
    do {
        for (ptrdiff_t k = 0; k < b; ++k) {
            const double *EG_RESTRICT x = Ys + stride * j + padded * k;
            const double *EG_RESTRICT y = Yt + stride * j + padded * k;
            EG_SIMD
            for (int c = 0; c < 8; ++c)
                p[c] += x[0] * y[c], q[c] += x[1] * y[c], r[c] += x[2] * y[c];
            if (!twelve)
                continue;
            EG_SIMD
            for (int c = 0; c < 4; ++c)
                u[c] += x[0] * y[8 + c], v[c] += x[1] * y[8 + c], w[c] += x[2] * y[8 + c];
        }
    } while (++j < run);
    EG_SIMD
    for (int c = 0; c < 8; ++c)
        sum[c] += p[c], sum[padded + c] += q[c], sum[2 * padded + c] += r[c];
    if (!twelve)
        return;
    EG_SIMD
    for (int c = 0; c < 4; ++c)
        sum[8 + c] += u[c], sum[padded + 8 + c] += v[c], sum[2 * padded + 8 + c] += w[c];
}

/* sum += Y_s Y_t^T over a run of lanes: a row of the padded width for each unknown of the view with
   the lower number. */
EG_INLINE void add_block(ptrdiff_t K, ptrdiff_t padded, ptrdiff_t b, ptrdiff_t run, ptrdiff_t stride,
                         const double *EG_RESTRICT Ys, const double *EG_RESTRICT Yt,
                         double *EG_RESTRICT sum)
{
    ptrdiff_t a = 0;
    for (; a + 3 <= K; a += 3, Ys += 3, sum += 3 * padded) {
        ptrdiff_t c = 0;
        for (; c + 12 <= padded && padded != 16; c += 12)
            add_three(1, padded, b, run, stride, Ys, Yt + c, sum + c);
        for (; c < padded; c += 8)
            add_three(0, padded, b, run, stride, Ys, Yt + c, sum + c);
    }
    for (; a < K; ++a, ++Ys, sum += padded)
        for (ptrdiff_t j = 0; j < run; ++j)
            for (ptrdiff_t k = 0; k < b; ++k) {
                const double x = Ys[stride * j + padded * k];
                const double *EG_RESTRICT y = Yt + stride * j + padded * k;
                EG_SIMD
                for (ptrdiff_t c = 0; c < padded; ++c)
                    sum[c] += x * y[c];
            }
}

/* The loops over pairs, for points of three and four entries; W is the padded width. */
#define PAIRS(NAME, W, B)                                                                          \
    EG_INLINE void add_##NAME(const eg_route *route, ptrdiff_t run, ptrdiff_t stride,              \
                              const double *Ys, const double *Yt, const double *moments,           \
                              double *sum)                                                         \
    {                                                                                              \
        (void)moments;                                                                             \
        add_block(route->tangent, W, B, run, stride, Ys, Yt, sum);                                 \
    }                                                                                              \
    static void pairs_##NAME(const eg_pass *p, const eg_envelope *envelope, const double *F,       \
                             double *turned, ptrdiff_t *views, int32_t *sorted, double *sums)      \
    {                                                                                              \
        turn_direct(p, W, B, F, turned);                                                                \
        eg_add_by_view(p, envelope, (B) * (W), EG_RUN, turned, views, sorted, sums,                \
                       NULL, add_##NAME);                                                          \
    }
#define CASE(W) PAIRS(three_##W, W, 3) PAIRS(four_##W, W, 4)
EG_WIDTHS(CASE)
#undef CASE

eg_pairs *eg_direct_pairs(ptrdiff_t padded, ptrdiff_t b)
{
    switch (padded) {
#define CASE(W) case W: return b == 3 ? pairs_three_##W : pairs_four_##W;
        EG_WIDTHS(CASE)
#undef CASE
    }
    return b == 3 ? pairs_three_32 : pairs_four_32;
}
