/* What cheap tests say of refined pairs: most are plainly in order, the others are left to Python.

   The reference is runtime/epigauge/two_view/quick.py, which also says what the numbers mean. */
#include "small.h"
#include "two_view.h"

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* Offsets in the results of a pair, as in pairs.c. */
enum { PAIR_FRAME = 31, PAIR_MOTION = 36, PAIR_CONDITIONED = 55, PAIR_NORMAL = 64,
       PAIR_DOUBLES = 145 };

/* Numbers of a pair, as `quick.Facts` has them. */
enum { COUNT = 0, SQUARES, EXTENT, LEAST, UNORIENTED, MEDIAN, TAIL, FOURTH, AFFINE, ON_PLANE,
       PLANE, CHANCE, NEAR, REPEATED, PLACES, LITTLE, FACTS };

typedef struct {
    ptrdiff_t n;
    double *q, *weights, *d, *squares, *kappa, *gain, *room;
} scratch_t;

static int by_size(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* The k-th smallest of n values, which change their places (Hoare). */
static double kth(double *values, ptrdiff_t n, ptrdiff_t k)
{
    ptrdiff_t low = 0, high = n - 1;
    while (high - low > 16) {
        const double pivot = values[low + (high - low) / 2];
        ptrdiff_t i = low, j = high;
        while (i <= j) {
            while (values[i] < pivot)
                ++i;
            while (values[j] > pivot)
                --j;
            if (i <= j) {
                const double kept = values[i];
                values[i++] = values[j];
                values[j--] = kept;
            }
        }
        if (k <= j)
            high = j;
        else if (k >= i)
            low = i;
        else
            return values[k];
    }
    qsort(values + low, (size_t)(high - low + 1), sizeof *values, by_size);
    return values[k];
}

double eg_median(double *values, ptrdiff_t n)
{
    const double upper = kth(values, n, n / 2);
    if (n % 2)
        return upper;
    double lower = values[0];
    for (ptrdiff_t i = 1; i < n / 2; ++i)
        lower = fmax(lower, values[i]);
    return 0.5 * (lower + upper);
}

/* Conditioned coordinates (x1, y1, x2, y2, each of n) and weights of the matches that count. */
static void gather(scratch_t *s, ptrdiff_t m, const double *x1, const double *x2,
                   const double *weights, const double *distances, const double *frame)
{
    const double scale = 1.0 / frame[4];
    ptrdiff_t n = 0;
    for (ptrdiff_t i = 0; i < m; ++i)
        n += !weights || weights[i] > 0.0;
    s->n = n;
    n = 0;
    for (ptrdiff_t i = 0; i < m; ++i) {
        if (weights && !(weights[i] > 0.0))
            continue;
        s->q[n] = scale * (x1[2 * i] - frame[0]);
        s->q[s->n + n] = scale * (x1[2 * i + 1] - frame[1]);
        s->q[2 * s->n + n] = scale * (x2[2 * i] - frame[2]);
        s->q[3 * s->n + n] = scale * (x2[2 * i + 1] - frame[3]);
        s->weights[n] = weights ? weights[i] : 1.0;
        s->d[n++] = scale * distances[i];
    }
}

static double extent(const scratch_t *s)
{
    double widest = 0.0;
    for (int c = 0; c < 4; ++c) {
        const double *x = s->q + c * s->n;
        double low = x[0], high = x[0];
        for (ptrdiff_t i = 1; i < s->n; ++i) {
            low = x[i] < low ? x[i] : low;
            high = x[i] > high ? x[i] : high;
        }
        widest = fmax(widest, high - low);
    }
    return widest;
}

/* The least eigenvalue of J^T J among the directions in which F stays of rank two and unit norm. */
static double least_determined(const double *motion, const double *N)
{
    static const int rows[6] = {0, 0, 1, 1, 2, 2}, columns[6] = {1, 2, 0, 2, 0, 1};
    const double *U = motion, *V = motion + 9, sigma = motion[18];
    const double norm = sqrt(1.0 + sigma * sigma);
    double basis[63], half[63], A[49], values[7], vectors[49];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            double *row = basis + 7 * (3 * i + j);
            for (int k = 0; k < 6; ++k)
                row[k] = U[3 * i + rows[k]] * V[3 * j + columns[k]];
            row[6] = (sigma * U[3 * i] * V[3 * j] - U[3 * i + 1] * V[3 * j + 1]) / norm;
        }
    eg_product(9, 9, 7, N, basis, half);
    eg_transposed_product(7, 9, 7, basis, half, A);
    eg_eigen(7, A, values, vectors);
    return values[0] > 1e-14 * values[6] ? values[0] : 0.0;
}

/* How many matches, not within the noise of an epipole, are oriented otherwise than most. */
static double unoriented(const scratch_t *s, const double *motion, const double *F, double near)
{
    const double e1[3] = {motion[11], motion[14], motion[17]};
    const double e2[3] = {motion[2], motion[5], motion[8]};
    const double *x1 = s->q, *y1 = x1 + s->n, *x2 = y1 + s->n, *y2 = x2 + s->n;
    const double near1 = near * near * e1[2] * e1[2], near2 = near * near * e2[2] * e2[2];
    double above = 0.0, below = 0.0;
    EG_SUM(above, below)
    for (ptrdiff_t i = 0; i < s->n; ++i) {
        const double a = x1[i] * e1[2] - e1[0], b = y1[i] * e1[2] - e1[1];
        const double c = x2[i] * e2[2] - e2[0], d = y2[i] * e2[2] - e2[1];
        const double third = e2[0] * y2[i] - e2[1] * x2[i];
        const double line0 = F[0] * x1[i] + F[1] * y1[i] + F[2];
        const double line1 = F[3] * x1[i] + F[4] * y1[i] + F[5];
        const double line2 = F[6] * x1[i] + F[7] * y1[i] + F[8];
        const double sign = c * line1 - d * line0 + third * line2;
        const double told = a * a + b * b > near1 && c * c + d * d > near2 ? 1.0 : 0.0;
        above += sign > 0.0 ? told : 0.0;
        below += sign > 0.0 ? 0.0 : told;
    }
    return fmin(above, below);
}

/* The weighted sum of squared distances to the best affine F, a plane in the space of q and q'. */
static double affine(const scratch_t *s)
{
    double total = 0.0, mean[4] = {0.0}, A[16], values[4], vectors[16];
    for (ptrdiff_t i = 0; i < s->n; ++i)
        total += s->weights[i];
    for (int c = 0; c < 4; ++c) {
        const double *x = s->q + c * s->n;
        double sum = 0.0;
        EG_SUM(sum)
        for (ptrdiff_t i = 0; i < s->n; ++i)
            sum += s->weights[i] * x[i];
        mean[c] = sum / total;
    }
    for (int c = 0; c < 4; ++c)
        for (int r = c; r < 4; ++r) {
            const double *x = s->q + c * s->n, *y = s->q + r * s->n, mx = mean[c], my = mean[r];
            double sum = 0.0;
            EG_SUM(sum)
            for (ptrdiff_t i = 0; i < s->n; ++i)
                sum += s->weights[i] * (x[i] - mx) * (y[i] - my);
            A[4 * c + r] = A[4 * r + c] = sum;
        }
    eg_eigen(4, A, values, vectors);
    return values[0];
}

/* A plane k = v^T q by plane and parallax, and the matches that it is judged by. */
typedef struct {
    ptrdiff_t n, step;
    const double *x, *y, *kappa, *gain;
} pool_t;

/* How many matches are within a bound of a plane. One on an epipole (NaN) says nothing: it is. */
static double count_on(const pool_t *p, const double *v, double bound)
{
    const double v0 = v[0], v1 = v[1], v2 = v[2];
    double count = 0.0;
    EG_SUM(count)
    for (ptrdiff_t i = 0; i < p->n; i += p->step) {
        const double off = p->gain[i] * (p->kappa[i] - v0 * p->x[i] - v1 * p->y[i] - v2);
        count += fabs(off) > bound ? 0.0 : 1.0;
    }
    return count;
}

/* The least-squares plane of those within a bound of v. */
static void refit(const pool_t *p, double bound, double *v)
{
    double A[9] = {0.0}, b[3] = {0.0}, L[9];
    for (ptrdiff_t i = 0; i < p->n; i += p->step) {
        const double row[3] = {p->x[i], p->y[i], 1.0}, k = p->kappa[i], g = p->gain[i];
        if (!(fabs(g * (k - v[0] * row[0] - v[1] * row[1] - v[2])) <= bound))
            continue;
        for (int r = 0; r < 3; ++r) {
            b[r] += g * g * row[r] * k;
            for (int c = 0; c < 3; ++c)
                A[3 * r + c] += g * g * row[r] * row[c];
        }
    }
    if (eg_cholesky(3, A, 0.0, L) > 0.0) {
        eg_cholesky_solve(3, L, b);
        memcpy(v, b, sizeof b);
    }
}

/* In how many places those are that are off a plane: side by side in both images they are one. */
static double places_off(const scratch_t *s, const pool_t *p, const double *v, double bound,
                         double beside)
{
    double *cells = s->room;
    ptrdiff_t found = 0;
    for (ptrdiff_t i = 0; i < p->n; i += p->step) {
        const double off = p->gain[i] * (p->kappa[i] - v[0] * p->x[i] - v[1] * p->y[i] - v[2]);
        double *own = cells + 4 * found;
        ptrdiff_t k = 0;
        if (!(fabs(off) > bound))
            continue;
        for (int c = 0; c < 4; ++c)
            own[c] = nearbyint(s->q[c * s->n + i] / beside);
        while (k < found && (cells[4 * k] != own[0] || cells[4 * k + 1] != own[1] ||
                             cells[4 * k + 2] != own[2] || cells[4 * k + 3] != own[3]))
            ++k;
        found += k == found;
    }
    return (double)found;
}

/* The share of the matches that the best of some planes through three of them explains, in how many
   places the others are, and which share has next to no relief, whatever the noise. */
static void on_plane(scratch_t *s, const double *motion, const double *F, double noise,
                     const eg_quick_options *options, double *facts)
{
    const double e2[3] = {motion[2], motion[5], motion[8]};
    const double unit = sqrt(2.0) * noise; /* of a parallax, whose length both images share */
    const ptrdiff_t n = s->n, step = (n + options->pool - 1) / options->pool;
    const pool_t p = {n, step, s->q, s->q + n, s->kappa, s->gain};
    const uint64_t size = (uint64_t)((n + step - 1) / step);
    const double *x = p.x, *y = p.y, *k = p.kappa;
    double most = 0.0, best[3] = {0.0};
    uint64_t state = 1;
    eg_plane_parallax(n, F, e2, s->q, s->q + 2 * n, s->kappa, s->gain);
    for (ptrdiff_t trial = 0; trial < options->samples; ++trial) {
        ptrdiff_t three[3];
        for (int j = 0; j < 3; ++j) {
            state = state * 6364136223846793005u + 1442695040888963407u;
            three[j] = step * (ptrdiff_t)((state >> 33) % size);
        }
        const ptrdiff_t a = three[0], b = three[1], c = three[2];
        const double bx = x[b] - x[a], by = y[b] - y[a], cx = x[c] - x[a], cy = y[c] - y[a];
        const double bk = k[b] - k[a], ck = k[c] - k[a], area = bx * cy - by * cx;
        double v[3] = {(bk * cy - ck * by) / area, (bx * ck - cx * bk) / area, 0.0};
        v[2] = k[a] - v[0] * x[a] - v[1] * y[a];
        /* Three points on a line, or on an epipole, say nothing. */
        if (!isfinite(v[0]) || !isfinite(v[1]) || !isfinite(v[2]))
            continue;
        const double count = count_on(&p, v, options->reach * unit);
        if (count > most) {
            most = count;
            memcpy(best, v, sizeof best);
        }
    }
    for (ptrdiff_t k = 0; k < options->grows; ++k)
        refit(&p, options->reach * unit, best);
    refit(&p, options->far * unit, best);
    facts[PLACES] = places_off(s, &p, best, options->far * unit, options->beside);
    facts[ON_PLANE] = count_on(&p, best, options->far * unit) / (double)size;
    facts[LITTLE] = count_on(&p, best, sqrt(2.0) * options->little) / (double)size;
}

/* The eigenvector of the least eigenvalue, near the one given, by inverse iteration. */
static void least_vector(const double *packed, double *h)
{
    double A[81], L[81], trace = 0.0;
    for (int i = 0, k = 0; i < 9; ++i)
        for (int j = i; j < 9; ++j, ++k)
            A[9 * i + j] = A[9 * j + i] = packed[k];
    for (int i = 0; i < 9; ++i)
        trace += A[10 * i];
    eg_cholesky(9, A, 1e-15 * trace, L);
    for (int k = 0; k < 8; ++k) {
        double norm = 0.0;
        eg_cholesky_solve(9, L, h);
        for (int i = 0; i < 9; ++i)
            norm += h[i] * h[i];
        norm = 1.0 / sqrt(norm);
        for (int i = 0; i < 9; ++i)
            h[i] *= norm;
    }
}

/* The weighted sum of squared distances to the homography that fits all matches best. */
static double plane(scratch_t *s)
{
    /* With this one the equations themselves are weighed, one like the other. */
    double H[9] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0}, N[45], sum = 0.0;
    const double *q1 = s->q, *q2 = q1 + 2 * s->n;
    for (int round = 0; round < 4; ++round) {
        double h[9] = {1.0, 0.1, 0.2, -0.1, 1.0, 0.1, 0.05, -0.05, 1.0};
        eg_homography_normal(s->n, H, q1, q2, s->weights, N);
        least_vector(N, round ? H : h);
        if (!round)
            memcpy(H, h, sizeof H);
    }
    eg_homography_squared(s->n, H, q1, q2, s->squares);
    for (ptrdiff_t i = 0; i < s->n; ++i)
        sum += s->weights[i] * s->squares[i];
    return sum;
}

double eg_chance(ptrdiff_t n, const double *F, const double *q, double limit, ptrdiff_t pairs,
                 ptrdiff_t rank, double *room)
{
    ptrdiff_t rounds = (pairs + n - 1) / n, total = 0, near = 0;
    rounds = rounds > n - 1 ? n - 1 : rounds;
    double e2[3], *other = room, *side = other + 2 * n, *all = side + n;
    eg_epipole(1, F, e2);
    for (ptrdiff_t k = 0; k < rounds; ++k) {
        const ptrdiff_t shift = rounds > 1 ? 1 + k * (n - 2) / (rounds - 1) : 1;
        for (int c = 0; c < 2; ++c) {
            const double *x = q + (2 + c) * n;
            memcpy(other + c * n, x + n - shift, (size_t)shift * sizeof(double));
            memcpy(other + c * n + shift, x, (size_t)(n - shift) * sizeof(double));
        }
        eg_sampson_side(n, F, e2, q, other, all + total, side);
        total += n;
    }
    for (ptrdiff_t i = 0; i < total; ++i)
        near += all[i] <= limit * limit;
    if (near >= rank || near == total)
        return (double)near / (double)total;
    rank = (rank < total ? rank : total) - 1;
    const double further = sqrt(kth(all, total, rank));
    return further > 0.0 ? (double)(rank + 1) / (double)total * fmin(limit / further, 1.0) : 1.0;
}

/* The same of matches q1, q2 (2, n); negative where memory ran out. */
EG_EXPORT double eg_chance_agreement(ptrdiff_t n, const double *F, const double *q1,
                                     const double *q2, double limit, ptrdiff_t pairs,
                                     ptrdiff_t rank)
{
    double *room = malloc((size_t)(8 * n + pairs + 1) * sizeof *room);
    if (!room)
        return -1.0;
    memcpy(room, q1, (size_t)(2 * n) * sizeof *room);
    memcpy(room + 2 * n, q2, (size_t)(2 * n) * sizeof *room);
    const double found = eg_chance(n, F, room, limit, pairs, rank, room + 4 * n);
    free(room);
    return found;
}

/* How many points of an image repeat those of earlier matches, in the image with more of them; -1
   where memory ran out. */
static ptrdiff_t repeated(const scratch_t *s, ptrdiff_t *rows)
{
    const ptrdiff_t ends[2] = {0, s->n};
    ptrdiff_t most = 0;
    for (int image = 0; image < 2; ++image) {
        const double *x = s->q + 2 * image * s->n, *y = x + s->n;
        for (ptrdiff_t i = 0; i < s->n; ++i) {
            s->room[2 * i] = x[i];
            s->room[2 * i + 1] = y[i];
        }
        const ptrdiff_t own = eg_copies(1, ends, s->room, s->room, rows);
        if (own < 0)
            return -1;
        most = own > most ? own : most;
    }
    return most;
}

static void judge(scratch_t *s, const double *result, const eg_quick_options *options,
                  double *facts)
{
    const double *motion = result + PAIR_MOTION, *F = result + PAIR_CONDITIONED;
    const ptrdiff_t n = s->n;
    double squares = 0.0, fourth = 0.0, tail = 0.0;
    EG_SUM(squares, fourth)
    for (ptrdiff_t i = 0; i < n; ++i) {
        const double square = s->weights[i] * s->d[i] * s->d[i];
        s->squares[i] = square;
        squares += square;
        fourth += square * square;
    }
    const double noise = sqrt(squares / (double)(n > 8 ? n - 7 : 1));
    memcpy(s->room, s->squares, (size_t)n * sizeof(double));
    facts[MEDIAN] = sqrt(eg_median(s->room, n));
    const double small = (double)(n > 8 ? n - 7 : 1);
    const double bound = options->tail * 1.4826 * (1.0 + 5.0 / small) * facts[MEDIAN];
    for (ptrdiff_t i = 0; i < n; ++i)
        tail += s->squares[i] > bound * bound ? s->squares[i] : 0.0;
    facts[COUNT] = (double)n;
    facts[SQUARES] = squares;
    facts[FOURTH] = fourth;
    facts[TAIL] = tail;
    facts[EXTENT] = extent(s);
    facts[LEAST] = least_determined(motion, result + PAIR_NORMAL);
    facts[UNORIENTED] = unoriented(s, motion, F, options->within * noise);
    facts[AFFINE] = affine(s);
    facts[CHANCE] = facts[ON_PLANE] = facts[NEAR] = facts[REPEATED] = facts[PLACES] = 0.0;
    facts[LITTLE] = 0.0;
    facts[PLANE] = INFINITY;
    if (noise > options->wide) {
        for (ptrdiff_t i = 0; i < n; ++i)
            facts[NEAR] += fabs(s->d[i]) <= options->within * noise;
        facts[CHANCE] = eg_chance(n, F, s->q, options->within * noise, options->pairs, options->rank,
                                  s->room);
    }
    if (noise > options->hidden)
        facts[PLANE] = plane(s);
    else
        on_plane(s, motion, F, noise, options, facts);
}

/* facts (n, FACTS) of refined pairs: x1, x2, weights and distances as for eg_refine_pairs, with its
   results; those of pairs that were left alone stay. Returns 0 where memory ran out. */
EG_EXPORT int eg_quick_facts(ptrdiff_t pairs, const ptrdiff_t *offsets, const double *x1,
                             const double *x2, const double *weights, const int *left,
                             ptrdiff_t stride, const double *distances, const double *results,
                             const eg_quick_options *options, double *facts)
{
    int done = 1;
    ptrdiff_t most = 0;
    for (ptrdiff_t k = 0; k < pairs; ++k)
        most = offsets[k + 1] - offsets[k] > most ? offsets[k + 1] - offsets[k] : most;
    const size_t room = (size_t)(22 * most + options->pairs + most + 1);
    double *memory = malloc(room * sizeof *memory);
    ptrdiff_t *rows = malloc((size_t)(most + 1) * sizeof *rows);
    if (!memory || !rows) {
        free(memory);
        free(rows);
        return 0;
    }
    scratch_t s = {0, memory, memory + 4 * most, memory + 5 * most, memory + 6 * most,
                   memory + 7 * most, memory + 8 * most, memory + 9 * most};
    for (ptrdiff_t k = 0; k < pairs; ++k) {
        const ptrdiff_t begin = offsets[k];
        const double *result = results + PAIR_DOUBLES * k;
        if (left[stride * k])
            continue;
        gather(&s, offsets[k + 1] - begin, x1 + 2 * begin, x2 + 2 * begin,
               weights ? weights + begin : NULL, distances + begin, result + PAIR_FRAME);
        judge(&s, result, options, facts + FACTS * k);
        if (options->searched || facts[FACTS * k + NEAR] > 0.0)
            facts[FACTS * k + REPEATED] = (double)repeated(&s, rows);
        done &= !(facts[FACTS * k + REPEATED] < 0.0);
    }
    free(memory);
    free(rows);
    return done;
}
