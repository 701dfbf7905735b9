/* Interface of the solver, see nmpc.h: from the vectors of the caller to the solver's problem and iterate, and back. */
#include "nmpc.h"

#include <math.h>
#include <string.h>

#include "lanes.h"
#include "solver.h"
#include "stage.h"

size_t nmpc_solver_bytes(void) { return sizeof(nmpc_solver); }
size_t nmpc_solver_alignment(void) { return _Alignof(nmpc_solver); }
int nmpc_variables(void) { return NMPC_VARIABLES; }
int nmpc_constraints(void) { return NMPC_CONSTRAINTS; }
int nmpc_parameters(void) { return NMPC_PARAMETERS; }
int nmpc_lanes(void) { return LANES; }

static const double *read(double *to, const double *from, size_t count)
{
    memcpy(to, from, count * sizeof *to);
    return from + count;
}

static void load_parameters(const double *parameters, problem_data *p)
{
    const double *rest = read(p->reference[0], parameters, (N + 1) * NX);
    p->normal[0][0] = p->normal[0][1] = 0.0;
    rest = read(p->normal[1], rest, N * 2);
    rest = read(p->previous_input, rest, NU);
    rest = read(p->weight, rest, NX);
    rest = read(p->last_weight, rest, NX);
    rest = read(&p->weight[NX], rest, NU);
    read(p->difference_weight, rest, NU);
}

/* What vectors shaped as w and as g have for each row; `none` for a row without a place in them. */
static void rows_of(const double *w, const double *g, double none, row_array rows)
{
    const double *corridor = &g[N * NX - 1]; /* [k]: of node k */
    for (int k = 0; k < N; k++) {
        double *of_stage = &rows[k * STAGE_ROWS];
        for (int i = 0; i < STAGE_BOUNDS; i++) of_stage[i] = k > 0 || i < NU ? w[k * NZ + BOUNDED_COMPONENT[i]] : none;
        of_stage[STAGE_BOUNDS] = k > 0 ? corridor[k] : none;
    }
    memcpy(&rows[LAST_ROW], &w[N * NZ], NX * sizeof *w);
    rows[LAST_ROW + NX] = corridor[N];
    for (int i = ROWS; i < ROW_ROOM; i++) rows[i] = none;
}

/* The other way; places in the vectors that belong to no row stay as they are. */
static void put_rows(const row_array rows, double *w, double *g)
{
    double *corridor = &g[N * NX - 1];
    for (int k = 0; k < N; k++) {
        const double *of_stage = &rows[k * STAGE_ROWS];
        for (int i = 0; i < (k > 0 ? STAGE_BOUNDS : NU); i++) w[k * NZ + BOUNDED_COMPONENT[i]] = of_stage[i];
        if (k > 0) corridor[k] = of_stage[STAGE_BOUNDS];
    }
    memcpy(&w[N * NZ], &rows[LAST_ROW], NX * sizeof *w);
    corridor[N] = rows[LAST_ROW + NX];
}

static void load_rows(const nmpc_problem *from, problem_data *p, iterate *guess)
{
    rows_of(from->w_lower, from->g_lower, -INFINITY, p->lower);
    rows_of(from->w_upper, from->g_upper, INFINITY, p->upper);
    rows_of(from->lam_w_guess, from->lam_g_guess, 0.0, guess->row_multiplier);
    for (int i = 0; i < ROW_ROOM; i++) {
        const double bound = guess->row_multiplier[i] > 0.0 ? p->upper[i] : p->lower[i];
        if (!isfinite(bound)) guess->row_multiplier[i] = 0.0;
        p->penalty_linear[i] = from->penalty_linear;
    }
    for (int k = 0; k < N; k++) {
        for (int j = 0; j < NU; j++) p->penalty_linear[k * STAGE_ROWS + j] = INFINITY;
    }
    p->penalty_quadratic = from->penalty_quadratic;
}

static void load_point(const double *w, const double *lam_g, iterate *point)
{
    memcpy(point->z, w, NMPC_VARIABLES * sizeof *w);
    memset(&point->z[N][NX], 0, NU * sizeof *w);
    memset(point->gap_multiplier[0], 0, NX * sizeof *lam_g);
    memcpy(point->gap_multiplier[1], lam_g, N * NX * sizeof *lam_g);
    memset(point->state_multiplier, 0, sizeof point->state_multiplier);
}

static void store_answer(const iterate *answer, double *w, double *lam_w, double *lam_g)
{
    memcpy(w, answer->z, NMPC_VARIABLES * sizeof *w);
    memcpy(lam_g, answer->gap_multiplier[1], N * NX * sizeof *lam_g);
    memset(lam_w, 0, NMPC_VARIABLES * sizeof *lam_w);
    memcpy(lam_w, answer->state_multiplier, sizeof answer->state_multiplier);
    put_rows(answer->row_multiplier, lam_w, lam_g);
}

nmpc_statistics nmpc_solve(nmpc_solver *s, const nmpc_problem *problem, double *w, double *lam_w, double *lam_g)
{
    memset(&s->model, 0, sizeof s->model); /* the sweep writes only those derivatives that can differ from zero */
    load_parameters(problem->parameters, &s->problem);
    load_point(problem->w_guess, problem->lam_g_guess, &s->current);
    load_rows(problem, &s->problem, &s->current);
    clip_inputs(&s->problem, &s->current);
    sqp(s);
    store_answer(&s->last_finite, w, lam_w, lam_g);
    return s->statistics;
}

void nmpc_evaluate(nmpc_solver *s, const double *parameters, const double *w, const double *lam_g, double *g, double *gradient)
{
    double by_stage[N + 1][NZ];
    row_array multiplier = {0};
    memset(&s->model, 0, sizeof s->model);
    load_parameters(parameters, &s->problem);
    load_point(w, lam_g, &s->current);
    linearize_gradient(&s->problem, &s->current, &s->model);
    memcpy(g, s->model.gap, N * NX * sizeof *g);
    lagrangian_gradient(&s->problem, &s->current, &s->model, by_stage);
    for (int k = 1; k <= N; k++) {
        g[N * NX + k - 1] = s->model.row_value[corridor_row(k)];
        multiplier[corridor_row(k)] = lam_g[N * NX + k - 1];
        add_row_gradients(&s->problem, k, multiplier, by_stage[k]);
    }
    memcpy(gradient, by_stage, NMPC_VARIABLES * sizeof *gradient);
}

void nmpc_advance(const double *x, const double *u, double duration_s, double *x_after)
{
    lanes x_lanes[NX], u_lanes[NU], after[NX];
    for (int j = 0; j < NX; j++) x_lanes[j] = lanes_of(x[j]);
    for (int j = 0; j < NU; j++) u_lanes[j] = lanes_of(u[j]);
    stage_advance(x_lanes, u_lanes, lanes_of(duration_s), after);
    for (int j = 0; j < NX; j++) x_after[j] = ((const double *)after)[j * LANES];
}

void nmpc_run_stage_sweep(nmpc_solver *s) { linearize(&s->problem, &s->current, &s->model); }
void nmpc_run_adjoint_sweep(nmpc_solver *s) { linearize_gradient(&s->problem, &s->current, &s->model); }

void nmpc_run_riccati(nmpc_solver *s)
{
    riccati_factorize(&s->problem, &s->model, N, &s->kkt);
    riccati_solve(&s->problem, &s->current, &s->model, N, &s->kkt);
}
