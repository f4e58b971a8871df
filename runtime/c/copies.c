/* Repeated matches: which rows of (x1, x2) hold the same four numbers as an earlier one. */
#include "losses.h"

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* Bits of a coordinate; +0 and -0 are one. */
static uint64_t bits(double value)
{
    const double plain = value + 0.0;
    uint64_t word;
    memcpy(&word, &plain, sizeof word);
    return word;
}

static uint64_t mixed(uint64_t hash, double value)
{
    hash = (hash ^ bits(value)) * 0x9E3779B97F4A7C15u;
    return hash ^ (hash >> 29);
}

static int same(const double *a, const double *b)
{
    return a[0] == b[0] && a[1] == b[1];
}

/* first[i] <- the earliest match of its pair that equals match i, an index into the pair's matches.
   Returns the number of copies, or -1 where memory ran out. NaN equals nothing. */
EG_EXPORT ptrdiff_t eg_copies(ptrdiff_t pairs, const ptrdiff_t *offsets, const double *x1,
                              const double *x2, ptrdiff_t *first)
{
    ptrdiff_t most = 0, copies = 0;
    for (ptrdiff_t k = 0; k < pairs; ++k)
        most = offsets[k + 1] - offsets[k] > most ? offsets[k + 1] - offsets[k] : most;
    size_t size = 16;
    while (size < 2 * (size_t)most)
        size *= 2;
    ptrdiff_t *table = malloc(size * sizeof *table);
    if (!table)
        return -1;
    for (ptrdiff_t k = 0; k < pairs; ++k) {
        const ptrdiff_t begin = offsets[k], m = offsets[k + 1] - begin;
        const double *a = x1 + 2 * begin, *b = x2 + 2 * begin;
        size_t room = 16;
        while (room < 2 * (size_t)m)
            room *= 2;
        memset(table, 0xFF, room * sizeof *table); /* -1 everywhere */
        for (ptrdiff_t i = 0; i < m; ++i) {
            uint64_t hash = mixed(mixed(0, a[2 * i]), a[2 * i + 1]);
            hash = mixed(mixed(hash, b[2 * i]), b[2 * i + 1]);
            size_t place = (size_t)(hash >> 7) & (room - 1);
            for (; table[place] >= 0; place = (place + 1) & (room - 1)) {
                const ptrdiff_t j = table[place];
                if (same(a + 2 * i, a + 2 * j) && same(b + 2 * i, b + 2 * j))
                    break;
            }
            if (table[place] < 0)
                table[place] = i;
            else
                ++copies;
            first[begin + i] = table[place];
        }
    }
    free(table);
    return copies;
}
