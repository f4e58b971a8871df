/* The epipolar geometry that raw matches agree on, from samples of seven.

   The reference is runtime/epigauge/two_view/search.py, which also says what the numbers mean. */
#include "small.h"
#include "two_view.h"

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define BATCH 64

/* Matches whose factors of the score are multiplied before one logarithm: no overflow. */
#define CHUNK 128

/* Matches that judge all proposals of a batch, and how many of these are judged by all matches. */
#define JUDGES 192
#define FINALISTS 6

/* The share of the matches that agree, off a plane by so many deviations, up to which F is
   degenerate; how many deviations blunt the matches on it then judge; what is rounding for others. */
#define DEGENERATE 0.1
#define OFF 5.0
#define BLUNT 3.0
#define LUCK 0.5

typedef struct {
    ptrdiff_t m;
    const double *q, *q1, *q2; /* (4, m) conditioned, and its halves */
    double some[4 * JUDGES];   /* (4, judges) */
    ptrdiff_t judges;
    const eg_search_options *options;
    double scale2, floor2;
    ptrdiff_t *rows;       /* m */
    double *work;          /* 3 m */
    eg_matches near;
    uint64_t drawn;
    double F[9], score;    /* the best geometry so far */
    double *split;         /* 4 m: (4, off) and (4, m - off), off a plane and on it */
    ptrdiff_t off;
    double noise2;         /* where F is degenerate for the plane; else 0 */
} search_t;

/* A whole number below n: SplitMix64 (Steele, Lea, Flood 2014) of a counter. */
static ptrdiff_t draw(search_t *s, ptrdiff_t n)
{
    uint64_t z = s->options->seed + ++s->drawn * UINT64_C(0x9E3779B97F4A7C15);
    z = (z ^ (z >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
    z = (z ^ (z >> 27)) * UINT64_C(0x94D049BB133111EB);
    z ^= z >> 31;
    return (ptrdiff_t)((double)(z >> 11) * 0x1p-53 * (double)n);
}

/* Sum of log(1 + scale^2 / (d^2 + floor^2)) over the matches q (4, m); factors is room for m. */
static double agreement(double scale2, double floor2, ptrdiff_t m, const double *q,
                        const double *F, double *factors)
{
    double sum = 0.0;
    eg_agreement(m, F, &scale2, &floor2, q, q + 2 * m, factors);
    for (ptrdiff_t begin = 0; begin < m; begin += CHUNK) {
        const ptrdiff_t end = m - begin < CHUNK ? m : begin + CHUNK;
        double product = 1.0;
#ifndef _MSC_VER
#pragma omp simd reduction(* : product)
#endif
        for (ptrdiff_t i = begin; i < end; ++i)
            product *= factors[i];
        sum += log1p(product - 1.0);
    }
    return sum;
}

/* By all matches; by those on a plane that F is degenerate for, bluntly. */
static double score(const search_t *s, const double *F)
{
    const double wide2 = BLUNT * BLUNT * s->noise2;
    const double luck2 = fmax(LUCK * LUCK * s->noise2, s->floor2);
    if (!(s->noise2 > 0.0))
        return agreement(s->scale2, s->floor2, s->m, s->q, F, s->work);
    return agreement(s->scale2, luck2, s->off, s->split, F, s->work) +
           agreement(wide2, wide2, s->m - s->off, s->split + 4 * s->off, F, s->work);
}

/* Squared distances to first order; infinity for matches on the wrong side of an epipole. */
static void distances(const search_t *s, const double *F, double *squared)
{
    double e2[3], votes = 0.0, *side = s->work + s->m;
    eg_epipole(1, F, e2);
    eg_sampson_side(s->m, F, e2, s->q1, s->q2, squared, side);
    EG_SUM(votes)
    for (ptrdiff_t i = 0; i < s->m; ++i)
        votes += side[i] > 0.0 ? 1.0 : -1.0;
    for (ptrdiff_t i = 0; i < s->m; ++i)
        if (!((side[i] > 0.0) == (votes >= 0.0)))
            squared[i] = INFINITY;
}

/* The matches within a distance, into s->near and s->rows; returns how many. */
static ptrdiff_t gather(search_t *s, const double *F, double limit)
{
    double *squared = s->work;
    ptrdiff_t n = 0;
    distances(s, F, squared);
    for (ptrdiff_t i = 0; i < s->m; ++i)
        if (squared[i] <= limit * limit)
            s->rows[n++] = i;
    s->near.m = n;
    for (ptrdiff_t begin = 0; begin < n; begin += EG_BLOCK) {
        const ptrdiff_t size = eg_block_size(&s->near, begin);
        double *q = eg_block_points(&s->near, begin);
        for (ptrdiff_t i = 0; i < size; ++i) {
            const ptrdiff_t row = s->rows[begin + i];
            q[i] = s->q1[row];
            q[size + i] = s->q1[s->m + row];
            q[2 * size + i] = s->q2[row];
            q[3 * size + i] = s->q2[s->m + row];
            s->near.weights[begin + i] = 1.0;
        }
    }
    return n;
}

/* Keep a geometry if it is the best so far. */
static void keep(search_t *s, const double *F)
{
    const double own = score(s, F);
    if (own > s->score) {
        s->score = own;
        memcpy(s->F, F, 9 * sizeof(double));
    }
}

/* Local optimisation: a robust fit to the matches around, wide first and then narrow. */
static void improve(search_t *s, const double *start)
{
    static const eg_chart chart = {7, NULL, NULL};
    const eg_search_options *options = s->options;
    eg_options how = {EG_SAMPSON, EG_ORTHO, EG_TRUNCATED, 0, 0, options->steps, 0.0,
                      1e-4, 1e-8, 0.0, 0.0, 0.0};
    double F[9], motion[EG_MOTION];
    eg_outcome outcome;
    memcpy(F, start, sizeof F);
    for (int k = 0; k < options->widths; ++k) {
        const double width = options->scale * options->width[k];
        if (gather(s, F, 3.0 * width) < 8 || !eg_factorize(F, motion, motion + 9, motion + 18))
            return;
        how.loss_scale2 = width * width;
        eg_minimize(&s->near, &how, &chart, motion, NULL, &outcome);
        if (!isfinite(outcome.cost))
            return;
        memcpy(F, outcome.F, sizeof F);
        keep(s, F);
    }
}

/* Unit norm; 0 where there is no matrix. */
static int normalized(double *F)
{
    double norm2 = 0.0;
    for (int k = 0; k < 9; ++k)
        norm2 += F[k] * F[k];
    if (!(norm2 > 0.0 && norm2 < INFINITY))
        return 0;
    norm2 = 1.0 / sqrt(norm2);
    for (int k = 0; k < 9; ++k)
        F[k] *= norm2;
    return 1;
}

/* Samples that find the best geometry so far with the confidence asked for. */
static double needed(search_t *s)
{
    const eg_search_options *options = s->options;
    const double limit = 3.0 * options->scale;
    double near = 0.0;
    distances(s, s->F, s->work);
    for (ptrdiff_t i = 0; i < s->m; ++i)
        near += s->work[i] <= limit * limit ? 1.0 : 0.0;
    const double ratio = (double)s->m / fmax(near, 7.0), cube = ratio * ratio * ratio;
    return options->patience * cube * cube * ratio;
}

/* Improve the best proposal of a batch, where none before scored as high. Some of the matches judge
   more proposals than finalists, all matches the finalists that do best. */
static int improved(search_t *s, ptrdiff_t n, ptrdiff_t finalists, const double *proposals,
                    double *highest)
{
    double first[3 * BATCH];
    const double *best = NULL;
    for (ptrdiff_t k = 0; k < n; ++k)
        first[k] = n <= finalists ? 0.0
                                  : agreement(s->scale2, s->floor2, s->judges, s->some,
                                              proposals + 9 * k, s->work);
    for (ptrdiff_t trial = 0; trial < finalists && trial < n; ++trial) {
        ptrdiff_t next = 0;
        for (ptrdiff_t k = 1; k < n; ++k)
            if (first[k] > first[next])
                next = k;
        first[next] = -1.0;
        const double value = score(s, proposals + 9 * next);
        if (value > *highest) {
            *highest = value;
            best = proposals + 9 * next;
        }
    }
    if (best)
        improve(s, best);
    return best != NULL;
}

static void seven_points(search_t *s, const ptrdiff_t *order, ptrdiff_t *samples)
{
    static const double shares[] = {1.0, 0.5, 0.25, 0.125};
    const ptrdiff_t m = s->m;
    double q1[14 * BATCH], q2[14 * BATCH], F[27 * BATCH], votes[3 * BATCH], discriminant[BATCH];
    double proposals[27 * BATCH], most = (double)s->options->samples, highest = 0.0;
    ptrdiff_t done = 0;
    while ((double)done < most) {
        for (int i = 0; i < BATCH; ++i) {
            const double share = order ? shares[i % 4] : 1.0;
            const ptrdiff_t pool = (ptrdiff_t)fmax(fmin(14.0, (double)m), share * (double)m);
            for (int j = 0; j < 7; ++j) {
                const ptrdiff_t drawn = draw(s, pool), row = order ? order[drawn] : drawn;
                q1[BATCH * j + i] = s->q1[row];
                q1[BATCH * (7 + j) + i] = s->q1[m + row];
                q2[BATCH * j + i] = s->q2[row];
                q2[BATCH * (7 + j) + i] = s->q2[m + row];
            }
        }
        eg_seven_points(BATCH, q1, q2, F, votes, discriminant);
        done += BATCH;
        ptrdiff_t n = 0;
        for (int i = 0; i < BATCH; ++i)
            for (int k = 0; k < 3; ++k) {
                if (fabs(votes[BATCH * k + i]) != 7.0 || (k && !(discriminant[i] > 0.0)))
                    continue;
                for (int j = 0; j < 9; ++j)
                    proposals[9 * n + j] = F[BATCH * (9 * k + j) + i];
                n += normalized(proposals + 9 * n);
            }
        if (improved(s, n, FINALISTS, proposals, &highest))
            most = fmin(fmax(needed(s), (double)s->options->least), (double)s->options->samples);
    }
    *samples = done;
}

static void cross(const double *a, const double *b, double *c)
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

/* A plane by least squares of those near it: three matches fix it less well. */
static void refit(ptrdiff_t n, const double *x, const double *y, const double *kappa,
                  const double *gain, double limit, double *v)
{
    double A[9] = {0.0}, b[3] = {0.0}, rows[9], determinant = 0.0, refined[3];
    for (ptrdiff_t i = 0; i < n; ++i) {
        const double a[3] = {gain[i] * x[i], gain[i] * y[i], gain[i]};
        if (!(fabs(gain[i] * (kappa[i] - v[0] * x[i] - v[1] * y[i] - v[2])) < limit))
            continue;
        for (int k = 0; k < 3; ++k) {
            b[k] += a[k] * gain[i] * kappa[i];
            for (int j = 0; j < 3; ++j)
                A[3 * k + j] += a[k] * a[j];
        }
    }
    for (int k = 0; k < 3; ++k)
        cross(A + 3 * ((k + 1) % 3), A + 3 * ((k + 2) % 3), rows + 3 * k);
    for (int k = 0; k < 3; ++k)
        determinant += A[k] * rows[k];
    for (int k = 0; k < 3; ++k)
        refined[k] = (rows[k] * b[0] + rows[3 + k] * b[1] + rows[6 + k] * b[2]) / determinant;
    if (determinant > 1e-12 * A[0] * A[4] * A[8])
        memcpy(v, refined, sizeof refined);
}

/* The plane of most matches that agree: kappa = v^T q by plane and parallax, H = [e']x F + e' v^T.
   Returns how many are near. */
static ptrdiff_t plane(search_t *s, double *H)
{
    const double limit = 3.0 * s->options->scale * sqrt(2.0);
    const ptrdiff_t n = gather(s, s->F, 3.0 * s->options->scale);
    double e2[3] = {0.0}, norm = 0.0, best[3] = {0.0};
    double *kappa = s->work, *gain = kappa + s->m, *x = s->near.multiplier, *y = s->near.d;
    ptrdiff_t most = 0;
    if (n < 7)
        return 0;
    eg_epipole(1, s->F, e2);
    for (int k = 0; k < 3; ++k)
        norm += e2[k] * e2[k];
    for (int k = 0; k < 3; ++k)
        e2[k] /= sqrt(norm);
    for (ptrdiff_t begin = 0; begin < n; begin += EG_BLOCK) {
        const ptrdiff_t size = eg_block_size(&s->near, begin);
        const double *q = eg_block_points(&s->near, begin);
        eg_plane_parallax(size, s->F, e2, q, q + 2 * size, kappa + begin, gain + begin);
        memcpy(x + begin, q, (size_t)size * sizeof *x);
        memcpy(y + begin, q + size, (size_t)size * sizeof *y);
    }
    for (int trial = 0; trial < s->options->planes; ++trial) {
        const ptrdiff_t a = draw(s, n), b = draw(s, n), c = draw(s, n);
        const double bx = x[b] - x[a], by = y[b] - y[a], cx = x[c] - x[a], cy = y[c] - y[a];
        const double bk = kappa[b] - kappa[a], ck = kappa[c] - kappa[a], area = bx * cy - by * cx;
        const double v0 = (bk * cy - ck * by) / area, v1 = (bx * ck - cx * bk) / area;
        const double v2 = kappa[a] - v0 * x[a] - v1 * y[a];
        if (!isfinite(v0) || !isfinite(v1) || !isfinite(v2))
            continue;
        double count = 0.0;
        EG_SUM(count)
        for (ptrdiff_t i = 0; i < n; ++i)
            count += fabs(gain[i] * (kappa[i] - v0 * x[i] - v1 * y[i] - v2)) < limit ? 1.0 : 0.0;
        if ((ptrdiff_t)count > most) {
            most = (ptrdiff_t)count;
            best[0] = v0, best[1] = v1, best[2] = v2;
        }
    }
    refit(n, x, y, kappa, gain, limit, best);
    for (int k = 0; k < 3; ++k) {
        const double *F = s->F + k;
        H[k] = e2[1] * F[6] - e2[2] * F[3] + e2[0] * best[k];
        H[3 + k] = e2[2] * F[0] - e2[0] * F[6] + e2[1] * best[k];
        H[6 + k] = e2[0] * F[3] - e2[1] * F[0] + e2[2] * best[k];
    }
    return most;
}

/* The line through both points that a match moves between, off the plane of H. */
static void moves_along(const search_t *s, const double *H, ptrdiff_t row, double *line)
{
    const double x = s->q1[row], y = s->q1[s->m + row];
    const double q2[3] = {s->q2[row], s->q2[s->m + row], 1.0};
    const double there[3] = {H[0] * x + H[1] * y + H[2], H[3] * x + H[4] * y + H[5],
                             H[6] * x + H[7] * y + H[8]};
    cross(there, q2, line);
}

/* If F, so far from a homography by which matches are off by their squares, is degenerate for it:
   split the matches into those off it and those on it, and judge F again. */
static void split(search_t *s, const double *squared)
{
    const double near2 = 9.0 * s->scale2;
    double *distances2 = s->work, *sorted = distances2 + s->m, *parts = s->split;
    ptrdiff_t near = 0, agree = 0, on = 0;
    distances(s, s->F, distances2);
    for (ptrdiff_t i = 0; i < s->m; ++i)
        if (distances2[i] <= near2)
            sorted[near++] = distances2[i];
    const double noise2 = fmax(1.4826 * 1.4826 * eg_median(sorted, near), s->floor2);
    const double limit2 = OFF * OFF * noise2;
    s->off = 0;
    for (ptrdiff_t i = 0; i < s->m; ++i)
        if (!(squared[i] <= limit2)) {
            agree += distances2[i] <= near2;
            s->rows[s->off++] = i;
        }
    if ((double)agree > DEGENERATE * (double)near)
        return;
    for (ptrdiff_t i = 0; i < s->m; ++i)
        if (squared[i] <= limit2)
            s->rows[s->off + on++] = i;
    for (int c = 0; c < 4; ++c) {
        for (ptrdiff_t k = 0; k < s->off; ++k)
            parts[c * s->off + k] = s->q[c * s->m + s->rows[k]];
        for (ptrdiff_t k = 0; k < on; ++k)
            parts[4 * s->off + c * on + k] = s->q[c * s->m + s->rows[s->off + k]];
    }
    s->noise2 = noise2;
    s->score = score(s, s->F);
}

/* F = [e']x H of a plane's homography and two matches off it (DEGENSAC: Chum, Werner, Matas 2005). */
static void plane_and_parallax(search_t *s)
{
    double H[9], highest = 0.0, *squared = s->work + 2 * s->m;
    const double off = 9.0 * s->options->scale;
    ptrdiff_t n = 0;
    const ptrdiff_t on = plane(s, H);
    if (on < 7 || (double)on < s->options->dominant * (double)s->near.m)
        return;
    eg_homography_squared(s->m, H, s->q1, s->q2, squared);
    ptrdiff_t *rows = malloc((size_t)s->m * sizeof *rows);
    if (!rows)
        return;
    for (ptrdiff_t i = 0; i < s->m; ++i)
        if (squared[i] > off * off)
            rows[n++] = i;
    if (n >= 2)
        split(s, squared);
    for (int begin = 0; n >= 2 && begin < s->options->pairs; begin += BATCH) {
        double proposals[9 * BATCH];
        ptrdiff_t count = 0;
        for (int trial = 0; trial < BATCH; ++trial) {
            double one[3], two[3], e2[3], *F = proposals + 9 * count;
            moves_along(s, H, rows[draw(s, n)], one);
            moves_along(s, H, rows[draw(s, n)], two);
            cross(one, two, e2);
            for (int k = 0; k < 3; ++k) {
                const double column[3] = {H[k], H[3 + k], H[6 + k]};
                double moved[3];
                cross(e2, column, moved);
                F[k] = moved[0], F[3 + k] = moved[1], F[6 + k] = moved[2];
            }
            count += normalized(F);
        }
        /* Matches on the plane, as most of the few judges are, say nothing. */
        improved(s, count, count, proposals, &highest);
    }
    free(rows);
    s->noise2 = 0.0;
    s->score = score(s, s->F);
}

/* Spread over the better half of the matches. */
static void choose_judges(search_t *s, const ptrdiff_t *order)
{
    const ptrdiff_t pool = order ? (s->m + 1) / 2 : s->m;
    s->judges = pool < JUDGES ? pool : JUDGES;
    for (ptrdiff_t k = 0; k < s->judges; ++k) {
        const ptrdiff_t place = k * pool / s->judges, row = order ? order[place] : place;
        for (int c = 0; c < 4; ++c)
            s->some[c * s->judges + k] = s->q[c * s->m + row];
    }
}

/* Search among conditioned matches q (4, m), x, y of both images. Order, best first, may be NULL. Returns how many
   samples of seven were drawn; -1 where memory ran out. */
EG_EXPORT ptrdiff_t eg_search(ptrdiff_t m, const double *q, const ptrdiff_t *order,
                              const eg_search_options *options, double *F, double *value)
{
    double *room = malloc((size_t)(14 * m + 1) * sizeof *room);
    ptrdiff_t *rows = malloc((size_t)(m + 1) * sizeof *rows), samples = -1;
    if (room && rows) {
        search_t s = {.m = m, .q = q, .q1 = q, .q2 = q + 2 * m, .options = options, .rows = rows,
                      .work = room, .split = room + 10 * m};
        choose_judges(&s, order);
        s.scale2 = options->scale * options->scale;
        s.floor2 = s.scale2 * options->floor2;
        s.near = (eg_matches){0, room + 3 * m, room + 7 * m, room + 8 * m, room + 9 * m};
        seven_points(&s, order, &samples);
        if (s.score > 0.0)
            plane_and_parallax(&s);
        memcpy(F, s.F, sizeof s.F);
        *value = s.score;
    }
    free(room);
    free(rows);
    return samples;
}
