/* Observations of some chunks, as their pairs are added up: lane by lane, in rising order of views. */
#ifndef EPIGAUGE_BUNDLE_GROUP_H
#define EPIGAUGE_BUNDLE_GROUP_H

#include "bundle_chunk.h"

/* Doubles of turned factors that a group holds, of more chunks than one. With more of them the sums of
   a pair of views stay longer in the fast cache; with fewer the factors do. */
#define EG_GROUP 32768

/* Pairs of observations of one row of the envelope, with those of a column, that wait to be added up
   together: numbers in the group, of the column's and the row's one. */
#define EG_WAITING 24
typedef struct {
    int32_t count, pair[2 * EG_WAITING];
} eg_waiting;

struct eg_group {
    ptrdiff_t lanes, count; /* that hold a point; observations */
    double *turned;         /* so many doubles an observation as its route says */
    double *moments;        /* 16 a lane, of the factored route */
    int32_t *first;         /* first observation of each lane, and the end */
    int32_t *view, *lane;   /* of each observation */
    int32_t *end, *sorted;  /* scratch: an entry a view and two more; one an observation */
    eg_waiting *waiting;    /* of the direct route: an entry a view, all of them empty */
    int32_t *columns;       /* and one a view */
};

/* Lay out the lanes of a chunk behind those there are. */
static inline void eg_group_append(eg_group *group, const eg_chunk *chunk)
{
    for (ptrdiff_t j = 0; j < chunk->M && chunk->count[j]; ++j) {
        group->first[group->lanes] = (int32_t)group->count;
        for (ptrdiff_t s = 0; s < chunk->count[j]; ++s) {
            group->view[group->count] = chunk->view[s * chunk->M + j];
            group->lane[group->count++] = (int32_t)group->lanes;
        }
        group->first[++group->lanes] = (int32_t)group->count;
    }
}

/* End of the chunks from `begin` on that make a group. */
static inline ptrdiff_t eg_group_end(const eg_bundle *b, ptrdiff_t begin, ptrdiff_t end, ptrdiff_t turned)
{
    ptrdiff_t next = begin + 1;
    while (next < end && (b->rows[next + 1] - b->rows[begin]) * turned <= EG_GROUP)
        ++next;
    return next;
}

/* The most lanes, and observations, of a group of some chunks. */
static inline ptrdiff_t eg_group_most(const eg_bundle *b, const eg_route *route, ptrdiff_t begin,
                                      ptrdiff_t end, const ptrdiff_t *edges)
{
    ptrdiff_t most = 0;
    for (ptrdiff_t c = begin, next; c < end; c = next) {
        next = eg_group_end(b, c, end, route->turned);
        most = edges[next] - edges[c] > most ? edges[next] - edges[c] : most;
    }
    return most;
}

/* A group with room for the largest of some chunks; 1 where there is no memory. */
static inline int eg_group_begin(eg_group *group, const eg_bundle *b, const eg_route *route,
                                 ptrdiff_t begin, ptrdiff_t end)
{
    const ptrdiff_t rows = eg_group_most(b, route, begin, end, b->rows);
    const ptrdiff_t lanes = eg_group_most(b, route, begin, end, b->lanes);
    const ptrdiff_t moments = route->factored ? 16 * lanes : 0;
    const ptrdiff_t each = route->factored ? 0 : 1 + (ptrdiff_t)(sizeof *group->waiting / sizeof(int32_t));
    const ptrdiff_t whole = 3 * rows + lanes + 1 + b->n_views + 2 + each * b->n_views;
    group->turned = eg_aligned(route->turned * rows + moments + (whole + 1) / 2);
    group->moments = group->turned + route->turned * rows;
    group->view = (int32_t *)(group->moments + moments);
    group->lane = group->view + rows;
    group->sorted = group->lane + rows;
    group->first = group->sorted + rows;
    group->end = group->first + lanes + 1;
    group->columns = group->end + b->n_views + 2;
    group->waiting = (eg_waiting *)(group->columns + b->n_views);
    if (!group->turned)
        return 1;
    for (ptrdiff_t i = 0; !route->factored && i < b->n_views; ++i)
        group->waiting[i].count = 0;
    return 0;
}

static inline void eg_group_clear(eg_group *group)
{
    group->lanes = group->count = 0;
    group->first[0] = 0;
}

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

#endif
