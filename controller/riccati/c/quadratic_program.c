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
 *
 * On one set of pieces e := m is a linear fixed-point iteration, slow where a combination of active rows is nearly out of reach of the
 * inputs, as those of a corridor whose edge the car follows. Where it is slow, the weight grows (Bertsekas, chapter 2).
 */
#include <math.h>
#include <string.h>

#include "lanes.h"
#include "solver.h"

#define FIRST_WEIGHT 1e5       /* lower ones need more estimates, higher ones more Newton steps */
#define LARGEST_WEIGHT 1e7     /* beyond, rounding shows in the multipliers */
#define WEIGHT_GROWTH 10.0
#define GOOD_DECREASE 0.25     /* of the violation with one estimate; with less the weight grows */
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
#define NO_SLOPE 1e-12

static double larger(double a, double b) { return a > b ? a : b; }

/* How m grows with zeta where the violation pays. */
static double paying_share(const problem_data *p, const active_set *qp)
{
    return p->penalty_quadratic / (qp->weight + p->penalty_quadratic);
}

/* m of row i at a value. */
static double multiplier_at(const problem_data *p, const active_set *qp, int i, double value)
{
    const double from_upper = qp->estimate[i] + qp->weight * (value - p->upper[i]);
    const double from_lower = qp->estimate[i] + qp->weight * (value - p->lower[i]);
    const double zeta = from_upper > 0.0 ? from_upper : from_lower < 0.0 ? from_lower : 0.0;
    const double excess = fabs(zeta) - p->penalty_linear[i];
    return excess > 0.0 ? zeta - copysign((1.0 - paying_share(p, qp)) * excess, zeta) : zeta;
}

#define AT(array, i) (*(lanes *)&(array)[i])
#define FROM(array, i) (*(const lanes *)&(array)[i])

/* Multipliers of all rows at their values, and the pieces of m that they lie on. */
static void find_pieces(const problem_data *p, const row_array row_value, active_set *qp)
{
    const double share = paying_share(p, qp), w = qp->weight;
    const lanes zero = lanes_of(0.0), weight = lanes_of(w), paying_weight = lanes_of(w * share);
    for (int i = 0; i < ROW_ROOM; i += LANES) {
        const lanes e = AT(qp->estimate, i), value = AT(qp->value, i), lower = FROM(p->lower, i), upper = FROM(p->upper, i);
        const lanes from_upper = e + w * (value - upper), from_lower = e + w * (value - lower);
        const lane_bits is_upper = from_upper > 0.0, is_active = is_upper | (from_lower < 0.0);
        const lanes bound = lanes_select(is_upper, upper, lower), zeta = lanes_select(is_upper, from_upper, from_lower);
        const lanes zeta_there = e + w * (FROM(row_value, i) - bound);
        const lanes linear = FROM(p->penalty_linear, i), limit = lanes_select(is_upper, linear, -linear);
        const lane_bits pays = lanes_abs(zeta) > linear;
        const lanes multiplier = lanes_select(pays, limit + share * (zeta - limit), zeta);
        const lanes intercept = lanes_select(pays, limit + share * (zeta_there - limit), zeta_there);
        AT(qp->multiplier, i) = lanes_select(is_active, multiplier, zero);
        AT(qp->intercept, i) = lanes_select(is_active, intercept, zero);
        AT(qp->slope, i) = lanes_select(is_active, lanes_select(pays, paying_weight, weight), zero);
    }
}

/* Pieces from the multipliers of the iterate: active rows stand on their bound, or as far beyond it as their multiplier says. */
static void start(const problem_data *p, const iterate *at, const row_array row_value, active_set *qp)
{
    const lanes zero = lanes_of(0.0);
    for (int i = 0; i < ROW_ROOM; i += LANES) {
        const lanes multiplier = FROM(at->row_multiplier, i), lower = FROM(p->lower, i), upper = FROM(p->upper, i);
        const lanes excess = lanes_abs(multiplier) - FROM(p->penalty_linear, i), value = FROM(row_value, i);
        const lanes violation = lanes_select(excess > 0.0, excess * (1.0 / p->penalty_quadratic), zero);
        const lanes inside = lanes_select(value > upper, upper, lanes_select(value < lower, lower, value));
        const lanes beyond = lanes_select(multiplier > 0.0, upper + violation, lower - violation);
        const lane_bits is_active = lanes_abs(multiplier) > ACTIVE_MULTIPLIER;
        AT(qp->estimate, i) = lanes_select(is_active, multiplier, zero);
        AT(qp->value, i) = lanes_select(is_active, beyond, inside);
    }
    find_pieces(p, row_value, qp);
    qp->violation = INFINITY;
}

/* Last stage at which two arrays of rows differ; -1 when they are the same. */
static int last_difference(const row_array a, const row_array b)
{
    int i = ROWS - 1;
    while (i >= 0 && a[i] == b[i]) i--;
    return i < 0 ? -1 : stage_of_row(i);
}

/* With as much of the exact Hessian as has a descent at every pivot; false when even Gauss-Newton has none. Stages above `last` are
 * as they were; returns in `last` from where they are new. */
static bool factorize(nmpc_solver *s, int *last)
{
    memcpy(s->kkt.row_weight, s->qp.slope, sizeof s->kkt.row_weight);
    for (;;) {
        s->statistics.factorizations++;
        s->statistics.work += WORK_FACTORIZATION * (*last + 1) / (N + 1);
        if (riccati_factorize(&s->problem, &s->model, *last, &s->kkt)) return true;
        if (s->kkt.exact_share <= 0.0) return false;
        s->kkt.exact_share -= SHARE_STEP;
        *last = N;
    }
}

/* The minimum on the present pieces into s->kkt; the change of the rows' values towards it, and those values. False when no Hessian
 * has a descent. With `is_new` nothing of the factorization and the solution before is of use, with `is_new_solution` that alone. */
static bool newton_point(nmpc_solver *s, bool is_new_factor, bool is_new_solution)
{
    active_set *qp = &s->qp;
    riccati *kkt = &s->kkt;
    int last = is_new_factor ? N : last_difference(qp->slope, kkt->row_weight);
    if (last >= 0 && !factorize(s, &last)) return false;
    const int last_gradient = is_new_solution ? N : last_difference(qp->intercept, kkt->row_gradient);
    if (last_gradient > last) last = last_gradient;
    memcpy(kkt->row_gradient, qp->intercept, sizeof kkt->row_gradient);
    riccati_solve(&s->problem, &s->current, &s->model, last, kkt);
    s->statistics.qp_iterations++;
    s->statistics.work += WORK_SOLUTION;
    row_array product;
    row_products(&s->problem, kkt->step, product);
    for (int i = 0; i < ROW_ROOM; i++) {
        const double value = s->model.row_value[i] + product[i];
        qp->change[i] = value - qp->value[i];
        qp->value[i] = value;
    }
    return true;
}

/* Rows that have a multiplier at the value reached, an estimate of one, or were foretold one; and what was foretold. */
static void find_engaged(const riccati *kkt, const row_array row_value, active_set *qp)
{
    qp->n_engaged = 0;
    for (int first = 0; first < ROW_ROOM; first += LANES) {
        const lanes weight = FROM(kkt->row_weight, first);
        const lanes is_idle = lanes_abs(AT(qp->multiplier, first)) + lanes_abs(AT(qp->estimate, first)) + weight;
        if (lanes_largest(is_idle) == 0.0) continue;
        AT(qp->foretold, first) = FROM(kkt->row_gradient, first) + weight * (AT(qp->value, first) - FROM(row_value, first));
        for (int i = first; i < first + LANES; i++) qp->engaged[qp->n_engaged++] = i;
    }
}

/* d' H d of the quadratic programme without its rows, for d from the point reached before to the new one. */
static double curvature_along(const problem_data *p, const linearization *model, const riccati *kkt, const active_set *qp)
{
    double sum = 0.0, previous[NU] = {0};
    for (int k = 0; k <= N; k++) {
        double d[NZ], product[NZ] = {0};
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
            for (int j = 0; j < NZ; j++) product[j] += model->hessian[k][i][j] * d[i];
        }
        for (int j = 0; j < NZ; j++) sum += kkt->exact_share * product[j] * d[j];
    }
    return sum;
}

/* Derivative of the augmented Lagrangian along the way to the Newton point, at a fraction of it. It would vanish at 1, were m what was
 * foretold; `curvature` is that of the rest. */
static double derivative_along(const problem_data *p, const active_set *qp, double curvature, double fraction)
{
    double sum = (fraction - 1.0) * curvature;
    for (int n = 0; n < qp->n_engaged; n++) {
        const int i = qp->engaged[n];
        const double value = qp->value[i] - (1.0 - fraction) * qp->change[i];
        sum += (multiplier_at(p, qp, i, value) - qp->foretold[i]) * qp->change[i];
    }
    return sum;
}

/* Fraction of the way to the Newton point at which the augmented Lagrangian is smallest. */
static double exact_line_search(const nmpc_solver *s)
{
    const active_set *qp = &s->qp;
    double at_high = derivative_along(&s->problem, qp, 0.0, 1.0);
    if (at_high <= NO_SLOPE) return 1.0;
    const double curvature = curvature_along(&s->problem, &s->model, &s->kkt, qp);
    double at_low = derivative_along(&s->problem, qp, curvature, 0.0), low = 0.0, high = 1.0, fraction = 1.0;
    const double scale = fabs(at_low);
    if (at_high <= LINE_SEARCH_START * scale || at_low >= 0.0) return 1.0;
    for (int i = 0; i < LINE_SEARCH_STEPS; i++) {
        const bool is_bisection = i > 1 && i % 2 == 1;
        fraction = is_bisection ? 0.5 * (low + high) : (low * at_high - high * at_low) / (at_high - at_low);
        const double slope = derivative_along(&s->problem, qp, curvature, fraction);
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

/* Go a fraction of the way. */
static void move(const nmpc_solver *s, double fraction, active_set *qp)
{
    if (fraction == 1.0) {
        memcpy(qp->step, s->kkt.step, sizeof qp->step);
        return;
    }
    for (int k = 0; k <= N; k++) {
        for (int j = 0; j < NZ; j++) qp->step[k][j] += fraction * (s->kkt.step[k][j] - qp->step[k][j]);
    }
    for (int i = 0; i < ROW_ROOM; i++) qp->value[i] -= (1.0 - fraction) * qp->change[i];
    find_pieces(&s->problem, s->model.row_value, qp);
}

static bool is_foretold(const active_set *qp)
{
    double largest = 0.0;
    for (int n = 0; n < qp->n_engaged; n++) {
        const int i = qp->engaged[n];
        largest = larger(largest, fabs(qp->multiplier[i] - qp->foretold[i]));
    }
    return largest < SAME_MULTIPLIER;
}

/* By how much the active rows miss their bounds, as the change of their multipliers tells. */
static double largest_violation(const active_set *qp)
{
    double largest = 0.0;
    for (int n = 0; n < qp->n_engaged; n++) {
        const int i = qp->engaged[n];
        largest = larger(largest, fabs(qp->multiplier[i] - qp->estimate[i]));
    }
    return largest / qp->weight;
}

/* e := m, and a larger weight from now on where the violation has not become much smaller. */
static void update_estimates(const problem_data *p, const row_array row_value, double violation, active_set *qp)
{
    memcpy(qp->estimate, qp->multiplier, sizeof qp->estimate);
    if (violation > GOOD_DECREASE * qp->violation && qp->weight < LARGEST_WEIGHT) qp->weight *= WEIGHT_GROWTH;
    qp->violation = violation;
    find_pieces(p, row_value, qp);
}

/* Step and row multipliers into s->qp, gap multipliers into s->kkt. When a cap is met first: the point reached until then. */
bool quadratic_program(nmpc_solver *s, bool is_same_hessian)
{
    active_set *qp = &s->qp;
    const int last_factorization = s->statistics.factorizations + MAX_FACTORIZATIONS;
    if (!is_same_hessian) {
        s->kkt.exact_share = 1.0;
        qp->weight = FIRST_WEIGHT;
    }
    start(&s->problem, &s->current, s->model.row_value, qp);
    int estimates = 0;
    for (int i = 0; i < MAX_SOLUTIONS && s->statistics.factorizations < last_factorization; i++) {
        if (!newton_point(s, i == 0 && !is_same_hessian, i == 0)) return false;
        find_pieces(&s->problem, s->model.row_value, qp);
        find_engaged(&s->kkt, s->model.row_value, qp);
        const double fraction = i == 0 ? 1.0 : exact_line_search(s);
        const bool is_minimum = fraction == 1.0 && is_foretold(qp);
        move(s, fraction, qp);
        if (!is_minimum) continue;
        const double violation = largest_violation(qp);
        if (violation < LARGEST_VIOLATION || ++estimates == MAX_ESTIMATES) break;
        update_estimates(&s->problem, s->model.row_value, violation, qp);
    }
    riccati_gap_multipliers(&s->kkt);
    return true;
}
