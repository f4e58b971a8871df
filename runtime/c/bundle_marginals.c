/* Sums of the cameras' inverse over pairs of observations of a point: its part in the point's own.

   Only sums over observations are made here: where the processor has fused multiply-adds, they are
   used (see CMakeLists.txt). */
#include "bundle_pairs.h"

/* A row of the cameras' inverse: that of a view is `size` entries behind the one before. */
typedef struct {
    const double *X;
    ptrdiff_t size, K;
} block_row;

/* u += X_t Y_t over some observations, for twelve rows, or eight: entry (k, i) of a block is at
   W i + k, columns of Y and u are W apart. The sums stay in registers meanwhile. */
EG_INLINE void add_rows(int twelve, ptrdiff_t W, int four, const block_row *row, ptrdiff_t count,
                        const int32_t *view, const double *Y, double *EG_RESTRICT u)
{
    double p[8] = {0.0}, q[8] = {0.0}, r[8] = {0.0}, o[8] = {0.0};
    double e[4] = {0.0}, f[4] = {0.0}, g[4] = {0.0}, h[4] = {0.0};
    const ptrdiff_t b = four ? 4 : 3;
    for (ptrdiff_t s = 0; s < count; ++s, Y += b * W) {
        const double *EG_RESTRICT x = row->X + row->size * view[s];
        for (ptrdiff_t i = 0; i < row->K; ++i, x += W) {
            const double y = Y[i], z = Y[W + i], v = Y[2 * W + i], w = four ? Y[3 * W + i] : 0.0;
            EG_SIMD
            for (int k = 0; k < 8; ++k)
                p[k] += y * x[k], q[k] += z * x[k], r[k] += v * x[k];
            if (twelve) {
                EG_SIMD
                for (int k = 0; k < 4; ++k)
                    e[k] += y * x[8 + k], f[k] += z * x[8 + k], g[k] += v * x[8 + k];
            }
            if (!four)
                continue;
            EG_SIMD
            for (int k = 0; k < 8; ++k)
                o[k] += w * x[k];
            if (twelve) {
                EG_SIMD
                for (int k = 0; k < 4; ++k)
                    h[k] += w * x[8 + k];
            }
        }
    }
    for (int k = 0; k < 8; ++k)
        u[k] += p[k], u[W + k] += q[k], u[2 * W + k] += r[k];
    for (int k = 0; twelve && k < 4; ++k)
        u[8 + k] += e[k], u[W + 8 + k] += f[k], u[2 * W + 8 + k] += g[k];
    for (int k = 0; four && k < 8; ++k)
        u[3 * W + k] += o[k];
    for (int k = 0; four && twelve && k < 4; ++k)
        u[3 * W + 8 + k] += h[k];
}

EG_INLINE void add_products(ptrdiff_t W, int four, block_row row, ptrdiff_t count,
                            const int32_t *view, const double *Y, double *u)
{
    ptrdiff_t c = 0;
    for (; c + 12 <= W && W != 16; c += 12, row.X += 12)
        add_rows(1, W, four, &row, count, view, Y, u + c);
    for (; c < W; c += 8, row.X += 8)
        add_rows(0, W, four, &row, count, view, Y, u + c);
}

/* u += X^T Y for a block X as above. */
static void add_transposed(ptrdiff_t W, ptrdiff_t b, ptrdiff_t K, const double *X, const double *Y,
                           double *u)
{
    for (ptrdiff_t k = 0; k < b; ++k, Y += W, u += W)
        for (ptrdiff_t i = 0; i < K; ++i) {
            double sum = 0.0;
            for (ptrdiff_t l = 0; l < K; ++l)
                sum += X[W * i + l] * Y[l];
            u[i] += sum;
        }
}

/* See `marginal` of eg_route. */
EG_INLINE void add_marginal(ptrdiff_t W, int four, const eg_route *route, const eg_envelope *envelope,
                            const eg_group *group, ptrdiff_t lane, const double *X, double *Z,
                            double *coupled)
{
    const ptrdiff_t b = four ? 4 : 3, K = route->tangent, sums = route->pair_sums.size;
    const ptrdiff_t first = group->first[lane], count = group->first[lane + 1] - first;
    const int32_t *view = group->view + first;
    const double *Y = group->turned + b * W * first;
    double total[16] = {0.0};
    if (coupled)
        memset(coupled, 0, (size_t)(b * W * count) * sizeof *coupled);
    for (ptrdiff_t t = 0; t < count; ++t) {
        const ptrdiff_t lowest = envelope->first[view[t]];
        const block_row row = {X + sums * (envelope->slot[view[t]] - lowest), sums, K};
        const double *own = Y + b * W * t;
        double u[4 * EG_MOST_TANGENT] = {0.0};
        add_products(W, four, row, t, view, Y, u);
        for (ptrdiff_t k = 0; coupled && k < b * W; ++k)
            coupled[b * W * t + k] += u[k];
        for (ptrdiff_t s = 0; coupled && s < t; ++s)
            add_transposed(W, b, K, row.X + sums * view[s], own, coupled + b * W * s);
        /* Pairs count in both orders. */
        EG_SIMD
        for (ptrdiff_t k = 0; k < b * W; ++k)
            u[k] += u[k];
        double alone[4 * EG_MOST_TANGENT] = {0.0};
        add_products(W, four, row, 1, view + t, own, alone);
        for (ptrdiff_t k = 0; coupled && k < b * W; ++k)
            coupled[b * W * t + k] += alone[k];
        EG_SIMD
        for (ptrdiff_t k = 0; k < b * W; ++k)
            u[k] += alone[k];
        for (ptrdiff_t i = 0; i < b; ++i)
            for (ptrdiff_t k = 0; k < b; ++k) {
                double part[4] = {0.0};
                for (ptrdiff_t l = 0; l < W; l += 4)
                    for (int c = 0; c < 4; ++c)
                        part[c] += own[W * i + l + c] * u[W * k + l + c];
                total[b * i + k] += (part[0] + part[1]) + (part[2] + part[3]);
            }
    }
    memcpy(Z, total, (size_t)(b * b) * sizeof *Z);
}

#define WIDTH(W)                                                                                   \
    static void marginal_three_##W(const eg_route *route, const eg_envelope *envelope,             \
                                   const eg_group *group, ptrdiff_t lane, const double *X,         \
                                   double *Z, double *coupled)                                     \
    {                                                                                              \
        add_marginal(W, 0, route, envelope, group, lane, X, Z, coupled);                           \
    }                                                                                              \
    static void marginal_four_##W(const eg_route *route, const eg_envelope *envelope,              \
                                  const eg_group *group, ptrdiff_t lane, const double *X,          \
                                  double *Z, double *coupled)                                      \
    {                                                                                              \
        add_marginal(W, 1, route, envelope, group, lane, X, Z, coupled);                           \
    }

EG_WIDTHS(WIDTH)

void eg_direct_marginal(eg_route *route)
{
    const int three = route->point == 3;
    switch (route->padded) {
#define CASE(W)                                                                                    \
    case W:                                                                                        \
        route->marginal = three ? marginal_three_##W : marginal_four_##W;                          \
        break;
        EG_WIDTHS(CASE)
#undef CASE
    }
}
