/* Lets a test call the quadratic programme, and the Riccati recursion in it, with matrices of its own: arrays without room in them. */
#include <string.h>

#include "solver.h"

typedef struct {
    double reference[N + 1][NX], normal[N + 1][2], previous_input[NU];
    double weight[NZ], last_weight[NX], difference_weight[NU];
    double lower[ROWS], upper[ROWS], linear[ROWS], quadratic;
    double z[N + 1][NZ], row_multiplier[ROWS];
    double jacobian[N][NX][NZ], hessian[N][NZ][NZ], gap[N][NX], gradient[N + 1][NZ], row_value[ROWS];
} dense_problem;

typedef struct {
    double step[N + 1][NZ], gap_multiplier[N + 1][NX], row_multiplier[ROWS], exact_share;
    double is_solved, factorizations, solutions;
} dense_answer;

static nmpc_solver solver;

static void load_problem(const dense_problem *from, problem_data *p)
{
    memcpy(p->reference, from->reference, sizeof p->reference);
    memcpy(p->normal, from->normal, sizeof p->normal);
    memcpy(p->previous_input, from->previous_input, sizeof p->previous_input);
    memcpy(p->weight, from->weight, sizeof p->weight);
    memcpy(p->last_weight, from->last_weight, sizeof p->last_weight);
    memcpy(p->difference_weight, from->difference_weight, sizeof p->difference_weight);
    p->penalty_quadratic = from->quadratic;
    for (int i = 0; i < ROW_ROOM; i++) {
        p->lower[i] = i < ROWS ? from->lower[i] : -INFINITY;
        p->upper[i] = i < ROWS ? from->upper[i] : INFINITY;
        p->penalty_linear[i] = i < ROWS ? from->linear[i] : INFINITY;
    }
}

static void load_model(const dense_problem *from, linearization *model)
{
    memset(model, 0, sizeof *model);
    for (int k = 0; k <= N; k++) {
        memcpy(model->gradient[k], from->gradient[k], sizeof from->gradient[k]);
        if (k == N) break;
        for (int i = 0; i < NX; i++) memcpy(model->jacobian[k][i], from->jacobian[k][i], sizeof from->jacobian[k][i]);
        for (int i = 0; i < NZ; i++) memcpy(model->hessian[k][i], from->hessian[k][i], sizeof from->hessian[k][i]);
        memcpy(model->gap[k], from->gap[k], sizeof from->gap[k]);
    }
    memcpy(model->row_value, from->row_value, sizeof from->row_value);
}

static void tell(dense_answer *answer, bool is_solved)
{
    memcpy(answer->step, solver.qp.step, sizeof answer->step);
    memcpy(answer->gap_multiplier, solver.kkt.gap_multiplier, sizeof answer->gap_multiplier);
    memcpy(answer->row_multiplier, solver.qp.multiplier, sizeof answer->row_multiplier);
    answer->exact_share = solver.kkt.exact_share;
    answer->is_solved = is_solved;
    answer->factorizations = solver.statistics.factorizations;
    answer->solutions = solver.statistics.qp_iterations;
}

/* Every number of the memory is NaN at the beginning. */
void qp_solve(const dense_problem *problem, dense_answer *answer)
{
    memset(&solver, 0xFF, sizeof solver);
    memset(&solver.statistics, 0, sizeof solver.statistics);
    memset(solver.current.row_multiplier, 0, sizeof solver.current.row_multiplier);
    memcpy(solver.current.z, problem->z, sizeof problem->z);
    memcpy(solver.current.row_multiplier, problem->row_multiplier, sizeof problem->row_multiplier);
    load_problem(problem, &solver.problem);
    load_model(problem, &solver.model);
    tell(answer, quadratic_program(&solver, false));
}

/* Another problem with the matrices of the last one. */
void qp_solve_again(const dense_problem *problem, dense_answer *answer)
{
    memcpy(solver.current.row_multiplier, problem->row_multiplier, sizeof problem->row_multiplier);
    load_problem(problem, &solver.problem);
    load_model(problem, &solver.model);
    memset(&solver.statistics, 0, sizeof solver.statistics);
    tell(answer, quadratic_program(&solver, true));
}
