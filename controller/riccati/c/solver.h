/* What the files of the solver share. Who calls whom: nmpc.c -> sqp.c -> quadratic_program.c -> riccati.c, and
 * sqp.c -> linearization.c -> stage.c -> generated stage functions. */
#pragma once

#include <stdbool.h>

#include "nmpc.h"
#include "stage_functions.h"
#include "stage_vector.h"

enum {
    N = HORIZON_STEPS,
    NX = N_STATES,
    NU = N_INPUTS,
    NZ = NX + NU,
    N_SWEPT = (N + LANES - 1) / LANES * LANES, /* stages of a sweep: repetitions of the last fill it up */
    X = X_COMPONENT,
    Y = Y_COMPONENT,
    /* Inequality rows: for each of the stages 0 to N-1 the bounded components of z_k, inputs first, and the corridor; then the whole
     * state and the corridor of the last. Stage 0 has bounds on its input alone; its other rows are there with infinite bounds. */
    STAGE_BOUNDS = N_BOUNDED,
    STAGE_ROWS = STAGE_BOUNDS + 1,
    LAST_ROW = N * STAGE_ROWS,
    ROWS = LAST_ROW + NX + 1,
    ROW_LANES = (ROWS + LANES - 1) / LANES,
    ROW_ROOM = ROW_LANES * LANES, /* the rows that are there for the room alone have no bounds */
};

/* A number for each inequality row. */
typedef double row_array[ROW_ROOM] __attribute__((aligned(8 * LANES)));

static const int BOUNDED_COMPONENT[STAGE_BOUNDS] = {BOUNDED_COMPONENTS};

#define CACHE_LINE 64

typedef struct {
    double z[N + 1][NZ];              /* stages; the last has no input, and zeros there */
    double gap_multiplier[N + 1][NX]; /* [k]: of the gap that ends in x_k; the first is unused */
    row_array row_multiplier;         /* positive at the upper bound */
    double state_multiplier[NX];      /* of the bounds that hold the measured state: what balances the gradient there */
} iterate;

/* The data of one problem. */
typedef struct {
    double reference[N + 1][NX], normal[N + 1][2], previous_input[NU];
    double weight[NZ], last_weight[NX], difference_weight[NU]; /* diagonals of (Q, R), Q_N, S */
    row_array lower, upper;
    row_array penalty_linear; /* of a hard row: infinite */
    double penalty_quadratic;
} problem_data;

/* The problem around an iterate. */
typedef struct {
    _Alignas(CACHE_LINE) stage_row jacobian[N_SWEPT][NX];
    stage_row hessian[N_SWEPT][NZ]; /* of the dynamics, weighted with their multipliers; the cost is not in it */
    stage_row gradient[N + 1];      /* of the cost; that of the input difference towards u_k alone, not towards u_k-1; the last
                                     * stage has no input, and zeros there */
    stage_row adjoint[N_SWEPT];     /* Jacobian' times gap multiplier */
    double gap[N_SWEPT][NX];
    row_array row_value;
} linearization;

/* Factorization and solution of the equality-constrained quadratic programme, see riccati.c. */
typedef struct {
    _Alignas(CACHE_LINE) stage_row value_hessian[N + 1][NZ];
    stage_row value_gradient[N + 1], feedback[N][NU];
    double feedforward[N][NU], pivot[N][NU][NU];
    row_array row_weight, row_gradient; /* curvature and gradient that the rows add */
    double exact_share;                 /* 1: exact Hessian, 0: Gauss-Newton */
    double step[N + 1][NZ], gap_multiplier[N + 1][NX];
} riccati;

/* State of the active-set method, see quadratic_program.c. */
typedef struct {
    double step[N + 1][NZ];              /* the point reached */
    row_array value, change;             /* of the rows there, and what the last Newton step would have added to it */
    row_array estimate;                  /* of the multipliers */
    row_array multiplier;                /* m(c) at the value */
    row_array slope, intercept;          /* of the piece of m that it lies on; the intercept where the iterate is, without a step */
    row_array foretold;                  /* multiplier at the Newton point, by the pieces before */
    double weight, violation;            /* w; by how much the rows missed their bounds at the estimates before */
    int engaged[ROW_ROOM], n_engaged;    /* rows that are not idle */
} active_set;

struct nmpc_solver {
    problem_data problem;
    iterate current, last_finite;
    linearization model;
    riccati kkt;
    active_set qp;
    nmpc_statistics statistics;
    int64_t accounted_until_ns;
};

/* clock.c */
int64_t clock_ns(void);

/* linearization.c */
void linearize(const problem_data *problem, const iterate *at, linearization *model);
void linearize_gradient(const problem_data *problem, const iterate *at, linearization *model);
void correct_gradient(const iterate *at, linearization *model);

/* rows.c */
void clip_inputs(const problem_data *problem, iterate *point);
void row_values(const problem_data *problem, const iterate *at, row_array value);
void row_products(const problem_data *problem, const double z[N + 1][NZ], row_array product);
void add_row_gradients(const problem_data *problem, int k, const double row[ROWS], double gradient[NZ]);
static inline int corridor_row(int k) { return k < N ? k * STAGE_ROWS + STAGE_BOUNDS : LAST_ROW + NX; }
static inline int stage_of_row(int row) { return row < LAST_ROW ? row / STAGE_ROWS : N; }

/* optimality.c: false when a number is not finite; sets the state's multiplier. */
bool residuals(const problem_data *problem, iterate *at, const linearization *model, double *primal, double *dual);
void lagrangian_gradient(const problem_data *problem, const iterate *at, const linearization *model, double gradient[N + 1][NZ]);

/* riccati.c. What belongs to stages above `last` is taken to be as it was at the call before; N for everything anew. */
bool riccati_factorize(const problem_data *problem, const linearization *model, int last, riccati *kkt);
void riccati_solve(const problem_data *problem, const iterate *at, const linearization *model, int last, riccati *kkt);
void riccati_gap_multipliers(riccati *kkt);

/* quadratic_program.c: false when no Hessian has a descent. */
bool quadratic_program(nmpc_solver *solver, bool is_same_hessian);

/* sqp.c */
void sqp(nmpc_solver *solver);

/* Costs of the parts with what belongs to them, in Riccati factorizations as measured with AVX2 and without vectors. */
#define WORK_DERIVATIVES 10.0
#define WORK_ADJOINT 4.0
#define WORK_FACTORIZATION 1.0
#define WORK_SOLUTION (LANES == 1 ? 0.4 : 1.0)
