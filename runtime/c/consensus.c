/* The likelihood of all matches: right distances are normal, wrong ones wide or uniform.

   The reference is runtime/epigauge/two_view/consensus.py, which also says what the numbers mean. */
#include "small.h"
#include "two_view.h"

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* Matches whose factors of the likelihood are multiplied before one logarithm: each is below 1e16,
   as the ratio of the densities of right and wrong matches is with the smallest noise. */
#define CHUNK 16

#define ROOT_TWO_PI 2.5066282746310005

/* exp(x) of x <= 0, to a unit or two in the last place: reduced to |r| <= log(2) / 2, where the
   Taylor series has thirteen terms. In lanes of a vector, which the one of the C library is not. */
static inline double exponential(double x)
{
    const double magic = 0x1.8p52;
    x = x > -708.0 ? x : -708.0;
    const double n = (x * 1.4426950408889634 + magic) - magic;
    const double r = (x - n * 0x1.62e42feep-1) - n * 0x1.a39ef35793c76p-33;
    double sum = 1.0 / 6227020800.0;
    sum = sum * r + 1.0 / 479001600.0;
    sum = sum * r + 1.0 / 39916800.0;
    sum = sum * r + 1.0 / 3628800.0;
    sum = sum * r + 1.0 / 362880.0;
    sum = sum * r + 1.0 / 40320.0;
    sum = sum * r + 1.0 / 5040.0;
    sum = sum * r + 1.0 / 720.0;
    sum = sum * r + 1.0 / 120.0;
    sum = sum * r + 1.0 / 24.0;
    sum = sum * r + 1.0 / 6.0;
    sum = sum * r + 0.5;
    sum = sum * r + 1.0;
    sum = sum * r + 1.0;
    const union { double value; int64_t bits; } shifted = {n + magic};
    const union { int64_t bits; double value; } power = {(int64_t)((uint64_t)(shifted.bits + 1023)
                                                                   << 52)};
    return sum * power.value;
}

/* log(x) of x > 0; the C library's own has another version since glibc 2.29. */
static double logarithm(double x)
{
    int exponent;
    const double part = frexp(x, &exponent);
    return log1p(part - 1.0) + (double)exponent * 0.69314718055994531;
}

/* Exact distances (m) of conditioned matches q1, q2 (2, m), and the sides (m) of the epipoles: all
   of points in front of both cameras have one sign. */
static void measure(ptrdiff_t m, const double *F, const double *q1, const double *q2,
                    double *distances, double *side)
{
    const eg_options options = {.criterion = EG_REPROJECTION, .loss = EG_LINEAR};
    double q[4 * EG_BLOCK], weights[EG_BLOCK], multiplier[EG_BLOCK], squared[EG_BLOCK], e2[3];
    eg_epipole(1, F, e2);
    for (int i = 0; i < EG_BLOCK; ++i)
        weights[i] = 1.0;
    for (ptrdiff_t begin = 0; begin < m; begin += EG_BLOCK) {
        const ptrdiff_t n = m - begin < EG_BLOCK ? m - begin : EG_BLOCK;
        eg_matches block = {n, q, weights, multiplier, distances + begin};
        for (int k = 0; k < 2; ++k) {
            memcpy(q + k * n, q1 + k * m + begin, (size_t)n * sizeof(double));
            memcpy(q + (2 + k) * n, q2 + k * m + begin, (size_t)n * sizeof(double));
        }
        eg_distances(&block, &options, F);
        eg_sampson_side(n, F, e2, q, q + 2 * n, squared, side + begin);
    }
}

/* The distances that count, squared, in room (m) for those of oriented matches within the extent;
   returns how many, and in others how many count without being oriented. */
static ptrdiff_t counted(ptrdiff_t m, const double *signed_, const unsigned char *oriented,
                         const eg_mixture_options *options, double *squared,
                         ptrdiff_t *others)
{
    ptrdiff_t n = 0;
    *others = 0;
    for (ptrdiff_t i = 0; i < m; ++i) {
        if (options->extent < options->range && !(fabs(signed_[i]) <= options->extent))
            continue;
        if (oriented[i])
            squared[n++] = signed_[i] * signed_[i];
        else
            ++*others;
    }
    return n;
}

/* What is fitted: deviation and share of right matches, the logarithm of the likelihood, share and
   spread of the wrong matches near. As the fields of `Judged`. */
enum { SIGMA, SHARE, SCORE, NEAR, SPREAD, FITTED };

/* Densities of right and of near matches over that of those anywhere, at a squared distance. */
typedef struct {
    double gain, by, halo, halo_by, anywhere;
} ratios;

static ratios ratios_of(const double *fitted, double extent)
{
    const double anywhere = fmax(1.0 - fitted[SHARE] - fitted[NEAR], 1e-4) / extent;
    const double sigma = fitted[SIGMA], spread = fitted[SPREAD];
    return (ratios){fitted[SHARE] / (sigma * ROOT_TWO_PI * anywhere), -0.5 / (sigma * sigma),
                    fitted[NEAR] / (spread * ROOT_TWO_PI * anywhere), -0.5 / (spread * spread),
                    anywhere};
}

/* Fit by expectation and maximisation, from the values given; right and halo have room (n). As
   `Consensus.judge`. */
static void fit(ptrdiff_t n, ptrdiff_t others, const double *squared,
                const eg_mixture_options *options, double *right, double *halo, double *fitted)
{
    double next[FITTED];
    const double extent = options->extent, all = (double)(n + others);
    int first = 1;
    memcpy(next, fitted, sizeof next);
    if (!(next[NEAR] > 0.0))
        for (ptrdiff_t i = 0; i < n; ++i)
            halo[i] = 0.0;
    for (;;) {
        const ratios at = ratios_of(next, extent);
        double logs = 0.0, count = 0.0, squares = 0.0, around = 0.0, widths = 0.0;
        EG_SIMD
        for (ptrdiff_t i = 0; i < n; ++i)
            right[i] = at.gain * exponential(at.by * squared[i]);
        if (next[NEAR] > 0.0) {
            EG_SIMD
            for (ptrdiff_t i = 0; i < n; ++i)
                halo[i] = at.halo * exponential(at.halo_by * squared[i]);
        }
        for (ptrdiff_t begin = 0; begin < n; begin += CHUNK) {
            const ptrdiff_t end = n - begin < CHUNK ? n : begin + CHUNK;
            double product = 1.0;
            for (ptrdiff_t i = begin; i < end; ++i)
                product *= 1.0 + right[i] + halo[i];
            logs += logarithm(product);
        }
        next[SCORE] = all * logarithm(at.anywhere) + logs - 7.0 * logarithm(extent / next[SIGMA]);
        if (!first && !(next[SCORE] > fitted[SCORE] + options->climbed))
            return;
        first = 0;
        memcpy(fitted, next, sizeof next);
        EG_SUM(count, squares, around, widths)
        for (ptrdiff_t i = 0; i < n; ++i) {
            const double by = 1.0 / (1.0 + right[i] + halo[i]);
            const double p = right[i] * by, near = halo[i] * by;
            count += p;
            squares += p * squared[i];
            around += near;
            widths += near * squared[i];
        }
        next[SHARE] = fmin(fmax(count / fmax(all, 1.0), options->least), options->most);
        next[SIGMA] = fmin(fmax(sqrt(squares / fmax(count - 7.0, 1.0)), options->floor),
                           options->widest);
        if (next[NEAR] > 0.0) {
            next[NEAR] = fmin(around / fmax(all, 1.0), options->most - next[SHARE]);
            next[SPREAD] = fmax(sqrt(widths / fmax(around, 1e-300)),
                                options->halo * next[SIGMA]);
        }
    }
}

/* Distances and sides, and the fit where there is one; room has 3 m doubles. */
static void judge(ptrdiff_t m, const double *q1, const double *q2,
                  const eg_mixture_options *options, const double *F, double *fitted,
                  double *distances, unsigned char *oriented, double *room)
{
    double votes = 0.0;
    ptrdiff_t others;
    measure(m, F, q1, q2, distances, room);
    for (ptrdiff_t i = 0; i < m; ++i)
        votes += room[i] > 0.0 ? 1.0 : room[i] < 0.0 ? -1.0 : 0.0;
    for (ptrdiff_t i = 0; i < m; ++i)
        oriented[i] = (votes >= 0.0 ? room[i] > 0.0 : room[i] < 0.0) &&
                      fabs(distances[i]) < 1.0 / options->floor;
    if (fitted) {
        const ptrdiff_t n = counted(m, distances, oriented, options, room, &others);
        fit(n, others, room, options, room + m, room + 2 * m, fitted);
    }
}

/* Signed distances (m) of matches q1, q2 (2, m) to F, which of them are oriented, and where asked
   for what is fitted (5), from the values given but the score. Returns 0 where memory ran out. */
EG_EXPORT int eg_judge(ptrdiff_t m, const double *F, const double *q1, const double *q2,
                       const eg_mixture_options *options, double *fitted, double *distances,
                       unsigned char *oriented)
{
    double *room = malloc((size_t)(3 * m + 1) * sizeof *room);
    if (!room)
        return 0;
    judge(m, q1, q2, options, F, fitted, distances, oriented, room);
    free(room);
    return 1;
}

/* As `losses.robust_scale`, of distances without signs, which are reordered. */
static double robust_scale(double *sizes, ptrdiff_t n)
{
    return 1.4826 * (1.0 + 5.0 / (double)(n > 8 ? n - 7 : 1)) * eg_median(sizes, n);
}

/* Matches q1, q2 (2, m) in blocks: all of them, or those chosen, with their weights. */
static void gather(eg_matches *matches, ptrdiff_t m, const double *q1, const double *q2,
                   const double *weights, const unsigned char *chosen)
{
    ptrdiff_t n = 0;
    for (ptrdiff_t i = 0; i < m; ++i) {
        if (chosen && !chosen[i])
            continue;
        const ptrdiff_t begin = n - n % EG_BLOCK, size = eg_block_size(matches, begin);
        double *q = eg_block_points(matches, begin) + n % EG_BLOCK;
        q[0] = q1[i];
        q[size] = q1[m + i];
        q[2 * size] = q2[i];
        q[3 * size] = q2[m + i];
        matches->weights[n++] = weights ? weights[i] : 1.0;
    }
}

/* F by least squares of weighted matches, near another; 0 where that has rank one. */
static int least_squares(eg_matches *matches, const eg_mixture_options *options,
                         const double *from, double *F)
{
    static const eg_chart chart = {7, NULL, NULL};
    const eg_options how = {EG_REPROJECTION, EG_BLOCKS, EG_LINEAR, 1, 0, options->steps, 1.0,
                            options->ftol, 1e-12, 1e-14, 0.0, 0.0};
    double motion[EG_MOTION] = {0.0}, sigma;
    eg_outcome outcome;
    if (!eg_factorize(from, motion, motion + 9, &sigma))
        return 0;
    motion[18] = 1.0 / sqrt(1.0 + sigma * sigma);
    motion[21] = sigma * motion[18];
    eg_minimize(matches, &how, &chart, motion, NULL, &outcome);
    memcpy(F, outcome.F, 9 * sizeof(double));
    return 1;
}

/* F by least squares, each match weighing as it is probably right; 0 where it has rank one. */
static int refitted(eg_matches *matches, const eg_mixture_options *options, const double *fitted,
                    const double *distances, const unsigned char *oriented, const double *from,
                    double *F)
{
    const ratios at = ratios_of(fitted, options->extent);
    for (ptrdiff_t i = 0; i < matches->m; ++i) {
        const double squared = distances[i] * distances[i];
        const double p = oriented[i] ? at.gain * exponential(at.by * squared) : 0.0;
        const double near = at.halo > 0.0 ? at.halo * exponential(at.halo_by * squared) : 0.0;
        matches->weights[i] = p / (1.0 + p + near);
    }
    return least_squares(matches, options, from, F);
}

/* Fit F to the matches within a limit until these stand still, as `Consensus.settle`: F, limit,
   distances and sides are updated, the weights (m) are those of the matches. The limit falls to so
   many deviations of the noise, unless that is 0. Returns how many fits that took; -1 where memory
   ran out. */
EG_EXPORT int eg_settle(ptrdiff_t m, const double *q1, const double *q2, const double *weights,
                        const eg_mixture_options *options, double deviations, ptrdiff_t least,
                        int most, double *F, double *limit, double *distances,
                        unsigned char *oriented)
{
    double *room = malloc((size_t)(8 * m + 1) * sizeof *room);
    unsigned char *inlier = calloc((size_t)m + 1, 1);
    int fits = room && inlier ? 0 : -1;
    while (fits >= 0 && fits < most) {
        eg_matches matches = {0, room, room + 4 * m, room + 5 * m, room + 6 * m};
        double *sizes = room + 7 * m, trial[9];
        ptrdiff_t n = 0;
        int stands = 1;
        for (ptrdiff_t i = 0; i < m; ++i) {
            const unsigned char within = weights[i] > 0.0 && oriented[i] &&
                                         fabs(distances[i]) <= *limit;
            stands &= within == inlier[i];
            inlier[i] = within;
            matches.m += within;
        }
        if (stands || matches.m < least)
            break;
        gather(&matches, m, q1, q2, weights, inlier);
        if (!least_squares(&matches, options, F, trial))
            break;
        ++fits;
        memcpy(F, trial, sizeof trial);
        judge(m, q1, q2, options, F, NULL, distances, oriented, sizes);
        for (ptrdiff_t i = 0; i < m; ++i)
            if (inlier[i])
                sizes[n++] = fabs(distances[i]);
        if (deviations > 0.0)
            *limit = fmin(*limit, fmax(deviations * robust_scale(sizes, n), 1e-9));
    }
    free(room);
    free(inlier);
    return fits;
}

/* Maximise the likelihood over F, deviation and share in turns, as `Consensus.climb`, from what
   eg_judge gave: all of it is updated. Returns 0 where memory ran out. */
EG_EXPORT int eg_climb(ptrdiff_t m, const double *q1, const double *q2,
                       const eg_mixture_options *options, double *F, double *fitted,
                       double *distances, unsigned char *oriented)
{
    double *room = malloc((size_t)(11 * m + 1) * sizeof *room);
    unsigned char *sides = malloc((size_t)m + 1);
    if (room && sides) {
        eg_matches matches = {m, room, room + 4 * m, room + 5 * m, room + 6 * m};
        double *other = room + 7 * m, trial[9], own[FITTED];
        gather(&matches, m, q1, q2, NULL, NULL);
        for (int turn = 0; turn < options->climbs; ++turn) {
            if (!refitted(&matches, options, fitted, distances, oriented, F, trial))
                break;
            memcpy(own, fitted, sizeof own);
            judge(m, q1, q2, options, trial, own, other, sides, room + 8 * m);
            if (!(own[SCORE] > fitted[SCORE] + options->climbed))
                break;
            memcpy(F, trial, sizeof trial);
            memcpy(fitted, own, sizeof own);
            memcpy(distances, other, (size_t)m * sizeof *other);
            memcpy(oriented, sides, (size_t)m);
        }
    }
    const int done = room && sides;
    free(room);
    free(sides);
    return done;
}
