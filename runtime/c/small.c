#include "small.h"

#include <float.h>
#include <math.h>
#include <string.h>

double eg_cholesky(int p, const double *A, double shift, double *L)
{
    double largest = 0.0, least = INFINITY;
    for (int j = 0; j < p; ++j) {
        double pivot = A[j * p + j] + shift;
        largest = fmax(largest, fabs(pivot));
        for (int k = 0; k < j; ++k)
            pivot -= L[j * p + k] * L[j * p + k];
        if (!(pivot > 0.0))
            return 0.0;
        least = fmin(least, pivot);
        const double root = sqrt(pivot);
        L[j * p + j] = root;
        for (int i = j + 1; i < p; ++i) {
            double sum = A[i * p + j];
            for (int k = 0; k < j; ++k)
                sum -= L[i * p + k] * L[j * p + k];
            L[i * p + j] = sum / root;
        }
    }
    return least / largest;
}

void eg_cholesky_solve(int p, const double *L, double *x)
{
    for (int i = 0; i < p; ++i) {
        for (int k = 0; k < i; ++k)
            x[i] -= L[i * p + k] * x[k];
        x[i] /= L[i * p + i];
    }
    for (int i = p - 1; i >= 0; --i) {
        for (int k = i + 1; k < p; ++k)
            x[i] -= L[k * p + i] * x[k];
        x[i] /= L[i * p + i];
    }
}

/* The tangent of the smaller angle whose rotation annuls `off`, which is not zero; `half` is half
   the difference of the diagonal entries. Not by hypot: its newer version would tie the library to
   glibc 2.35. */
static double tangent(double half, double off)
{
    const double ratio = half / off;
    return copysign(1.0, ratio) / (fabs(ratio) + sqrt(1.0 + ratio * ratio));
}

/* One Jacobi rotation of rows and columns i and j. */
static void rotate(int p, double *A, double *vectors, int i, int j)
{
    const double off = A[i * p + j];
    const double t = tangent(0.5 * (A[j * p + j] - A[i * p + i]), off);
    const double c = 1.0 / sqrt(1.0 + t * t), s = t * c;
    for (int k = 0; k < p; ++k) {
        const double a = A[k * p + i], b = A[k * p + j];
        A[k * p + i] = c * a - s * b;
        A[k * p + j] = s * a + c * b;
    }
    for (int k = 0; k < p; ++k) {
        const double a = A[i * p + k], b = A[j * p + k];
        A[i * p + k] = c * a - s * b;
        A[j * p + k] = s * a + c * b;
    }
    A[i * p + j] = A[j * p + i] = 0.0;
    for (int k = 0; k < p; ++k) {
        const double a = vectors[k * p + i], b = vectors[k * p + j];
        vectors[k * p + i] = c * a - s * b;
        vectors[k * p + j] = s * a + c * b;
    }
}

static void swap(double *a, double *b)
{
    const double kept = *a;
    *a = *b;
    *b = kept;
}

void eg_eigen(int p, const double *symmetric, double *values, double *vectors)
{
    double A[EG_SMALL * EG_SMALL];
    memcpy(A, symmetric, (size_t)(p * p) * sizeof(double));
    memset(vectors, 0, (size_t)(p * p) * sizeof(double));
    for (int i = 0; i < p; ++i)
        vectors[i * p + i] = 1.0;
    for (int sweep = 0, moved = 1; moved && sweep < 50; ++sweep) {
        moved = 0;
        for (int i = 0; i < p - 1; ++i)
            for (int j = i + 1; j < p; ++j) {
                const double small = 0.25 * DBL_EPSILON * sqrt(fabs(A[i * p + i] * A[j * p + j]));
                if (fabs(A[i * p + j]) > small && fabs(A[i * p + j]) > DBL_MIN) {
                    rotate(p, A, vectors, i, j);
                    moved = 1;
                }
            }
    }
    for (int i = 0; i < p; ++i)
        values[i] = A[i * p + i];
    for (int i = 1; i < p; ++i)
        for (int j = i; j > 0 && values[j] < values[j - 1]; --j) {
            swap(values + j, values + j - 1);
            for (int k = 0; k < p; ++k)
                swap(vectors + k * p + j, vectors + k * p + j - 1);
        }
}

static double dot3(const double *a, const double *b)
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static void cross3(const double *a, const double *b, double *c)
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

/* One-sided Jacobi: the columns a of F and v of V are rotated until those of F are orthogonal. */
int eg_factorize(const double *F, double *U, double *V, double *sigma)
{
    double a[3][3], v[3][3] = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            a[j][i] = F[3 * i + j];
    for (int sweep = 0, moved = 1; moved && sweep < 50; ++sweep) {
        moved = 0;
        for (int i = 0; i < 2; ++i)
            for (int j = i + 1; j < 3; ++j) {
                const double aii = dot3(a[i], a[i]), ajj = dot3(a[j], a[j]), aij = dot3(a[i], a[j]);
                if (!(fabs(aij) > 2.0 * DBL_EPSILON * sqrt(aii * ajj)))
                    continue;
                const double t = tangent(0.5 * (ajj - aii), aij);
                const double c = 1.0 / sqrt(1.0 + t * t), s = t * c;
                for (int k = 0; k < 3; ++k) {
                    const double x = a[i][k], y = v[i][k];
                    a[i][k] = c * x - s * a[j][k];
                    a[j][k] = s * x + c * a[j][k];
                    v[i][k] = c * y - s * v[j][k];
                    v[j][k] = s * y + c * v[j][k];
                }
                moved = 1;
            }
    }
    int order[3] = {0, 1, 2};
    double norms[3];
    for (int i = 0; i < 3; ++i)
        norms[i] = sqrt(dot3(a[i], a[i]));
    for (int i = 1; i < 3; ++i)
        for (int j = i; j > 0 && norms[order[j]] > norms[order[j - 1]]; --j) {
            const int kept = order[j];
            order[j] = order[j - 1];
            order[j - 1] = kept;
        }
    const double s1 = norms[order[0]], s2 = norms[order[1]];
    if (!(s2 > 16.0 * DBL_EPSILON * s1))
        return 0;
    double u[3][3];
    for (int i = 0; i < 3; ++i) {
        u[0][i] = a[order[0]][i] / s1;
        u[1][i] = a[order[1]][i] / s2;
    }
    cross3(u[0], u[1], u[2]);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            U[3 * i + j] = u[j][i];
            V[3 * i + j] = v[order[j]][i];
        }
    *sigma = s2 / s1;
    return 1;
}
