/* The order in which pairs of observations are added to their pairs of views: what most of the time
   of many views is spent with. */
#ifndef EPIGAUGE_BUNDLE_PAIRS_H
#define EPIGAUGE_BUNDLE_PAIRS_H

#include "bundle_chunk.h"

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

#endif
