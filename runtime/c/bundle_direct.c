/* The direct route: any camera model of the generated table, by its Jacobians. */
#include "bundle_pairs.h"

static void square(const eg_pass *p, const double *EG_RESTRICT r)
{
    double *EG_RESTRICT squares = p->squared;
    const ptrdiff_t M = p->chunk.M;
    EG_SIMD
    for (ptrdiff_t j = 0; j < M; ++j)
        squares[j] = r[j] * r[j] + r[M + j] * r[M + j];
}

static void squared(const eg_pass *p)
{
    eg_model_of(p)->residual(p->chunk.M, p->cameras, p->points, p->q, p->work);
    square(p, p->work);
}

/* V, -g of lanes from weighted residuals r and Jacobians J (2, b) of points. */
static void point_sums(const eg_pass *p, const double *EG_RESTRICT r, const double *EG_RESTRICT J,
                       double *EG_RESTRICT own)
{
    const ptrdiff_t M = p->chunk.M, b = p->route->point;
    const double *EG_RESTRICT w = p->w;
    for (ptrdiff_t i = 0; i < b; ++i) {
        const double *EG_RESTRICT x = J + i * M, *EG_RESTRICT y = J + (b + i) * M;
        for (ptrdiff_t l = i; l < b; ++l, own += M) {
            const double *EG_RESTRICT u = J + l * M, *EG_RESTRICT v = J + (b + l) * M;
            EG_SIMD
            for (ptrdiff_t j = 0; j < M; ++j)
                own[j] = w[j] * (x[j] * u[j] + y[j] * v[j]);
        }
    }
    for (ptrdiff_t i = 0; i < b; ++i, own += M) {
        const double *EG_RESTRICT x = J + i * M, *EG_RESTRICT y = J + (b + i) * M;
        EG_SIMD
        for (ptrdiff_t j = 0; j < M; ++j)
            own[j] = -w[j] * (x[j] * r[j] + y[j] * r[M + j]);
    }
}

static void sight(const eg_pass *p, const double *points, double *own)
{
    const ptrdiff_t M = p->chunk.M;
    double *r = p->work, *J = r + 2 * M;
    eg_model_of(p)->sight(M, p->cameras, points, p->q, r, J);
    square(p, r);
    eg_weigh(p);
    point_sums(p, r, J, own);
}

/* Sums of the cameras of a slot, K rows of J^T J and one of the gradient. */
EG_INLINE void camera_sums(const eg_pass *p, ptrdiff_t padded, const double *r, const double *J,
                               double *cameras)
{
    const ptrdiff_t M = p->chunk.M, K = p->route->tangent;
    for (ptrdiff_t j = 0; j < p->filled; ++j) {
        double first[EG_MOST_TANGENT], second[EG_MOST_TANGENT];
        double *EG_RESTRICT sum = cameras + p->route->camera_sums * p->view[j];
        const double w = p->w[j], e = w * r[j], f = w * r[M + j];
        eg_turn_camera(p, padded, J, j, first, second);
        for (ptrdiff_t a = 0; a < K; ++a) {
            const double x = w * first[a], y = w * second[a];
            EG_SIMD
            for (ptrdiff_t c = 0; c < padded; ++c)
                sum[padded * a + c] += x * first[c] + y * second[c];
        }
        EG_SIMD
        for (ptrdiff_t c = 0; c < padded; ++c)
            sum[padded * K + c] -= e * first[c] + f * second[c];
    }
}

static void observe(const eg_pass *p, double *own, double *cameras)
{
    const ptrdiff_t M = p->chunk.M, padded = p->route->padded;
    double *r = p->work, *J = r + 2 * M, *J_camera = J + 2 * p->route->point * M;
    eg_model_of(p)->observe(M, p->cameras, p->points, p->q, r, J_camera, J);
    square(p, r);
    eg_weigh(p);
    point_sums(p, r, J, own);
    switch (padded) {
#define CASE(W) case W: camera_sums(p, W, r, J_camera, cameras); break;
        EG_WIDTHS(CASE)
#undef CASE
    }
}

/* F: the camera's Jacobian (2, tangent of the model), then w J_point T (2, b). */
static void couple(const eg_pass *p, const double *roots, double *F)
{
    const ptrdiff_t M = p->chunk.M, b = p->route->point;
    double *r = p->work, *J = r + 2 * M;
    double *EG_RESTRICT Z = F + 2 * eg_model_of(p)->tangent_size * M;
    eg_model_of(p)->observe(M, p->cameras, p->points, p->q, r, F, J);
    if (p->bundle->loss != EG_LINEAR)
        square(p, r);
    eg_weigh(p);
    const double *EG_RESTRICT w = p->w;
    for (ptrdiff_t i = 0; i < 2; ++i)
        for (ptrdiff_t k = 0; k < b; ++k, Z += M) {
            const double *EG_RESTRICT x = J + i * b * M, *EG_RESTRICT T = roots + k * M;
            EG_SIMD
            for (ptrdiff_t j = 0; j < M; ++j)
                Z[j] = x[j] * T[j];
            for (ptrdiff_t l = 1; l < b; ++l) { /* all of T: a change of parameters is full */
                EG_SIMD
                for (ptrdiff_t j = 0; j < M; ++j)
                    Z[j] += x[l * M + j] * T[l * b * M + j];
            }
            EG_SIMD
            for (ptrdiff_t j = 0; j < M; ++j)
                Z[j] *= w[j];
        }
}

static void to_points(const eg_pass *p, const double *F, const double *x, double *v)
{
    const ptrdiff_t M = p->chunk.M, b = p->route->point, K = p->route->tangent;
    const ptrdiff_t d = eg_model_of(p)->tangent_size;
    const int32_t *column = p->bundle->columns;
    const double *Z = F + 2 * d * M;
    double *EG_RESTRICT u = p->work;
    for (ptrdiff_t i = 0; i < 2; ++i) {
        memset(u, 0, (size_t)M * sizeof(double));
        for (ptrdiff_t k = 0; k < K; ++k) {
            const double *EG_RESTRICT J = F + (i * d + column[k]) * M, *EG_RESTRICT own = x + k * M;
            EG_SIMD
            for (ptrdiff_t j = 0; j < M; ++j)
                u[j] += J[j] * own[j];
        }
        for (ptrdiff_t k = 0; k < b; ++k) {
            const double *EG_RESTRICT z = Z + (i * b + k) * M;
            double *EG_RESTRICT sum = v + k * M;
            EG_SIMD
            for (ptrdiff_t j = 0; j < M; ++j)
                sum[j] += z[j] * u[j];
        }
    }
}

static void to_cameras(const eg_pass *p, const double *F, const double *v, double *cameras)
{
    const ptrdiff_t M = p->chunk.M, b = p->route->point, K = p->route->tangent;
    const ptrdiff_t d = eg_model_of(p)->tangent_size;
    const int32_t *column = p->bundle->columns;
    const double *Z = F + 2 * d * M;
    for (ptrdiff_t j = 0; j < p->filled; ++j) {
        double *EG_RESTRICT camera = cameras + K * p->view[j];
        double x = 0.0, y = 0.0;
        for (ptrdiff_t k = 0; k < b; ++k) {
            x += Z[k * M + j] * v[k * M + j];
            y += Z[(b + k) * M + j] * v[k * M + j];
        }
        for (ptrdiff_t k = 0; k < K; ++k)
            camera[k] += F[column[k] * M + j] * x + F[(d + column[k]) * M + j] * y;
    }
}

/* Row of a camera model by the name that its kernels begin with; -1 where there is none. */
ptrdiff_t eg_camera_model_row(const char *name)
{
    for (ptrdiff_t row = 0; eg_camera_models[row].name; ++row)
        if (!strcmp(eg_camera_models[row].name, name))
            return row;
    return -1;
}

eg_route eg_direct_route(const eg_bundle *bundle)
{
    const eg_camera_model *model = eg_camera_models + bundle->model;
    const ptrdiff_t K = bundle->width, b = model->point_size, d = model->tangent_size;
    const ptrdiff_t padded = K <= 8 ? 8 : K <= 24 ? (K + 3) / 4 * 4 : 32;
    const eg_route route = {
        .camera = model->camera_size,
        .point = b,
        .tangent = K,
        .padded = padded,
        .camera_sums = padded * (K + 1),
        .pair_sums = padded * K,
        .sums = b * (b + 1) / 2 + b,
        .factors = 2 * d + 2 * b,
        .turned = b * padded,
        .work = 2 + 2 * d + 2 * b,
        .squared = squared,
        .sight = sight,
        .observe = observe,
        .couple = couple,
        .to_points = to_points,
        .to_cameras = to_cameras,
        .pairs = eg_direct_pairs(padded, b),
    };
    return route;
}
