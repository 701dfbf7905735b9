/* Interface of the solver, see nmpc.h: from the vectors of the caller to the solver's problem and iterate, and back. */
#include "nmpc.h"

#include <math.h>
#include <string.h>

#include "lanes.h"
#include "solver.h"
#include "stage_functions.h"

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

/* Row i is variable `variable`, or row `constraint` of g, whichever is not negative; row_places lists both for all rows. */
static void row_places(int variable[ROWS], int constraint[ROWS])
{
    for (int k = 0; k < N; k++) {
        for (int j = 0; j < STAGE_BOUNDS; j++) {
            variable[k * STAGE_ROWS + j] = k == 0 && j >= NU ? -1 : k * NZ + BOUNDED_COMPONENT[j];
            constraint[k * STAGE_ROWS + j] = -1;
        }
        variable[k * STAGE_ROWS + STAGE_BOUNDS] = -1;
        constraint[k * STAGE_ROWS + STAGE_BOUNDS] = k == 0 ? -1 : N * NX + k - 1;
    }
    for (int j = 0; j < NX; j++) {
        variable[LAST_ROW + j] = N * NZ + j;
        constraint[LAST_ROW + j] = -1;
    }
    variable[LAST_ROW + NX] = -1;
    constraint[LAST_ROW + NX] = N * NX + N - 1;
}

static bool is_hard(int row) { return row < LAST_ROW && row % STAGE_ROWS < NU; }

static void load_rows(const nmpc_problem *from, problem_data *p, iterate *guess)
{
    int variable[ROWS], constraint[ROWS];
    row_places(variable, constraint);
    for (int i = 0; i < ROWS; i++) {
        const int v = variable[i], c = constraint[i];
        p->lower[i] = v >= 0 ? from->w_lower[v] : c >= 0 ? from->g_lower[c] : -INFINITY;
        p->upper[i] = v >= 0 ? from->w_upper[v] : c >= 0 ? from->g_upper[c] : INFINITY;
        const double multiplier = v >= 0 ? from->lam_w_guess[v] : c >= 0 ? from->lam_g_guess[c] : 0.0;
        const double bound = multiplier > 0.0 ? p->upper[i] : p->lower[i];
        guess->row_multiplier[i] = isfinite(bound) ? multiplier : 0.0;
        p->penalty_linear[i] = is_hard(i) ? INFINITY : from->penalty_linear;
        p->penalty_quadratic[i] = is_hard(i) ? 0.0 : from->penalty_quadratic;
    }
}

static void load_point(const double *w, const double *lam_g, iterate *point)
{
    memset(point, 0, sizeof *point);
    memcpy(point->z, w, NMPC_VARIABLES * sizeof *w);
    memcpy(point->gap_multiplier[1], lam_g, N * NX * sizeof *lam_g);
}

static void clip_inputs(const problem_data *p, iterate *point)
{
    for (int k = 0; k < N; k++) {
        for (int j = 0; j < NU; j++) {
            const int row = k * STAGE_ROWS + j;
            point->z[k][NX + j] = fmin(fmax(point->z[k][NX + j], p->lower[row]), p->upper[row]);
        }
    }
}

static void store(const nmpc_solver *s, double *w, double *lam_w, double *lam_g)
{
    int variable[ROWS], constraint[ROWS];
    row_places(variable, constraint);
    memcpy(w, s->last_finite.z, NMPC_VARIABLES * sizeof *w);
    memcpy(lam_g, s->last_finite.gap_multiplier[1], N * NX * sizeof *lam_g);
    memset(lam_w, 0, NMPC_VARIABLES * sizeof *lam_w);
    memcpy(lam_w, s->last_finite.state_multiplier, sizeof s->last_finite.state_multiplier);
    for (int i = 0; i < ROWS; i++) {
        if (variable[i] >= 0) lam_w[variable[i]] = s->last_finite.row_multiplier[i];
        if (constraint[i] >= 0) lam_g[constraint[i]] = s->last_finite.row_multiplier[i];
    }
}

nmpc_statistics nmpc_solve(nmpc_solver *s, const nmpc_problem *problem, double *w, double *lam_w, double *lam_g)
{
    memset(&s->model, 0, sizeof s->model); /* the sweep writes only those derivatives that can differ from zero */
    load_parameters(problem->parameters, &s->problem);
    load_point(problem->w_guess, problem->lam_g_guess, &s->current);
    load_rows(problem, &s->problem, &s->current);
    clip_inputs(&s->problem, &s->current);
    sqp(s);
    store(s, w, lam_w, lam_g);
    return s->statistics;
}

void nmpc_evaluate(nmpc_solver *s, const double *parameters, const double *w, const double *lam_g, double *g, double *gradient)
{
    double by_stage[N + 1][NZ], rows[ROWS] = {0};
    int variable[ROWS], constraint[ROWS];
    row_places(variable, constraint);
    load_parameters(parameters, &s->problem);
    load_point(w, lam_g, &s->current);
    linearize_gradient(&s->problem, &s->current, &s->model);
    memcpy(g, s->model.gap, N * NX * sizeof *g);
    for (int i = 0; i < ROWS; i++) {
        if (constraint[i] < 0) continue;
        g[constraint[i]] = s->model.row_value[i];
        rows[i] = lam_g[constraint[i]];
    }
    lagrangian_gradient(&s->problem, &s->current, &s->model, by_stage);
    for (int k = 1; k <= N; k++) add_row_gradients(&s->problem, k, rows, by_stage[k]);
    memcpy(gradient, by_stage, NMPC_VARIABLES * sizeof *gradient);
}

void nmpc_advance(const double *x, const double *u, double duration_s, double *x_after)
{
    lanes x_lanes[NX], u_lanes[NU], duration = lanes_of(duration_s), after[NX];
    for (int j = 0; j < NX; j++) x_lanes[j] = lanes_of(x[j]);
    for (int j = 0; j < NU; j++) u_lanes[j] = lanes_of(u[j]);
    advance(x_lanes, u_lanes, &duration, after);
    for (int j = 0; j < NX; j++) x_after[j] = ((const double *)after)[j * LANES];
}
