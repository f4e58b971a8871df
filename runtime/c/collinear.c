/* Whether most points of an image may be on one line: runtime/epigauge/two_view/collinear.py. */
#include "two_view.h"

/* How many threes of points next to one another in the list are on a line: the one in the middle by
   `bound`, over the root of the weight of the first where there are weights, which none is without.
   Three points, not two of them and one again. */
static ptrdiff_t threes(ptrdiff_t m, const double *x, const double *weights, double bound)
{
    ptrdiff_t on = 0;
    for (ptrdiff_t i = 0; i + 2 < m; ++i) {
        const double *p = x + 2 * i;
        const double ax = p[2] - p[0], ay = p[3] - p[1], bx = p[4] - p[0], by = p[5] - p[1];
        const double a = ax * ax + ay * ay, b = bx * bx + by * by, area = ay * bx - ax * by;
        const double weight = weights ? weights[i] : 1.0;
        /* Products of squares: no roots, and none where a point or a weight is nothing. */
        const double wide = bound * bound * (a > b ? a : b);
        const int distinct = a != 0.0 && b != 0.0 && (ax != bx || ay != by);
        on += distinct && weight > 0.0 && area * area * weight <= wide;
    }
    return on;
}

/* may[k] <- whether of either image of pair k more than `share` of the threes are on lines, within
   bound[k] pixels. */
EG_EXPORT void eg_may_be_lines(ptrdiff_t pairs, const ptrdiff_t *offsets, const double *x1,
                               const double *x2, const double *weights, const double *bound,
                               double share, unsigned char *may)
{
    for (ptrdiff_t k = 0; k < pairs; ++k) {
        const ptrdiff_t begin = offsets[k], m = offsets[k + 1] - begin;
        const double *own = weights ? weights + begin : weights;
        const double many = share * (double)(m > 2 ? m - 2 : 0);
        may[k] = (double)threes(m, x1 + 2 * begin, own, bound[k]) > many ||
                 (double)threes(m, x2 + 2 * begin, own, bound[k]) > many;
    }
}
