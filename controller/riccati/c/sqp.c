/* Sequential quadratic programming with exact Hessian and full steps.
 *
 * The measured state is x_0 from the start on, so that it never moves. After a short step the gradient of the Lagrangian is computed
 * by one adjoint sweep, a third of the work of a full sweep with second derivatives. That is enough to see convergence; and where it
 * shows that the step contracted well, the old Jacobian and Hessian, with their factorization, serve for one more step on the exact
 * gaps and the exact gradient (level C of Bock, Diehl, Kostina, Schloeder: Constrained optimal feedback control, 2007).
 *
 * No line search: with one on an L1 merit function 19 of 1200 hard starts failed in the feasibility study, without it 16. Slow solves
 * are slow by an indefinite Hessian and not by divergence.
 *
 * The work is counted in Riccati factorizations, and no new iteration begins beyond WORK_LIMIT; what one iteration can add to that is
 * bounded by the caps of the quadratic programme.
 */
#include <math.h>
#include <string.h>

#include "lanes.h"
#include "solver.h"

/* The last digit is for those who compute the residuals in another order and compare with 1e-6 and 1e-4. */
#define PRIMAL_TOLERANCE 0.999e-6
#define DUAL_TOLERANCE 0.999e-4
#define MAX_ITERATIONS 20
#define MAX_REUSES 3         /* of one Jacobian and Hessian */
#define SHORT_STEP 1.0       /* largest component, m, m/s, rad */
#define CONTRACTION 0.03     /* that a step must have reached for its matrices to serve again */
#define LARGEST_STEP 1e8     /* farther is nowhere; NaN is found by the residuals */

/* In factorizations. Over 30 stages one takes 3 to 5 us with what belongs to it, and 8 to 10 us without vectors (Xeon of 2.9 GHz): a
 * solve ends within 5 ms on either. */
#define WORK_LIMIT (LANES == 1 ? 500.0 : 800.0)

typedef enum { REACHED, NOT_REACHED, NOT_FINITE } progress;

static progress judge(nmpc_solver *s)
{
    nmpc_statistics *statistics = &s->statistics;
    const bool is_finite = residuals(&s->problem, &s->current, &s->model, &statistics->primal_residual, &statistics->dual_residual);
    if (!is_finite) return NOT_FINITE;
    return statistics->primal_residual < PRIMAL_TOLERANCE && statistics->dual_residual < DUAL_TOLERANCE ? REACHED : NOT_REACHED;
}

/* The time since the last call is that of this part. */
static void account(nmpc_solver *s, nmpc_part *part)
{
    const int64_t now_ns = clock_ns();
    part->time_ns += now_ns - s->accounted_until_ns;
    part->calls++;
    s->accounted_until_ns = now_ns;
}

static progress full_sweep(nmpc_solver *s)
{
    linearize(&s->problem, &s->current, &s->model);
    s->statistics.work += WORK_DERIVATIVES;
    const progress now = judge(s);
    account(s, &s->statistics.stage_sweep);
    return now;
}

/* Leaves the gradient corrected for the Jacobian that is kept. */
static progress adjoint_sweep(nmpc_solver *s)
{
    linearize_gradient(&s->problem, &s->current, &s->model);
    s->statistics.work += WORK_ADJOINT;
    const progress now = judge(s);
    correct_gradient(&s->current, &s->model);
    account(s, &s->statistics.adjoint_sweep);
    return now;
}

/* Residuals in units of their tolerances. */
static double error(const nmpc_statistics *statistics)
{
    return fmax(statistics->primal_residual / PRIMAL_TOLERANCE, statistics->dual_residual / DUAL_TOLERANCE);
}

static double step_size(const active_set *qp)
{
    double largest = 0.0;
    for (int k = 0; k <= N; k++) {
        for (int j = 0; j < NZ; j++) {
            if (fabs(qp->step[k][j]) > largest) largest = fabs(qp->step[k][j]);
        }
    }
    return largest;
}

static void take_step(const problem_data *p, const riccati *kkt, const active_set *qp, iterate *current)
{
    for (int k = 0; k <= N; k++) {
        for (int j = 0; j < NZ; j++) current->z[k][j] += qp->step[k][j];
    }
    clip_inputs(p, current);
    memcpy(current->gap_multiplier, kkt->gap_multiplier, sizeof current->gap_multiplier);
    memcpy(current->row_multiplier, qp->multiplier, sizeof current->row_multiplier);
}

static nmpc_status iterate_until_done(nmpc_solver *s)
{
    nmpc_statistics *statistics = &s->statistics;
    progress now = full_sweep(s);
    int reuses = 0;
    for (bool is_same_hessian = false;;) {
        if (now == NOT_FINITE) return NMPC_NUMERICAL;
        s->last_finite = s->current;
        if (now == REACHED) return NMPC_CONVERGED;
        if (statistics->sqp_iterations == MAX_ITERATIONS || statistics->work > WORK_LIMIT) return NMPC_LIMIT;
        const double error_before = error(statistics);
        statistics->sqp_iterations++;
        const bool is_solved = quadratic_program(s, is_same_hessian);
        account(s, &s->statistics.qp);
        if (!is_solved) return NMPC_NUMERICAL;
        const double size = step_size(&s->qp);
        if (size > LARGEST_STEP) return NMPC_NUMERICAL;
        take_step(&s->problem, &s->kkt, &s->qp, &s->current);
        if (size < SHORT_STEP && s->kkt.exact_share == 1.0) {
            now = adjoint_sweep(s);
            is_same_hessian = now != NOT_REACHED || (reuses < MAX_REUSES && error(statistics) < CONTRACTION * error_before);
            reuses++;
            if (is_same_hessian) continue;
        }
        now = full_sweep(s);
        is_same_hessian = false;
        reuses = 0;
    }
}

/* Solve s->problem from s->current; the answer is s->last_finite, or the guess when not even that gave finite residuals. */
void sqp(nmpc_solver *s)
{
    memset(&s->statistics, 0, sizeof s->statistics);
    s->accounted_until_ns = clock_ns();
    s->last_finite = s->current;
    s->statistics.status = iterate_until_done(s);
}
