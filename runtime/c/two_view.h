/* Two views, structure eliminated: what `epigauge.two_view` does in Python, for one pair or many.

   The readable reference is Python: criteria.py, eliminated.py, lm.py. A test compares both,
   evaluation by evaluation. */
#ifndef EPIGAUGE_TWO_VIEW_H
#define EPIGAUGE_TWO_VIEW_H

#include <stdint.h>

#include "losses.h"

/* Matches are kept and worked on in blocks, so that all between two passes stays in the cache. */
#define EG_BLOCK 256

/* Before a loop that adds up: in the lanes of a vector, hence not one by one. */
#if defined(_MSC_VER)
#define EG_SUM(...)
#else
#define EG_PRAGMA(text) _Pragma(#text)
#define EG_SUM(...) EG_PRAGMA(omp simd reduction(+ : __VA_ARGS__))
#endif

/* Numbers of the choices, as native.py has them. */
enum { EG_REPROJECTION, EG_SAMPSON, EG_EPIPOLAR };
enum { EG_ORTHO, EG_BLOCKS, EG_ESSENTIAL };

typedef struct {
    int criterion, chart, loss;
    int exact;  /* exact Hessian, or that of Gauss-Newton */
    int scaled; /* damping lambda diag(J^T J), or lambda I */
    int max_iter;
    double loss_scale2, ftol, xtol, gtol;
    double rms, offset; /* conditioning, for pairs in pixels */
} eg_options;

/* Matches in conditioned coordinates: block b holds x, y of both images one after the other. */
typedef struct {
    ptrdiff_t m;
    double *q;          /* 4 m: for each block x1, y1, x2, y2 */
    double *weights;    /* m */
    double *multiplier; /* m */
    double *d;          /* m: signed distances */
} eg_matches;

/* The points of the block that begins at a match, and how many matches it has. */
static inline double *eg_block_points(const eg_matches *matches, ptrdiff_t begin)
{
    return matches->q + 4 * begin;
}

static inline ptrdiff_t eg_block_size(const eg_matches *matches, ptrdiff_t begin)
{
    return matches->m - begin < EG_BLOCK ? matches->m - begin : EG_BLOCK;
}

/* A representation of F: U, V and sigma, or U, V and a 2x2 matrix. */
#define EG_MOTION 22

/* The representation in force: some of its directions, and F in other coordinates. */
typedef struct {
    int p;                 /* directions */
    const double *basis;   /* (7, p), (5, p) of an essential matrix, or NULL for all of them */
    const double *entries; /* (9, 9) from vect(F) to vect(F) as computed with, or NULL */
} eg_chart;

typedef struct {
    int nfev, njev, nit, status;
    int current; /* whether the distances left behind are those of F */
    double cost;
    double gradient[7], hessian[49], diagonal[7];
    double bend[343]; /* J^T r'' of the exact Hessian: linear.py */
    double normal[81]; /* J^T J by vect(F) */
    double F[9];
} eg_outcome;

/* Signed distances into matches->d (and multipliers); returns half the weighted robust sum. */
double eg_distances(eg_matches *matches, const eg_options *options, const double *F);

/* Gradient (9), J^T J (9, 9) and Hessian (9, 9) by vect(F), at the distances last computed. */
void eg_normal(eg_matches *matches, const eg_options *options, const double *F, double *g,
               double *N, double *H);

/* Minimise from a motion, which is updated; history has max_iter + 1 rows, or is NULL. */
void eg_minimize(eg_matches *matches, const eg_options *options, const eg_chart *chart,
                 double *motion, double *history, eg_outcome *outcome);

/* Repeated matches: copies.c. */
EG_EXPORT ptrdiff_t eg_copies(ptrdiff_t pairs, const ptrdiff_t *offsets, const double *x1,
                              const double *x2, ptrdiff_t *first);

/* Points on one line: collinear.c. */
EG_EXPORT void eg_may_be_lines(ptrdiff_t pairs, const ptrdiff_t *offsets, const double *x1,
                               const double *x2, const double *weights, const double *bound,
                               double share, unsigned char *may);

/* The numbers of the rules, as in the structure of quick.py. */
typedef struct {
    double within;           /* standard deviations that count as within the noise */
    double wide, hidden;     /* noise beyond which agreement, and a plane, are looked at closely */
    double tail;             /* robust deviations beyond which a match is in the tail */
    double reach, far;       /* standard deviations off a plane through three matches, or more */
    ptrdiff_t samples, pool; /* threes of matches, and how many they are judged by */
    ptrdiff_t grows;         /* fits to those that are on the best plane, as it grows */
    ptrdiff_t pairs, rank;   /* wrong pairs, and how many must be near */
    double beside;           /* what is in one place */
    double little;           /* distance off a plane that is no relief */
    ptrdiff_t searched;      /* whether F itself chose these among raw matches */
} eg_quick_options;

/* The median of some values, which are reordered. */
double eg_median(double *values, ptrdiff_t n);

/* How to search among raw matches, as in the structure of search.py. */
typedef struct {
    uint64_t seed;
    ptrdiff_t samples, least;      /* of seven matches, at most and at least */
    int planes, pairs;             /* threes that give a plane, and twos off it */
    int steps, widths;             /* of the local optimisation */
    double scale, floor2;          /* of distances, and a part of its square that is rounding */
    double patience, width[4];     /* more samples than one is good; widths in scales */
    double dominant;               /* share of those that agree, on a plane that is looked into */
} eg_search_options;

/* The mixture of right and wrong matches, as in the structure of native.py. */
typedef struct {
    double extent, range;         /* distances that count, all where it is the range of them */
    double widest, floor;         /* of the deviation */
    double least, most;           /* of the share */
    double halo;                  /* least spread of wrong matches near, over the deviation */
    double climbed, ftol;         /* gain of the likelihood, and of the cost of a fit, that ends */
    int climbs, steps;            /* at most, and of a fit */
} eg_mixture_options;

/* How to look for a plane, as in the structure of homography.py. */
typedef struct {
    double equal[9];              /* the homography by which all equations are weighed alike */
    double stands, sharp, wide;   /* change that ends; medians at which weights fall, at first, then */
    double rounding2;             /* least square */
    int rounds;
} eg_plane_options;

/* The probability that a wrong match is within a distance of F, from so many pairs of the points of
   matches q (4, n) of which so many must be near; room has 4 n + pairs doubles. */
double eg_chance(ptrdiff_t n, const double *F, const double *q, double limit, ptrdiff_t pairs,
                 ptrdiff_t rank, double *room);

#endif
