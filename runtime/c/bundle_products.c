/* The sums of the direct route over cameras and pairs of views: what most of its time is spent with.

   Only sums over observations are made here: where the processor has fused multiply-adds, they are
   used (see CMakeLists.txt). Widths of rows, and sizes of the tiles of a block whose sums stay in
   registers, are constants to the compiler. */
#include "bundle_pairs.h"

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

/* Rows from `a` on and columns from `c` on, so many, of the sum of w x x^T over the rows x, so many, of
   each entry of a list: all of them in turn, or those of some numbers; of weight one where w is NULL.
   With `last`, the ninth column as well, nine entries of it at once. */
EG_INLINE void own_tile(ptrdiff_t padded, ptrdiff_t b, int rows, int wide, int last, ptrdiff_t a,
                        ptrdiff_t c, ptrdiff_t count, const int32_t *number, const double *w,
                        const double *EG_RESTRICT list, double *EG_RESTRICT sum)
{
    double own[4][8], column[12];
    for (int i = 0; i < rows; ++i)
        for (int l = 0; l < wide; ++l)
            own[i][l] = 0.0;
    for (int i = 0; i < 12; ++i)
        column[i] = 0.0;
    ptrdiff_t k = 0;
    do {
        const double *EG_RESTRICT x = list + padded * b * (number ? number[k] : k);
        for (ptrdiff_t e = 0; e < b; ++e, x += padded) {
            for (int i = 0; i < rows; ++i) {
                const double u = w ? w[k] * x[a + i] : x[a + i];
                EG_SIMD
                for (int l = 0; l < wide; ++l)
                    own[i][l] += u * x[c + l];
            }
            const double u = last ? (w ? w[k] * x[8] : x[8]) : 0.0;
            EG_SIMD
            for (int i = 0; i < (last ? 12 : 0); ++i)
                column[i] += u * x[i];
        }
    } while (++k < count);
    for (int i = 0; i < rows; ++i) {
        EG_SIMD
        for (int l = 0; l < wide; ++l)
            sum[padded * (a + i) + c + l] += own[i][l];
    }
    for (int i = 0; i < (last ? 9 : 0); ++i)
        sum[padded * i + 8] += column[i];
}

/* The same for the upper triangle of a block (K, K), from the multiple of four before the diagonal
   on. */
EG_INLINE void add_own(ptrdiff_t K, ptrdiff_t padded, ptrdiff_t b, ptrdiff_t count,
                       const int32_t *number, const double *w, const double *list, double *sum)
{
    if (padded == 12 && K == 9) {
        own_tile(12, b, 4, 8, 0, 0, 0, count, number, w, list, sum);
        own_tile(12, b, 4, 4, 1, 4, 4, count, number, w, list, sum);
        return;
    }
    for (ptrdiff_t a = 0; a < K; a += a + 4 <= K ? 4 : 1)
        for (ptrdiff_t c = a / 4 * 4; c < padded; c += c + 8 <= padded ? 8 : 4) {
            if (a + 4 <= K && c + 8 <= padded)
                own_tile(padded, b, 4, 8, 0, a, c, count, number, w, list, sum);
            else if (a + 4 <= K)
                own_tile(padded, b, 4, 4, 0, a, c, count, number, w, list, sum);
            else if (c + 8 <= padded)
                own_tile(padded, b, 1, 8, 0, a, c, count, number, w, list, sum);
            else
                own_tile(padded, b, 1, 4, 0, a, c, count, number, w, list, sum);
        }
}

/* Sums of the cameras of a slot, K rows of the upper triangle of J^T J and one of the gradient. */
EG_INLINE void add_to_cameras(const eg_pass *p, ptrdiff_t padded, const double *r, double *cameras)
{
    const ptrdiff_t M = p->chunk.M, K = p->route->tangent;
    for (ptrdiff_t j = 0, end; j < p->filled; j = end) {
        double *sum = cameras + p->route->camera_sums * p->view[j];
        const double *J = turned_cameras(p) + 2 * padded * j;
        end = eg_run(p->view, j, p->filled);
        add_own(K, padded, 2, end - j, NULL, p->w + j, J, sum);
        double *EG_RESTRICT gradient = sum + padded * K;
        for (; j < end; ++j, J += 2 * padded) {
            const double e = p->w[j] * r[j], f = p->w[j] * r[M + j];
            const double *EG_RESTRICT x = J;
            EG_SIMD
            for (ptrdiff_t c = 0; c < padded; ++c)
                gradient[c] -= e * x[c] + f * x[padded + c];
        }
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

/* Rows from `a` on and columns from `c` on, so many, of the sum of Y_s Y_t^T over waiting pairs.
   With `last`, the ninth column as well, nine entries of it at once. */
EG_INLINE void pair_tile(const eg_waiting *waiting, ptrdiff_t padded, ptrdiff_t b, int rows, int wide,
                         int last, ptrdiff_t a, ptrdiff_t c, const double *EG_RESTRICT turned,
                         double *EG_RESTRICT sum)
{
    double own[6][12], column[12];
    for (int i = 0; i < rows; ++i)
        for (int l = 0; l < wide; ++l)
            own[i][l] = 0.0;
    for (int i = 0; i < 12; ++i)
        column[i] = 0.0;
    int32_t k = 0;
    do {
        const double *EG_RESTRICT x = turned + padded * b * waiting->pair[2 * k];
        const double *EG_RESTRICT y = turned + padded * b * waiting->pair[2 * k + 1];
        for (ptrdiff_t e = 0; e < b; ++e, x += padded, y += padded) {
            for (int i = 0; i < rows; ++i) {
                EG_SIMD
                for (int l = 0; l < wide; ++l)
                    own[i][l] += x[a + i] * y[c + l];
            }
            EG_SIMD
            for (int i = 0; i < (last ? 12 : 0); ++i)
                column[i] += x[i] * y[8];
        }
    } while (++k < waiting->count);
    for (int i = 0; i < rows; ++i) {
        EG_SIMD
        for (int l = 0; l < wide; ++l)
            sum[padded * (a + i) + c + l] += own[i][l];
    }
    for (int i = 0; i < (last ? 9 : 0); ++i)
        sum[padded * i + 8] += column[i];
}

/* sum += Y_s Y_t^T of the waiting pairs: a row of the padded width for each unknown of the view with
   the lower number. */
EG_INLINE void add_waiting(const eg_waiting *waiting, ptrdiff_t K, ptrdiff_t padded, ptrdiff_t b,
                           const double *turned, double *sum)
{
    if (padded == 12 && K == 9) { /* three quarters of what twelve columns take */
        pair_tile(waiting, 12, b, 5, 8, 0, 0, 0, turned, sum);
        pair_tile(waiting, 12, b, 4, 8, 1, 5, 0, turned, sum);
        return;
    }
    for (ptrdiff_t c = 0; c < padded; c += padded - c == 12 ? 12 : 8) {
        ptrdiff_t a = 0;
        if (padded - c == 12) {
            for (; a + 4 <= K; a += 4)
                pair_tile(waiting, padded, b, 4, 12, 0, a, c, turned, sum);
            for (; a + 2 <= K; a += 2)
                pair_tile(waiting, padded, b, 2, 12, 0, a, c, turned, sum);
            for (; a < K; ++a)
                pair_tile(waiting, padded, b, 1, 12, 0, a, c, turned, sum);
            continue;
        }
        for (; a + 6 <= K; a += 6)
            pair_tile(waiting, padded, b, 6, 8, 0, a, c, turned, sum);
        for (; a + 3 <= K; a += 3)
            pair_tile(waiting, padded, b, 3, 8, 0, a, c, turned, sum);
        for (; a < K; ++a)
            pair_tile(waiting, padded, b, 1, 8, 0, a, c, turned, sum);
    }
}

/* Add to the pairs of a group, row by row of the envelope, so that its sums stay in the fast cache
   meanwhile; column by column in turn, so that those of a pair of views stay in registers. Of a view
   with itself, the upper triangle. */
EG_INLINE void add_pairs(const eg_route *route, const eg_envelope *envelope, eg_group *group,
                         ptrdiff_t padded, ptrdiff_t b, double *pairs)
{
    if (!group->count)
        return;
    const ptrdiff_t K = route->tangent, size = padded * K;
    const int32_t *view = group->view;
    int32_t high, row = eg_sort_by_view(group, &high);
    for (ptrdiff_t next = 0; row <= high; ++row) {
        const int32_t lowest = envelope->first[row], *sorted = group->sorted + next;
        const ptrdiff_t count = group->end[row] - next;
        double *sums = pairs + size * (envelope->slot[row] - lowest);
        ptrdiff_t columns = 0;
        next += count;
        if (count)
            add_own(K, padded, b, count, sorted, NULL, group->turned, sums + size * row);
        for (ptrdiff_t k = 0; k < count; ++k) {
            const int32_t t = sorted[k];
            for (int32_t s = group->first[group->lane[t]]; s < t; ++s) {
                const int32_t column = view[s];
                if (column < lowest)
                    continue;
                eg_waiting *own = group->waiting + column;
                if (!own->count)
                    group->columns[columns++] = column;
                if (own->count >= EG_WAITING - 1) {
                    add_waiting(own, K, padded, b, group->turned, sums + size * column);
                    own->count = 0;
                }
                own->pair[2 * own->count] = s;
                own->pair[2 * own->count++ + 1] = t;
                if (column == row) { /* a repetition stands for both orders */
                    own->pair[2 * own->count] = t;
                    own->pair[2 * own->count++ + 1] = s;
                }
            }
        }
        for (ptrdiff_t k = 0; k < columns; ++k) {
            eg_waiting *own = group->waiting + group->columns[k];
            add_waiting(own, K, padded, b, group->turned, sums + size * group->columns[k]);
            own->count = 0;
        }
    }
}

/* The loops for points of B entries; W is the width of rows. */
#define LOOPS(NAME, W, B)                                                                          \
    static void pairs_##NAME(const eg_route *route, const eg_envelope *envelope, eg_group *group,  \
                             double *sums)                                                         \
    {                                                                                              \
        add_pairs(route, envelope, group, W, B, sums);                                             \
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
