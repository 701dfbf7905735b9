/* Quadratic programme of one SQP iteration: active-set method on the augmented Lagrangian.
 *
 * For a row with value c, bounds [l, h], penalty (rho1, rho2) and estimate e of its multiplier, the multiplier of the augmented
 * Lagrangian with weight w, its slack eliminated, is a piecewise linear function of c:
 *
 *   zeta = e + w (c - h) if that is positive, e + w (c - l) if that is negative, else 0
 *   m(c) = zeta,  or beyond rho1 (the violation pays):  sign(zeta) (rho1 + (|zeta| - rho1) rho2 / (w + rho2))
 *
 * So minimising over the step is a piecewise quadratic problem. Semismooth Newton: on the present pieces one Riccati solution, which
 * needs a new factorization only where a slope of m changed; then an exact line search, without which the set of active rows can
 * cycle. When the pieces foretold m and the step was full, the minimum is found, and e := m; when e stays, the programme is solved.
 * (Bertsekas, Constrained Optimization and Lagrange Multiplier Methods, chapters 2 and 5; Qi and Sun, A nonsmooth version of
 * Newton's method, 1993.)
 */
#include <math.h>
#include <string.h>

#include "solver.h"

#define WEIGHT 1e5             /* lower ones need more estimates, higher ones gain nothing */
#define ACTIVE_MULTIPLIER 1e-7 /* multipliers of the warm start below this are zero */
#define SAME_MULTIPLIER 1e-6   /* a hundredth of the dual tolerance */
#define LARGEST_VIOLATION 1e-8 /* a hundredth of the primal tolerance */
#define MAX_ESTIMATES 10       /* two are usual; the next SQP iteration goes on from the last */
#define MAX_FACTORIZATIONS 30
#define MAX_SOLUTIONS 90
#define SHARE_STEP 0.25        /* of the exact Hessian, given up when a pivot has no descent */

#define LINE_SEARCH_START 0.1  /* search only when the slope at the full step is positive and above this part of that at zero */
#define LINE_SEARCH_END 0.05
#define LINE_SEARCH_STEPS 12
#define SMALLEST_FRACTION 1e-4

/* m(c) of a row, and its slope. */
static double penalty_multiplier(const problem_data *p, int i, double estimate, double value, double *slope)
{
    const double from_upper = estimate + WEIGHT * (value - p->upper[i]), from_lower = estimate + WEIGHT * (value - p->lower[i]);
    const double zeta = from_upper > 0.0 ? from_upper : from_lower < 0.0 ? from_lower : 0.0;
    const double excess = fabs(zeta) - p->penalty_linear[i];
    if (excess > 0.0) {
        const double share = p->penalty_quadratic[i] / (WEIGHT + p->penalty_quadratic[i]);
        *slope = WEIGHT * share;
        return zeta - copysign((1.0 - share) * excess, zeta);
    }
    *slope = zeta != 0.0 ? WEIGHT : 0.0;
    return zeta;
}

/* Pieces from the multipliers of the iterate: active rows stand on their bound, or as far beyond it as their multiplier says. */
static void start(const problem_data *p, const iterate *at, const linearization *model, active_set *qp)
{
    memset(qp->step, 0, sizeof qp->step);
    for (int i = 0; i < ROWS; i++) {
        const double multiplier = at->row_multiplier[i], excess = fabs(multiplier) - p->penalty_linear[i];
        if (fabs(multiplier) <= ACTIVE_MULTIPLIER) {
            qp->row_target[i] = model->row_value[i];
            qp->estimate[i] = qp->multiplier[i] = qp->slope[i] = 0.0;
            continue;
        }
        const double beyond = excess > 0.0 ? copysign(excess / p->penalty_quadratic[i], multiplier) : 0.0;
        qp->row_target[i] = (multiplier > 0.0 ? p->upper[i] : p->lower[i]) + beyond;
        qp->estimate[i] = multiplier;
        qp->multiplier[i] = penalty_multiplier(p, i, multiplier, qp->row_target[i], &qp->slope[i]);
    }
}

/* With as much of the exact Hessian as has a descent at every pivot; false when even Gauss-Newton has none. */
static bool factorize(nmpc_solver *s)
{
    for (;;) {
        s->statistics.factorizations++;
        s->statistics.work += WORK_FACTORIZATION;
        if (riccati_factorize(&s->problem, &s->model, &s->kkt)) return true;
        if (s->kkt.exact_share <= 0.0) return false;
        s->kkt.exact_share -= SHARE_STEP;
    }
}

/* d' H d of the quadratic programme without its rows, for d from the point reached to the new solution. */
static double curvature_along(const problem_data *p, const linearization *model, const riccati *kkt, const active_set *qp)
{
    double sum = 0.0, previous[NU] = {0};
    for (int k = 0; k <= N; k++) {
        double d[NZ];
        for (int j = 0; j < NZ; j++) d[j] = kkt->step[k][j] - qp->step[k][j];
        const double *weight = k < N ? p->weight : p->last_weight;
        for (int j = 0; j < (k < N ? NZ : NX); j++) sum += 2.0 * weight[j] * d[j] * d[j];
        if (k == N) break;
        for (int j = 0; j < NU; j++) {
            const double difference = d[NX + j] - previous[j];
            sum += 2.0 * p->difference_weight[j] * difference * difference;
            previous[j] = d[NX + j];
        }
        for (int i = 0; i < NZ; i++) {
            double product = 0.0;
            for (int j = 0; j < NZ; j++) product += model->hessian[k][i][j] * d[j];
            sum += kkt->exact_share * product * d[i];
        }
    }
    return sum;
}

/* Sum of m(c) times the change of c along the line, at a fraction of it. */
static double row_slope_along(const problem_data *p, const active_set *qp, double fraction)
{
    double sum = 0.0, slope;
    for (int i = 0; i < ROWS; i++) {
        const double value = qp->row_target[i] + fraction * qp->row_change[i];
        sum += penalty_multiplier(p, i, qp->estimate[i], value, &slope) * qp->row_change[i];
    }
    return sum;
}

/* Fraction of the way to the Newton point at which the augmented Lagrangian is smallest; its derivative along the way is
 * constant + fraction * curvature + row_slope_along(fraction), and would vanish at 1 if the pieces stayed the same. */
static double exact_line_search(const nmpc_solver *s)
{
    const active_set *qp = &s->qp;
    const double curvature = curvature_along(&s->problem, &s->model, &s->kkt, qp);
    double constant = -curvature;
    for (int i = 0; i < ROWS; i++) constant -= (qp->multiplier[i] + qp->slope[i] * qp->row_change[i]) * qp->row_change[i];
    double low = 0.0, high = 1.0;
    double at_low = constant + row_slope_along(&s->problem, qp, low);
    double at_high = constant + curvature + row_slope_along(&s->problem, qp, high);
    const double scale = fabs(at_low);
    if (at_high <= LINE_SEARCH_START * scale + 1e-12 || at_low >= 0.0) return 1.0;
    double fraction = high;
    for (int i = 0; i < LINE_SEARCH_STEPS; i++) {
        const bool is_bisection = i > 1 && i % 2 == 1;
        fraction = is_bisection ? 0.5 * (low + high) : (low * at_high - high * at_low) / (at_high - at_low);
        const double slope = constant + fraction * curvature + row_slope_along(&s->problem, qp, fraction);
        if (fabs(slope) < LINE_SEARCH_END * scale) break;
        if (slope > 0.0) {
            high = fraction;
            at_high = slope;
        } else {
            low = fraction;
            at_low = slope;
        }
    }
    return fmax(fraction, SMALLEST_FRACTION);
}

static void move(const nmpc_solver *s, double fraction, active_set *qp)
{
    for (int k = 0; k <= N; k++) {
        for (int j = 0; j < NZ; j++) qp->step[k][j] = (1.0 - fraction) * qp->step[k][j] + fraction * s->kkt.step[k][j];
    }
    for (int i = 0; i < ROWS; i++) {
        const double change = fraction * qp->row_change[i];
        qp->row_target[i] += change;
        qp->predicted[i] = qp->multiplier[i] + qp->slope[i] * change;
    }
}

/* Multipliers and slopes at the point reached; whether they are what the pieces foretold. */
static bool update_multipliers(const problem_data *p, active_set *qp)
{
    double largest = 0.0;
    for (int i = 0; i < ROWS; i++) {
        qp->multiplier[i] = penalty_multiplier(p, i, qp->estimate[i], qp->row_target[i], &qp->slope[i]);
        largest = fmax(largest, fabs(qp->multiplier[i] - qp->predicted[i]));
    }
    return largest < SAME_MULTIPLIER;
}

/* By how much the active rows miss their bounds, as the change of their multipliers tells. */
static double largest_violation(const active_set *qp)
{
    double largest = 0.0;
    for (int i = 0; i < ROWS; i++) largest = fmax(largest, fabs(qp->multiplier[i] - qp->estimate[i]) / WEIGHT);
    return largest;
}

static void update_estimates(const problem_data *p, active_set *qp)
{
    memcpy(qp->estimate, qp->multiplier, sizeof qp->estimate);
    for (int i = 0; i < ROWS; i++) qp->multiplier[i] = penalty_multiplier(p, i, qp->estimate[i], qp->row_target[i], &qp->slope[i]);
}

static void newton_point(nmpc_solver *s)
{
    active_set *qp = &s->qp;
    for (int i = 0; i < ROWS; i++) {
        s->kkt.row_gradient[i] = qp->multiplier[i] + qp->slope[i] * (s->model.row_value[i] - qp->row_target[i]);
    }
    riccati_solve(&s->problem, &s->current, &s->model, &s->kkt);
    s->statistics.qp_iterations++;
    s->statistics.work += WORK_SOLUTION;
    row_products(&s->problem, s->kkt.step, qp->row_change);
    for (int i = 0; i < ROWS; i++) qp->row_change[i] += s->model.row_value[i] - qp->row_target[i];
}

/* Step and row multipliers into s->qp, gap multipliers into s->kkt. When a cap is met first: the point reached until then. */
bool quadratic_program(nmpc_solver *s, bool is_same_hessian)
{
    active_set *qp = &s->qp;
    const int last_factorization = s->statistics.factorizations + MAX_FACTORIZATIONS;
    if (!is_same_hessian) {
        s->kkt.exact_share = 1.0;
        qp->has_factor = false;
    }
    start(&s->problem, &s->current, &s->model, qp);
    int estimates = 0;
    for (int i = 0; i < MAX_SOLUTIONS; i++) {
        if (!qp->has_factor || memcmp(s->kkt.row_weight, qp->slope, sizeof qp->slope) != 0) {
            if (s->statistics.factorizations >= last_factorization) break;
            memcpy(s->kkt.row_weight, qp->slope, sizeof qp->slope);
            if (!factorize(s)) return false;
            qp->has_factor = true;
        }
        newton_point(s);
        const double fraction = i == 0 ? 1.0 : exact_line_search(s);
        move(s, fraction, qp);
        const bool is_foretold = update_multipliers(&s->problem, qp);
        if (!is_foretold || fraction < 1.0) continue;
        if (largest_violation(qp) < LARGEST_VIOLATION || ++estimates == MAX_ESTIMATES) break;
        update_estimates(&s->problem, qp);
    }
    return true;
}
