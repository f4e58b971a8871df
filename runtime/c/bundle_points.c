/* The blocks of points: inverse roots, damped steps, moments. */
#include "bundle_points.h"

#define BATCH 64

/* Row-wise place of the entries of upper triangles. */
static inline int place(int b, int i, int l)
{
    return i * b - i * (i - 1) / 2 + l - i;
}

void eg_moments(ptrdiff_t M, const double *EG_RESTRICT points, double *EG_RESTRICT moments)
{
    for (ptrdiff_t j = 0; j < M; ++j) {
        double *row = moments + 16 * j;
        ptrdiff_t k = 0;
        for (int i = 0; i < 4; ++i)
            for (int l = i; l < 4; ++l)
                row[k++] = points[i * M + j] * points[l * M + j];
        row[10] = row[11] = 0.0;
        for (int i = 0; i < 4; ++i)
            row[12 + i] = points[i * M + j];
    }
}

/* T with T T^T = A^-1 from upper triangles A, in lanes. */
static inline void inverse_root(ptrdiff_t M, int b, const double *A, double *T)
{
    if (b == 3)
        eg_inverse_root3(M, A, T);
    else
        eg_inverse_root(M, A, T);
}

/* A = V + lam W in lanes, by trace or block. */
static inline void damp(ptrdiff_t M, int b, int damping, const double *EG_RESTRICT V,
                        const double *EG_RESTRICT lams, double *EG_RESTRICT A)
{
    for (int k = 0; k < b * (b + 1) / 2; ++k) {
        EG_SIMD
        for (ptrdiff_t j = 0; j < M; ++j)
            A[k * M + j] = (damping == EG_BLOCK ? 1.0 + lams[j] : 1.0) * V[k * M + j];
    }
    EG_SIMD
    for (ptrdiff_t j = 0; j < M; ++j) {
        double trace = V[j];
        for (int i = 1; i < b; ++i)
            trace += V[place(b, i, i) * M + j];
        const double shift = damping == EG_BLOCK ? 0.0 : lams[j] * (trace / b);
        for (int i = 0; i < b; ++i)
            A[place(b, i, i) * M + j] += shift;
    }
}

void eg_damped_roots(ptrdiff_t M, ptrdiff_t b, int damping, const double *sums, double lam,
                    double *EG_RESTRICT scratch, double *EG_RESTRICT T, double *EG_RESTRICT half)
{
    const ptrdiff_t size = b * (b + 1) / 2;
    const double *EG_RESTRICT g = sums + (damping == EG_DEPTHS ? 2 : 1) * size * M;
    if (damping == EG_DEPTHS) {
        for (ptrdiff_t k = 0; k < size * M; ++k)
            scratch[k] = sums[k] + sums[size * M + k];
        eg_damped_inverse_root(M, sums, scratch, &lam, T);
    } else {
        for (ptrdiff_t j = 0; j < M; ++j)
            half[j] = lam; /* for each lane */
        if (b == 3)
            damp(M, 3, damping, sums, half, scratch);
        else
            damp(M, 4, damping, sums, half, scratch);
        inverse_root(M, (int)b, scratch, T);
    }
    for (ptrdiff_t k = 0; k < b; ++k) {
        EG_SIMD
        for (ptrdiff_t j = 0; j < M; ++j)
            half[k * M + j] = T[k * M + j] * g[j];
        for (ptrdiff_t l = 1; l < b; ++l) {
            EG_SIMD
            for (ptrdiff_t j = 0; j < M; ++j)
                half[k * M + j] += T[(b * l + k) * M + j] * g[l * M + j];
        }
    }
}

static inline void step(ptrdiff_t M, int b, int damping, const double *EG_RESTRICT sums,
                        const double *EG_RESTRICT lams, double *EG_RESTRICT scratch,
                        double *EG_RESTRICT steps, double *EG_RESTRICT promised)
{
    const int size = b * (b + 1) / 2;
    const double *EG_RESTRICT g = sums + size * M;
    double *EG_RESTRICT T = scratch + size * M;
    damp(M, b, damping, sums, lams, scratch);
    inverse_root(M, b, scratch, T);
    EG_SIMD
    for (ptrdiff_t j = 0; j < M; ++j) {
        double v[4], sum = 0.0;
        for (int l = 0; l < b; ++l) {
            v[l] = T[l * M + j] * g[j];
            for (int i = 1; i <= l; ++i)
                v[l] += T[(b * i + l) * M + j] * g[i * M + j];
            sum += v[l] * v[l];
        }
        promised[j] = sum;
        for (int i = 0; i < b; ++i) {
            double value = 0.0;
            for (int l = i; l < b; ++l)
                value -= T[(b * i + l) * M + j] * v[l];
            steps[i * M + j] = value;
        }
    }
}

void eg_damped_point_step(ptrdiff_t M, ptrdiff_t b, int damping, const double *sums,
                          const double *lams, double *scratch, double *steps, double *promised)
{
    if (b == 3)
        step(M, 3, damping, sums, lams, scratch, steps, promised);
    else
        step(M, 4, damping, sums, lams, scratch, steps, promised);
}

/* As `eg_bundle_inverse_roots`, for up to BATCH points of b entries. */
static inline int roots(int b, ptrdiff_t n, const double *V, const double *W, ptrdiff_t width,
                        double lam, const double *g, double *T, double *half)
{
    double A[10 * BATCH], packed_W[10 * BATCH], root[16 * BATCH];
    const int size = b * (b + 1) / 2;
    int bad = 0;
    for (ptrdiff_t j = 0; j < n; ++j)
        for (int i = 0; i < b; ++i)
            for (int l = i; l < b; ++l) {
                A[place(b, i, l) * n + j] = V[b * b * j + b * i + l];
                if (W && width > 1)
                    packed_W[place(b, i, l) * n + j] = W[b * b * j + b * i + l];
            }
    if (b == 4 && W && width > 1) {
        eg_damped_inverse_root(n, A, packed_W, &lam, root);
    } else {
        for (ptrdiff_t k = 0; W && width > 1 && k < size * n; ++k)
            A[k] += lam * packed_W[k];
        for (int i = 0; W && width == 1 && i < b; ++i)
            for (ptrdiff_t j = 0; j < n; ++j)
                A[place(b, i, i) * n + j] += lam * W[j];
        inverse_root(n, b, A, root);
    }
    for (ptrdiff_t j = 0; j < n; ++j) {
        double *row = T + b * b * j;
        double sum = 0.0;
        for (int k = 0; k < b * b; ++k) {
            row[k] = root[k * n + j];
            sum += row[k];
        }
        bad |= !(sum - sum == 0.0);
        for (int k = 0; g && k < b; ++k) {
            double value = 0.0;
            for (int l = 0; l < b; ++l)
                value += row[b * l + k] * g[b * j + l];
            half[b * j + k] = value;
        }
    }
    return bad;
}

/* T (m, b, b), upper triangular with T T^T = (V + lam W)^-1, or V^-1 where W is NULL; W has `width`
   b b entries a point, or one, a multiple of I. half = T^T g, (m, b), unless g is NULL. Returns 1
   where a block is not positive definite. */
int eg_bundle_inverse_roots(
    ptrdiff_t m, ptrdiff_t b, const double *V, const double *W, ptrdiff_t width, double lam,
    const double *g, double *T, double *half)
{
    int bad = 0;
    for (ptrdiff_t begin = 0; begin < m; begin += BATCH) {
        const ptrdiff_t n = m - begin < BATCH ? m - begin : BATCH, k = b * b * begin;
        const double *own = W ? W + width * begin : 0, *gradient = g ? g + b * begin : 0;
        double *moved = g ? half + b * begin : 0;
        if (b == 3)
            bad |= roots(3, n, V + k, own, width, lam, gradient, T + k, moved);
        else
            bad |= roots(4, n, V + k, own, width, lam, gradient, T + k, moved);
    }
    return bad;
}

/* step = -T (half + coupled) for each point; returns the sum of step^T W step, W as above. */
double eg_bundle_point_steps(
    ptrdiff_t m, ptrdiff_t b, const double *T, const double *half, const double *coupled,
    const double *W, ptrdiff_t width, double *steps)
{
    double energy = 0.0;
    for (ptrdiff_t j = 0; j < m; ++j) {
        const double *root = T + b * b * j;
        double *own = steps + b * j, v[4];
        for (ptrdiff_t k = 0; k < b; ++k)
            v[k] = half[b * j + k] + coupled[b * j + k];
        for (ptrdiff_t i = 0; i < b; ++i) {
            double value = root[b * i] * v[0];
            for (ptrdiff_t k = 1; k < b; ++k)
                value += root[b * i + k] * v[k];
            own[i] = -value;
        }
        for (ptrdiff_t i = 0; W && width == 1 && i < b; ++i)
            energy += own[i] * W[j] * own[i];
        for (ptrdiff_t i = 0; W && width > 1 && i < b; ++i)
            for (ptrdiff_t k = 0; k < b; ++k)
                energy += own[i] * W[b * b * j + b * i + k] * own[k];
    }
    return energy;
}
