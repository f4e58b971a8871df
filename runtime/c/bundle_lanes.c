/* The order in which the points of a bundle are worked on, and how they fall into chunks. */
#include <stdlib.h>
#include <string.h>

#include "bundle.h"

/* Observations a chunk, so that it stays in the fast cache, and the most lanes. */
#define ROWS 384
#define MOST_LANES 56

/* Sort indices stably by keys in [0, kinds): by counting. `begins` has kinds + 1 entries. */
static void sort(ptrdiff_t count, ptrdiff_t kinds, const ptrdiff_t *keys, ptrdiff_t *begins,
                 const ptrdiff_t *from, ptrdiff_t *to)
{
    memset(begins, 0, (size_t)(kinds + 1) * sizeof(ptrdiff_t));
    for (ptrdiff_t k = 0; k < count; ++k)
        begins[keys[k] + 1] += 1;
    for (ptrdiff_t key = 0; key < kinds; ++key)
        begins[key + 1] += begins[key];
    for (ptrdiff_t k = 0; k < count; ++k)
        to[begins[keys[from[k]]]++] = from[k];
}

/* Points by falling number of observations, those of the same views together. */
static int order(ptrdiff_t n, ptrdiff_t m, const ptrdiff_t *first, const ptrdiff_t *view,
                 ptrdiff_t *points)
{
    ptrdiff_t most = 0;
    for (ptrdiff_t j = 0; j < m; ++j)
        if (first[j + 1] - first[j] > most)
            most = first[j + 1] - first[j];
    const ptrdiff_t kinds = most >= n ? most + 1 : n;
    ptrdiff_t *keys = malloc((size_t)(2 * m + kinds + 1) * sizeof(ptrdiff_t));
    if (!keys)
        return 1;
    ptrdiff_t *other = keys + m, *begins = other + m;
    for (ptrdiff_t j = 0; j < m; ++j)
        other[j] = j;
    /* By the last view, the second, the first: the last sort counts most. */
    for (int k = 2; k >= 0; --k) {
        for (ptrdiff_t j = 0; j < m; ++j) {
            const ptrdiff_t last = first[j + 1] - 1, at = k == 2 ? last : first[j] + k;
            keys[j] = last < first[j] ? 0 : view[at < last ? at : last];
        }
        memcpy(points, other, (size_t)m * sizeof(ptrdiff_t));
        sort(m, n, keys, begins, points, other);
    }
    for (ptrdiff_t j = 0; j < m; ++j)
        keys[j] = most - (first[j + 1] - first[j]);
    sort(m, most + 1, keys, begins, other, points);
    free(keys);
    return 0;
}

/* Fill in the points in their order, where the lanes and rows of each chunk begin (at most m / EG_LANES
   + 2 numbers), and point and observations of each lane (at most m + EG_LANES - 1). Returns the number
   of chunks, or -1 without memory. */
ptrdiff_t eg_bundle_chunks(ptrdiff_t n, ptrdiff_t m, const ptrdiff_t *first, const ptrdiff_t *view,
                           ptrdiff_t *points, ptrdiff_t *lanes, ptrdiff_t *rows, int32_t *point,
                           int32_t *count)
{
    if (order(n, m, first, view, points))
        return -1;
    ptrdiff_t chunks = 0;
    lanes[0] = rows[0] = 0;
    for (ptrdiff_t lane = 0; lane < m; ++chunks) {
        const ptrdiff_t seen = first[points[lane] + 1] - first[points[lane]];
        ptrdiff_t width = ROWS / (seen > 0 ? seen : 1) / EG_LANES * EG_LANES;
        width = width < EG_LANES ? EG_LANES : width > MOST_LANES ? MOST_LANES : width;
        /* The last chunk has as many lanes as it needs, in full vectors. */
        if (lane + width > m)
            width = (m - lane + EG_LANES - 1) / EG_LANES * EG_LANES;
        rows[chunks + 1] = rows[chunks] + width * seen;
        lanes[chunks + 1] = lane += width;
    }
    for (ptrdiff_t k = 0; k < lanes[chunks]; ++k) {
        const ptrdiff_t j = points[k < m ? k : m - 1];
        point[k] = (int32_t)j;
        count[k] = k < m ? (int32_t)(first[j + 1] - first[j]) : 0;
    }
    return chunks;
}
