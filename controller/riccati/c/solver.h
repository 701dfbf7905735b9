/* What the files of the solver share. Who calls whom: nmpc.c -> sqp.c -> quadratic_program.c -> riccati.c, and
 * sqp.c -> linearization.c -> generated stage functions. */
#pragma once

#include <stdbool.h>

#include "nmpc.h"

enum {
    N = HORIZON_STEPS,
    NX = N_STATES,
    NU = N_INPUTS,
    NZ = NX + NU,
    /* Inequality rows: for each of the stages 0 to N-1 delta, t_r, v_x, v_y, omega, corridor; then the whole state and the corridor of
     * the last. Stage 0 has bounds on its input alone; its other rows are there with infinite bounds. */
    STAGE_ROWS = 6,
    STAGE_BOUNDS = 5,
    LAST_ROW = N * STAGE_ROWS,
    ROWS = LAST_ROW + NX + 1,
};
_Static_assert(NX == 6 && NU == 2, "rows and Riccati recursion are written for the state and the input of a car");

static const int BOUNDED_COMPONENT[STAGE_BOUNDS] = {6, 7, 0, 1, 2};
enum { X = 3, Y = 4 };

typedef struct {
    double z[N + 1][NZ];            /* stages; the last has no input, and zeros there */
    double gap_multiplier[N + 1][NX]; /* [k]: of the gap that ends in x_k; the first is unused */
    double row_multiplier[ROWS];    /* positive at the upper bound */
    double state_multiplier[NX];    /* of the bounds that hold the measured state: what balances the gradient there */
} iterate;

/* The data of one problem. */
typedef struct {
    double reference[N + 1][NX], normal[N + 1][2], previous_input[NU];
    double weight[NZ], last_weight[NX], difference_weight[NU]; /* diagonals of (Q, R), Q_N, S */
    double lower[ROWS], upper[ROWS];
    double penalty_linear[ROWS], penalty_quadratic[ROWS]; /* hard: infinite and zero */
} problem_data;

/* The problem around an iterate. */
typedef struct {
    double jacobian[N][NX][NZ];
    double hessian[N][NZ][NZ];         /* of the dynamics, weighted with their multipliers; the cost is not in it */
    double gap[N][NX];
    double gradient[N + 1][NZ];        /* of the cost; that of the input difference towards u_k alone, not towards u_k-1; the last
                                        * stage has no input, and zeros there */
    double adjoint[N][NZ];             /* Jacobian' times gap multiplier */
    double row_value[ROWS];
} linearization;

/* Factorization and solution of the equality-constrained quadratic programme, see riccati.c. */
typedef struct {
    double value_hessian[N + 1][NZ][NZ], value_gradient[N + 1][NZ];
    double feedback[N][NU][NZ], feedforward[N][NU], inverse_pivot[N][3];
    double row_weight[ROWS], row_gradient[ROWS]; /* curvature and gradient that the rows add */
    double exact_share;                          /* 1: exact Hessian, 0: Gauss-Newton */
    double step[N + 1][NZ], gap_multiplier[N + 1][NX];
} riccati;

/* State of the active-set method, see quadratic_program.c. */
typedef struct {
    bool has_factor;
    double estimate[ROWS];   /* multipliers of the augmented Lagrangian */
    double multiplier[ROWS], slope[ROWS], predicted[ROWS]; /* of the penalty function at row_target, and what the model foretold */
    double row_target[ROWS]; /* row values at the point reached */
    double row_change[ROWS];
    double step[N + 1][NZ];  /* the point reached */
} active_set;

struct nmpc_solver {
    problem_data problem;
    iterate current, last_finite;
    linearization model;
    riccati kkt;
    active_set qp;
    nmpc_statistics statistics;
};

/* linearization.c */
void linearize(const problem_data *problem, const iterate *at, linearization *model);
void linearize_gradient(const problem_data *problem, const iterate *at, linearization *model);

/* rows.c */
void row_values(const problem_data *problem, const iterate *at, double value[ROWS]);
void row_products(const problem_data *problem, const double z[N + 1][NZ], double product[ROWS]);
void add_row_gradients(const problem_data *problem, int k, const double row[ROWS], double gradient[NZ]);

/* optimality.c: false when a number is not finite; sets the state's multiplier. */
bool residuals(const problem_data *problem, iterate *at, const linearization *model, double *primal, double *dual);
void lagrangian_gradient(const problem_data *problem, const iterate *at, const linearization *model, double gradient[N + 1][NZ]);

/* riccati.c */
bool riccati_factorize(const problem_data *problem, const linearization *model, riccati *kkt);
void riccati_solve(const problem_data *problem, const iterate *at, const linearization *model, riccati *kkt);

/* quadratic_program.c: false when no Hessian has a descent. */
bool quadratic_program(nmpc_solver *solver, bool is_same_hessian);

/* sqp.c */
void sqp(nmpc_solver *solver);

/* Costs of the parts, in Riccati factorizations as measured. */
#define WORK_DERIVATIVES 8.0
#define WORK_ADJOINT 2.5
#define WORK_FACTORIZATION 1.0
#define WORK_SOLUTION 0.7
