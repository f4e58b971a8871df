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

/* Add V and -g of lanes from weighted residuals r and Jacobians J (2, b) of points. */
static void add_points(const eg_pass *p, const double *EG_RESTRICT r, const double *EG_RESTRICT J,
                       double *EG_RESTRICT sums)
{
    const ptrdiff_t M = p->chunk.M, b = p->route->point;
    const double *EG_RESTRICT w = p->w;
    double *EG_RESTRICT g = sums + b * (b + 1) / 2 * M;
    for (ptrdiff_t i = 0; i < b; ++i, g += M) {
        const double *EG_RESTRICT x = J + i * M, *EG_RESTRICT y = J + (b + i) * M;
        for (ptrdiff_t l = i; l < b; ++l, sums += M) {
            const double *EG_RESTRICT u = J + l * M, *EG_RESTRICT v = J + (b + l) * M;
            EG_SIMD
            for (ptrdiff_t j = 0; j < M; ++j)
                sums[j] += w[j] * (x[j] * u[j] + y[j] * v[j]);
        }
        EG_SIMD
        for (ptrdiff_t j = 0; j < M; ++j)
            g[j] -= w[j] * (x[j] * r[j] + y[j] * r[M + j]);
    }
}

static void sight(const eg_pass *p, const double *points, double *sums)
{
    const ptrdiff_t M = p->chunk.M;
    double *r = p->work, *J = r + 2 * M;
    eg_model_of(p)->sight(M, p->cameras, points, p->q, r, J);
    square(p, r);
    eg_weigh(p);
    add_points(p, r, J, sums);
}

/* Kept of an observation: its weight, J_point (2, b), and J_camera turned. */
static void evaluate(eg_pass *p)
{
    const ptrdiff_t M = p->chunk.M;
    double *r = p->work, *J_camera = r + 2 * M;
    eg_model_of(p)->observe(M, p->cameras, p->points, p->q, r, J_camera, p->kept + M);
    if (p->bundle->loss != EG_LINEAR)
        square(p, r);
    eg_weigh(p);
    p->route->turn_cameras(p, J_camera);
}

static void observe(eg_pass *p, double *sums, double *cameras)
{
    evaluate(p);
    add_points(p, p->work, p->kept + p->chunk.M, sums);
    p->route->add_cameras(p, p->work, cameras);
}

/* In work: residuals, J_point (2, b), J_camera (2, tangent of the model). */
static void couple(const eg_pass *p, const double *roots)
{
    (void)roots;
    const ptrdiff_t M = p->chunk.M;
    double *r = p->work, *J = r + 2 * M, *J_camera = J + 2 * p->route->point * M;
    eg_model_of(p)->observe(M, p->cameras, p->points, p->q, r, J_camera, J);
    if (p->bundle->loss != EG_LINEAR)
        square(p, r);
    eg_weigh(p);
}

static void to_points(const eg_pass *p, const double *roots, ptrdiff_t count, const double *x,
                      double *v)
{
    const ptrdiff_t M = p->chunk.M, b = p->route->point, K = p->route->tangent;
    const ptrdiff_t d = eg_model_of(p)->tangent_size, step = count * M;
    const double *J = p->work + 2 * M, *J_camera = J + 2 * b * M, *EG_RESTRICT w = p->w;
    /* u = w J_camera x in the place of the residuals */
    double *EG_RESTRICT u = p->work, *EG_RESTRICT t = p->work + M;
    memset(u, 0, (size_t)(2 * M) * sizeof(double));
    for (ptrdiff_t k = 0; k < K; ++k) {
        const double *EG_RESTRICT first = J_camera + p->bundle->columns[k] * M;
        const double *EG_RESTRICT second = first + d * M, *EG_RESTRICT own = x + k * step;
        EG_SIMD
        for (ptrdiff_t j = 0; j < M; ++j)
            u[j] += first[j] * own[j], t[j] += second[j] * own[j];
    }
    for (ptrdiff_t l = 0; l < b; ++l) {
        const double *EG_RESTRICT first = J + l * M, *EG_RESTRICT second = J + (b + l) * M;
        double *EG_RESTRICT z = p->squared; /* (J^T u)_l */
        EG_SIMD
        for (ptrdiff_t j = 0; j < M; ++j)
            z[j] = w[j] * (first[j] * u[j] + second[j] * t[j]);
        for (ptrdiff_t k = 0; k < b; ++k) { /* all of T: a change of parameters is full */
            const double *EG_RESTRICT T = roots + (b * l + k) * M;
            double *EG_RESTRICT sum = v + k * step;
            EG_SIMD
            for (ptrdiff_t j = 0; j < M; ++j)
                sum[j] += T[j] * z[j];
        }
    }
}

static void to_cameras(const eg_pass *p, const double *roots, ptrdiff_t count, const double *v,
                       double *moved, double *cameras)
{
    const ptrdiff_t M = p->chunk.M, b = p->route->point, K = p->route->tangent;
    const ptrdiff_t d = eg_model_of(p)->tangent_size;
    const double *J = p->work + 2 * M, *J_camera = J + 2 * b * M, *EG_RESTRICT w = p->w;
    double *EG_RESTRICT u = p->squared;
    memset(moved, 0, (size_t)(2 * count * M) * sizeof *moved);
    for (ptrdiff_t c = 0; c < count; ++c) { /* w J_point T v */
        double *EG_RESTRICT x = moved + c * M, *EG_RESTRICT y = moved + (count + c) * M;
        for (ptrdiff_t l = 0; l < b; ++l) {
            const double *EG_RESTRICT first = J + l * M, *EG_RESTRICT second = J + (b + l) * M;
            for (ptrdiff_t k = 0; k < b; ++k) {
                const double *EG_RESTRICT T = roots + (b * l + k) * M;
                const double *EG_RESTRICT own = v + (count * k + c) * M;
                EG_SIMD
                for (ptrdiff_t j = 0; j < M; ++j)
                    u[j] = k ? u[j] + T[j] * own[j] : T[j] * own[j];
            }
            EG_SIMD
            for (ptrdiff_t j = 0; j < M; ++j)
                x[j] += w[j] * first[j] * u[j], y[j] += w[j] * second[j] * u[j];
        }
    }
    for (ptrdiff_t j = 0; j < p->filled; ++j)
        for (ptrdiff_t begin = 0; begin < count; begin += 8) {
            const ptrdiff_t some = count - begin < 8 ? count - begin : 8;
            double *EG_RESTRICT camera = cameras + count * K * p->view[j] + begin;
            double x[8], y[8];
            for (ptrdiff_t c = 0; c < some; ++c) {
                x[c] = moved[(begin + c) * M + j];
                y[c] = moved[(count + begin + c) * M + j];
            }
            for (ptrdiff_t k = 0; k < K; ++k, camera += count) {
                const double *entry = J_camera + p->bundle->columns[k] * M + j;
                for (ptrdiff_t c = 0; c < some; ++c)
                    camera[c] += entry[0] * x[c] + entry[d * M] * y[c];
            }
        }
}

static void turn(eg_pass *p, const double *roots, const double *v, double *kept,
                 const eg_envelope *envelope, eg_group *group, double *pairs, double *cameras)
{
    (void)envelope, (void)pairs;
    const ptrdiff_t M = p->chunk.M, b = p->route->point;
    const int32_t *first = group->first + group->lanes;
    eg_group_append(group, &p->chunk);
    for (ptrdiff_t s = 0; s < p->chunk.L; ++s) {
        eg_pass_slot_of(p, s, p->cameras);
        eg_pass_keep(p, s, kept);
        const double *EG_RESTRICT w = p->w, *J = p->kept + M;
        double *Z = p->work; /* w J_point T, (2, b) */
        for (ptrdiff_t i = 0; i < 2 * b; ++i) {
            double *EG_RESTRICT z = Z + i * M;
            const double *EG_RESTRICT T = roots + i % b * M, *EG_RESTRICT x = J + i / b * b * M;
            EG_SIMD
            for (ptrdiff_t j = 0; j < M; ++j)
                z[j] = x[j] * T[j];
            for (ptrdiff_t l = 1; l < b; ++l) {
                EG_SIMD
                for (ptrdiff_t j = 0; j < M; ++j)
                    z[j] += x[l * M + j] * T[l * b * M + j];
            }
            EG_SIMD
            for (ptrdiff_t j = 0; j < M; ++j)
                z[j] *= w[j];
        }
        p->route->turn_slot(p, Z, v, first, s, group, cameras);
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
    eg_route route = {
        .camera = model->camera_size,
        .point = b,
        .tangent = K,
        .padded = padded,
        .camera_sums = padded * (K + 1),
        .pair_sums = {K, padded * K, padded},
        .sums = b * (b + 1) / 2 + b,
        .turned = b * padded,
        .work = 2 + 2 * d + 2 * b,
        .kept = 1 + 2 * b + 2 * padded,
        .squared = squared,
        .sight = sight,
        .evaluate = evaluate,
        .observe = observe,
        .couple = couple,
        .to_points = to_points,
        .to_cameras = to_cameras,
        .turn = turn,
    };
    eg_direct_loops(&route);
    eg_direct_marginal(&route);
    return route;
}
