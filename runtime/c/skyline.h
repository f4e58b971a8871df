/* Symmetric matrices whose rows begin where their first entry is: the cameras' reduced system. */
#ifndef EPIGAUGE_SKYLINE_H
#define EPIGAUGE_SKYLINE_H

#include <stdint.h>

#include "epigauge_kernels.h"

/* Inlined wherever it is called: its sizes and functions are constants there. */
#if defined(_MSC_VER)
#define EG_INLINE static __forceinline
#elif defined(__GNUC__)
#define EG_INLINE static inline __attribute__((always_inline))
#else
#define EG_INLINE static inline
#endif

/* The lower triangle in blocks: block row k holds those from column first[k] to k. As a matrix, a
   block is 12x12 and a block row one panel of twelve rows; entry (r, c) of the l-th of all blocks is
   at 144 l + 12 c + r. */
typedef struct {
    ptrdiff_t n;
    const int32_t *first;
    const ptrdiff_t *slot; /* (n + 1): number of the first block of each row */
} eg_envelope;

/* Widest tangent of a camera. */
#define EG_MOST_TANGENT 32

EG_EXPORT int eg_envelope_factor(const eg_envelope *envelope, double *S);

EG_EXPORT void eg_envelope_solve(
    const eg_envelope *envelope, const double *S, ptrdiff_t count, double *x);

/* Blocks (d, d): entries from one to the next, and from row to row. */
typedef struct {
    ptrdiff_t d, size, length;
} eg_blocks;

EG_EXPORT void eg_skyline_reduce(
    const eg_envelope *views, const eg_envelope *panels, const eg_blocks *how, ptrdiff_t a,
    const double *blocks, const double *U, const double *A, double *S);

/* ---------------------------------------------------------------- selected.c */

EG_EXPORT int eg_envelope_invert(const eg_envelope *envelope, double *S);

EG_EXPORT void eg_skyline_spread(
    const eg_envelope *views, const eg_envelope *panels, const eg_blocks *how, ptrdiff_t a,
    const double *A, ptrdiff_t k, const double *K, const double *S, double *blocks);

#endif
