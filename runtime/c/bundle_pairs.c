/* The sums of pairs of views: what most of the time of many views is spent with.

   Only sums over observations are made here: where the processor has fused multiply-adds, they are
   used (see CMakeLists.txt). */
#include "bundle_moments.h"
#include "bundle_pairs.h"

/* The observations of a group view by view. Returns the lowest view, and the highest by its
   address; `end` becomes the end of each view's. */
static inline int32_t eg_sort_by_view(eg_group *group, int32_t *highest)
{
    const int32_t *EG_RESTRICT view = group->view;
    int32_t *EG_RESTRICT end = group->end, *EG_RESTRICT sorted = group->sorted;
    int32_t low = view[0], high = low;
    for (ptrdiff_t r = 0; r < group->count; ++r) {
        low = view[r] < low ? view[r] : low;
        high = view[r] > high ? view[r] : high;
    }
    memset(end + low, 0, (size_t)(high + 2 - low) * sizeof *end);
    for (ptrdiff_t r = 0; r < group->count; ++r)
        ++end[view[r] + 1];
    for (ptrdiff_t v = low; v <= high; ++v)
        end[v + 1] += end[v];
    for (ptrdiff_t r = 0; r < group->count; ++r)
        sorted[end[view[r]]++] = (int32_t)r;
    *highest = high;
    return low;
}

/* Most lanes whose pairs are added at once; most doubles that are prepared of an observation. */
#define EG_RUN 8
#define EG_MOST_PREPARED 16

/* Observations from the next of the sorted ones on that are equally far from one another, and whose
   points are seen by the same views before; at most so many. */
static inline ptrdiff_t eg_run_of_lanes(const eg_group *group, const int32_t *sorted, ptrdiff_t left,
                                        ptrdiff_t before, ptrdiff_t most)
{
    const ptrdiff_t step = left > 1 ? sorted[1] - sorted[0] : 0;
    const int32_t *view = group->view + sorted[0];
    ptrdiff_t run = 1;
    for (; run < most && run < left && sorted[run] == sorted[0] + step * run; ++run) {
        const ptrdiff_t r = sorted[run];
        if (r - group->first[group->lane[r]] != before)
            return run;
        for (ptrdiff_t s = 1; s <= before; ++s)
            if (view[step * run - s] != view[-s])
                return run;
    }
    return run;
}

/* Add to the pairs of a group, row by row of the envelope, so that the sums of a row stay in the fast
   cache meanwhile. `add` adds those of two observations of a run of up to `most` points, the second
   ones as `prepare` (unless NULL) has made them. */
EG_INLINE void eg_add_by_view(
    const eg_route *route, const eg_envelope *envelope, eg_group *group, ptrdiff_t size,
    ptrdiff_t most, double *pairs, void (*prepare)(const double *, double *),
    void (*add)(const eg_route *, ptrdiff_t, ptrdiff_t, const double *, const double *,
                const double *, double *))
{
    if (!group->count)
        return;
    const ptrdiff_t sums = route->pair_sums.size;
    const double *turned = group->turned;
    int32_t high, row = eg_sort_by_view(group, &high);
    for (ptrdiff_t next = 0, run; row <= high; ++row) {
        const int32_t lowest = envelope->first[row];
        double *sums_of_row = pairs + sums * (envelope->slot[row] - lowest);
        for (; next < group->end[row]; next += run) {
            const int32_t *sorted = group->sorted + next;
            const ptrdiff_t left = group->end[row] - next, t = sorted[0];
            const ptrdiff_t lane = group->lane[t], first = group->first[lane];
            const double *across = turned + size * t, *moments = group->moments + 16 * lane;
            double kept[EG_MOST_PREPARED];
            run = eg_run_of_lanes(group, sorted, left, t - first, most);
            const ptrdiff_t stride = run > 1 ? size * (sorted[1] - t) : 0;
            if (prepare) {
                prepare(across, kept);
                across = kept;
            }
            for (ptrdiff_t s = first; s <= t; ++s) {
                const int32_t column = group->view[s];
                if (column < lowest)
                    continue;
                double *sum = sums_of_row + sums * column;
                add(route, run, stride, turned + size * s, across, moments, sum);
                /* A repetition stands for both orders. */
                for (ptrdiff_t k = 0; s < t && column == row && k < run; ++k) {
                    const double *own = turned + size * s + stride * k;
                    double turned_own[EG_MOST_PREPARED];
                    if (prepare)
                        prepare(own, turned_own);
                    add(route, 1, 0, own + size * (t - s), prepare ? turned_own : own, moments, sum);
                }
            }
        }
    }
}

/* ---------------------------------------------------------------- the factored route */

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
void eg_factored_pairs(const eg_route *route, const eg_envelope *envelope, eg_group *group,
                       double *pairs)
{
    eg_add_by_view(route, envelope, group, 12, 1, pairs, turn, add_pair);
}

/* ---------------------------------------------------------------- the direct route */

/* Where `turn_cameras` keeps the Jacobians of a slot: lane by lane, rows of both coordinates. */
EG_INLINE double *turned_cameras(const eg_pass *p)
{
    return p->kept + (1 + 2 * p->route->point) * p->chunk.M;
}

/* Turn Jacobians J (2, tangent of the model) of a slot; rows are filled up with zeros. */
EG_INLINE void turn_cameras(const eg_pass *p, ptrdiff_t padded, const double *J)
{
    const ptrdiff_t M = p->chunk.M, K = p->route->tangent, d = eg_model_of(p)->tangent_size;
    const int32_t *column = p->bundle->columns;
    const double *row[2 * EG_MOST_TANGENT];
    memset(p->loss, 0, (size_t)M * sizeof(double)); /* not needed any more */
    for (ptrdiff_t k = 0; k < padded; ++k) {
        row[k] = k < K ? J + column[k] * M : p->loss;
        row[padded + k] = k < K ? J + (d + column[k]) * M : p->loss;
    }
    for (ptrdiff_t k = 0; k < 2 * padded; k += 4) {
        const double *EG_RESTRICT x = row[k], *EG_RESTRICT y = row[k + 1];
        const double *EG_RESTRICT z = row[k + 2], *EG_RESTRICT w = row[k + 3];
        double *EG_RESTRICT to = turned_cameras(p) + k;
        for (ptrdiff_t j = 0; j < p->filled; ++j, to += 2 * padded)
            to[0] = x[j], to[1] = y[j], to[2] = z[j], to[3] = w[j];
    }
}

/* Sums of the cameras of a slot, K rows of the upper triangle of J^T J, from the multiple of four
   before the diagonal on, and one of the gradient. */
EG_INLINE void add_to_cameras(const eg_pass *p, ptrdiff_t padded, const double *r, double *cameras)
{
    const ptrdiff_t M = p->chunk.M, K = p->route->tangent;
    const double *first = turned_cameras(p);
    for (ptrdiff_t j = 0; j < p->filled; ++j, first += 2 * padded) {
        const double *EG_RESTRICT x = first, *EG_RESTRICT y = first + padded;
        double *EG_RESTRICT sum = cameras + p->route->camera_sums * p->view[j];
        const double w = p->w[j], e = w * r[j], f = w * r[M + j];
        for (ptrdiff_t begin = 0; begin < padded; begin += 4)
            for (ptrdiff_t a = begin; a < begin + 4 && a < K; ++a) {
                const double u = w * x[a], v = w * y[a];
                EG_SIMD
                for (ptrdiff_t c = begin; c < padded; ++c)
                    sum[padded * a + c] += u * x[c] + v * y[c];
            }
        EG_SIMD
        for (ptrdiff_t c = 0; c < padded; ++c)
            sum[padded * K + c] -= e * x[c] + f * y[c];
    }
}

/* Y = J^T Z of every observation of a slot, turned: b rows of the padded width; reduced += Y v. */
EG_INLINE void turn_direct(const eg_pass *p, ptrdiff_t padded, ptrdiff_t b, const double *Z,
                           const double *v, const int32_t *begin, ptrdiff_t s, double *turned,
                           double *reduced)
{
    const ptrdiff_t M = p->chunk.M;
    const double *first = turned_cameras(p);
    for (ptrdiff_t j = 0; j < p->filled; ++j, first += 2 * padded) {
        const double *EG_RESTRICT x = first, *EG_RESTRICT y = first + padded;
        double *EG_RESTRICT Y = turned + padded * b * (begin[j] + s);
        double *EG_RESTRICT sum = reduced + padded * p->view[j];
        double e = 0.0, f = 0.0;
        for (ptrdiff_t k = 0; k < b; ++k) {
            const double u = Z[k * M + j], t = Z[(b + k) * M + j];
            EG_SIMD
            for (ptrdiff_t c = 0; c < padded; ++c)
                Y[padded * k + c] = u * x[c] + t * y[c];
            if (v)
                e += u * v[k * M + j], f += t * v[k * M + j];
        }
        EG_SIMD
        for (ptrdiff_t c = 0; c < padded; ++c)
            sum[c] += e * x[c] + f * y[c];
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

/* The loops for points of B entries; W is the width of rows. */
#define LOOPS(NAME, W, B)                                                                          \
    EG_INLINE void add_##NAME(const eg_route *route, ptrdiff_t run, ptrdiff_t stride,              \
                              const double *Ys, const double *Yt, const double *moments,           \
                              double *sum)                                                         \
    {                                                                                              \
        (void)moments;                                                                             \
        add_block(route->tangent, W, B, run, stride, Ys, Yt, sum);                                 \
    }                                                                                              \
    static void pairs_##NAME(const eg_route *route, const eg_envelope *envelope, eg_group *group,  \
                             double *sums)                                                         \
    {                                                                                              \
        eg_add_by_view(route, envelope, group, (B) * (W), EG_RUN, sums, NULL, add_##NAME);         \
    }                                                                                              \
    static void turn_slot_##NAME(const eg_pass *p, const double *Z, const double *v,               \
                                 const int32_t *first, ptrdiff_t s, eg_group *group,               \
                                 double *reduced)                                                  \
    {                                                                                              \
        turn_direct(p, W, B, Z, v, first, s, group->turned, reduced);                              \
    }

/* Those of a width. */
#define WIDTH(W)                                                                                   \
    static void turn_cameras_##W(const eg_pass *p, const double *J)                                \
    {                                                                                              \
        turn_cameras(p, W, J);                                                                     \
    }                                                                                              \
    static void add_cameras_##W(const eg_pass *p, const double *r, double *cameras)                \
    {                                                                                              \
        add_to_cameras(p, W, r, cameras);                                                          \
    }                                                                                              \
    LOOPS(three_##W, W, 3) LOOPS(four_##W, W, 4)

EG_WIDTHS(WIDTH)

void eg_direct_loops(eg_route *route)
{
    const int three = route->point == 3;
    switch (route->padded) {
#define CASE(W)                                                                                    \
    case W:                                                                                        \
        route->turn_cameras = turn_cameras_##W;                                                    \
        route->add_cameras = add_cameras_##W;                                                      \
        route->turn_slot = three ? turn_slot_three_##W : turn_slot_four_##W;                       \
        route->pairs = three ? pairs_three_##W : pairs_four_##W;                                   \
        break;
        EG_WIDTHS(CASE)
#undef CASE
    }
}
