/* Nonlinear model predictive control of a car: one optimal control problem solved per call.
 *
 * Stage vector z_k = (x_k, u_k), k = 0 to N-1, with the states and inputs that are named beside N_STATES and N_INPUTS, in SI units;
 * the last stage N has no input. Decision variables w = (z_0, ..., z_N-1, x_N). Constraints g: the gaps F(x_k, u_k) - x_k+1, then for
 * the nodes 1 to N the distance from the reference position to the left of the path [m].
 *
 * Bounds on inputs are hard. Bounds on states, the terminal box and the corridor are soft: a violation s costs
 * penalty_linear s + penalty_quadratic s^2 / 2, which is exact: while a multiplier is below penalty_linear, nothing is violated.
 *
 * A solver is one struct without pointers to itself: the caller provides nmpc_solver_bytes() of memory, aligned to
 * nmpc_solver_alignment(), one for each thread that solves. No call allocates, waits, or keeps state anywhere else.
 */
#pragma once

#include <stddef.h>
#include <stdint.h>

#include "problem_size.h"

#ifdef __cplusplus
extern "C" {
#endif

#define NMPC_EXPORT __attribute__((visibility("default")))

enum {
    NMPC_VARIABLES = HORIZON_STEPS * (N_STATES + N_INPUTS) + N_STATES,
    NMPC_CONSTRAINTS = HORIZON_STEPS * (N_STATES + 1),
    /* References x_ref,0 to x_ref,N; normals of the path at the nodes 1 to N; previous input; diagonals of Q, Q_N, R, S. */
    NMPC_PARAMETERS = (HORIZON_STEPS + 1) * N_STATES + HORIZON_STEPS * 2 + N_INPUTS + 2 * N_STATES + 2 * N_INPUTS,
};

typedef struct nmpc_solver nmpc_solver;

typedef struct {
    const double *w_guess;         /* [NMPC_VARIABLES]; begins with the measured state */
    const double *lam_w_guess;     /* [NMPC_VARIABLES] multipliers of the bounds, positive at the upper one */
    const double *lam_g_guess;     /* [NMPC_CONSTRAINTS] multipliers of the constraints */
    const double *parameters;      /* [NMPC_PARAMETERS] */
    const double *w_lower, *w_upper; /* [NMPC_VARIABLES]; infinite where there is no bound. Read for the inputs, for the bounded states
                                      * of the model at the nodes 1 to N-1, and for all states of the last */
    const double *g_lower, *g_upper; /* [NMPC_CONSTRAINTS]; read for the corridor alone */
    double penalty_linear;         /* above 0 */
    double penalty_quadratic;      /* above 0 */
} nmpc_problem;

typedef enum {
    NMPC_CONVERGED = 0,  /* residuals of the answer are below 1e-6 (primal) and 1e-4 (dual) */
    NMPC_LIMIT = 1,      /* the bound on iterations or work was met first; the answer is the last iterate */
    NMPC_NUMERICAL = 2,  /* no descent or no finite number from there on; the answer is the last finite iterate, or else the guess */
} nmpc_status;

/* Share of one part in a solve. The times are zero where the library was built with -DNMPC_NOW=0, for a target without a clock. */
typedef struct {
    int64_t time_ns;
    int calls;
} nmpc_part;

typedef struct {
    nmpc_status status;
    int sqp_iterations;
    int qp_iterations;     /* solutions of a linear system, over all quadratic programmes */
    int factorizations;
    double work;           /* in Riccati factorizations; bounded, see sqp.c */
    double primal_residual, dual_residual;
    nmpc_part stage_sweep;   /* dynamics, Jacobian and Hessian of all stages, cost, constraints, residuals */
    nmpc_part adjoint_sweep; /* the same without Jacobian and Hessian: gradient alone */
    nmpc_part qp;            /* quadratic programmes, with their factorizations */
} nmpc_statistics;

NMPC_EXPORT size_t nmpc_solver_bytes(void);
NMPC_EXPORT size_t nmpc_solver_alignment(void);

/* NMPC_VARIABLES, NMPC_CONSTRAINTS, NMPC_PARAMETERS of the library, and stages that it evaluates at once. */
NMPC_EXPORT int nmpc_variables(void);
NMPC_EXPORT int nmpc_constraints(void);
NMPC_EXPORT int nmpc_parameters(void);
NMPC_EXPORT int nmpc_lanes(void);

/* Solve; w, lam_w and lam_g take the answer, shaped as the guesses. */
NMPC_EXPORT nmpc_statistics nmpc_solve(nmpc_solver *solver, const nmpc_problem *problem, double *w, double *lam_w, double *lam_g);

/* Constraints g [NMPC_CONSTRAINTS], and gradient of objective + lam_g' g [NMPC_VARIABLES] at a point; no penalty is in it. */
NMPC_EXPORT void nmpc_evaluate(nmpc_solver *solver, const double *parameters, const double *w, const double *lam_g, double *g,
                               double *gradient);

/* State x_after [N_STATES] of the model, duration_s of constant input u [N_INPUTS] after state x [N_STATES]. */
NMPC_EXPORT void nmpc_advance(const double *x, const double *u, double duration_s, double *x_after);

/* Parts of a solve alone, to measure how far a whole one is from the least that it can take: one sweep with derivatives, one without
 * Jacobian and Hessian, one Riccati factorization with one solution, each on what the last nmpc_solve left behind. */
NMPC_EXPORT void nmpc_run_stage_sweep(nmpc_solver *solver);
NMPC_EXPORT void nmpc_run_adjoint_sweep(nmpc_solver *solver);
NMPC_EXPORT void nmpc_run_riccati(nmpc_solver *solver);

#ifdef __cplusplus
}
#endif
