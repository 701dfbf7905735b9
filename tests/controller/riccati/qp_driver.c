/* Lets a test call the quadratic programme, and the Riccati recursion in it, with matrices of its own. */
#include <string.h>

#include "solver.h"

static nmpc_solver solver;

int qp_solve(const problem_data *problem, const iterate *at, const linearization *model, double *step, double *gap_multiplier,
             double *row_multiplier, double *exact_share)
{
    solver.problem = *problem;
    solver.current = *at;
    solver.model = *model;
    memset(&solver.statistics, 0, sizeof solver.statistics);
    const int is_solved = quadratic_program(&solver, false);
    memcpy(step, solver.qp.step, sizeof solver.qp.step);
    memcpy(gap_multiplier, solver.kkt.gap_multiplier, sizeof solver.kkt.gap_multiplier);
    memcpy(row_multiplier, solver.qp.multiplier, sizeof solver.qp.multiplier);
    *exact_share = solver.kkt.exact_share;
    return is_solved;
}
