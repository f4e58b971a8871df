/* Whether matches move as those around them do: runtime/epigauge/two_view/neighbours.py. */
#include "small.h"
#include "two_view.h"

#include <math.h>
#include <stdlib.h>

/* Of the neighbours of each match q (4, m) in either image and one more, the share that are so in
   both, the one more by `alone`. Near is within `reach` in each coordinate, in single precision.
   Returns 0 where memory ran out. */
EG_EXPORT int eg_neighbours(ptrdiff_t m, const double *q, double reach, double alone, double *share)
{
    const float limit = (float)reach;
    float *x1 = malloc((size_t)(4 * m + 1) * sizeof *x1), *y1 = x1 + m, *x2 = y1 + m, *y2 = x2 + m;
    if (!x1)
        return 0;
    for (ptrdiff_t i = 0; i < 4 * m; ++i)
        x1[i] = (float)q[i];
    for (ptrdiff_t i = 0; i < m; ++i) {
        const float a = x1[i], b = y1[i], c = x2[i], d = y2[i];
        int either = 0, both = 0; /* each is its own neighbour */
        EG_SUM(either, both)
        for (ptrdiff_t j = 0; j < m; ++j) {
            const int first = (fabsf(x1[j] - a) < limit) & (fabsf(y1[j] - b) < limit);
            const int second = (fabsf(x2[j] - c) < limit) & (fabsf(y2[j] - d) < limit);
            either += first | second;
            both += first & second;
        }
        share[i] = ((double)(both - 1) + alone) / (double)either;
    }
    free(x1);
    return 1;
}
