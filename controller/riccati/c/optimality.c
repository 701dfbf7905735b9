/* Karush-Kuhn-Tucker residuals of the soft-constrained problem.
 *
 * A row with value c, bounds [l, h] and multiplier m is optimal when (c, m) lies on the graph of the subdifferential of its penalty:
 * m = 0 between the bounds, m from 0 to rho1 at h, m = rho1 + rho2 (c - h) beyond it, and mirrored at l. The residual is the distance
 * to that graph: along c it counts as primal, along m as dual, whichever is smaller in units of its tolerance (1e-6 and 1e-4).
 */
#include <math.h>

#include "solver.h"

#define PRIMAL_PER_DUAL 1e-2

static bool accumulate(double *largest, double value)
{
    if (value > *largest) *largest = value;
    return isfinite(value);
}

/* Gradient of cost plus gap_multiplier' gap, with respect to each z_k; the rows are not in it. */
void lagrangian_gradient(const problem_data *p, const iterate *at, const linearization *model, double gradient[N + 1][NZ])
{
    for (int k = 0; k <= N; k++) {
        for (int j = 0; j < NZ; j++) gradient[k][j] = model->gradient[k][j] + (k < N ? model->adjoint[k][j] : 0.0);
        if (k == 0) continue; /* no gap ends in the measured state */
        for (int j = 0; j < NX; j++) gradient[k][j] -= at->gap_multiplier[k][j];
    }
    for (int k = 0; k + 1 < N; k++) { /* the difference u_k+1 - u_k, towards u_k */
        for (int j = NX; j < NZ; j++) gradient[k][j] -= 2.0 * p->difference_weight[j - NX] * (at->z[k + 1][j] - at->z[k][j]);
    }
}

static bool row_residual(const problem_data *p, int i, double value, double multiplier, double *primal, double *dual)
{
    const bool is_upper = multiplier > 0.0 || (multiplier == 0.0 && value > p->upper[i]);
    const double beyond = is_upper ? value - p->upper[i] : p->lower[i] - value;
    const double beyond_other = is_upper ? p->lower[i] - value : value - p->upper[i];
    const double size = fabs(multiplier), linear = p->penalty_linear[i], quadratic = p->penalty_quadratic;
    const double along_value = size <= linear ? fabs(beyond) : fabs(beyond - (size - linear) / quadratic);
    const double inside = p->lower[i] < p->upper[i] ? size : INFINITY; /* an equality has no inside, where its multiplier is zero */
    const double along_multiplier = beyond <= 0.0 ? inside : fabs(size - linear - quadratic * beyond);
    if (along_value < PRIMAL_PER_DUAL * along_multiplier) return accumulate(primal, along_value);
    /* A small multiplier of one bound and a value beyond the other: the nearest point is that other bound, without multiplier. */
    return accumulate(primal, fmax(beyond_other, 0.0)) && accumulate(dual, along_multiplier);
}

bool residuals(const problem_data *p, iterate *at, const linearization *model, double *primal, double *dual)
{
    bool is_finite = true;
    double gradient[N + 1][NZ];
    *primal = *dual = 0.0;
    for (int k = 0; k < N; k++) {
        for (int j = 0; j < NX; j++) is_finite &= accumulate(primal, fabs(model->gap[k][j]));
    }
    lagrangian_gradient(p, at, model, gradient);
    for (int j = 0; j < NX; j++) at->state_multiplier[j] = -gradient[0][j];
    for (int k = 0; k <= N; k++) {
        add_row_gradients(p, k, at->row_multiplier, gradient[k]);
        for (int j = k > 0 ? 0 : NX; j < NZ; j++) is_finite &= accumulate(dual, fabs(gradient[k][j]));
    }
    for (int i = 0; i < ROWS; i++) {
        const double value = model->row_value[i], multiplier = at->row_multiplier[i];
        if (multiplier == 0.0 && value >= p->lower[i] && value <= p->upper[i]) continue;
        is_finite &= row_residual(p, i, value, multiplier, primal, dual);
    }
    return is_finite;
}
