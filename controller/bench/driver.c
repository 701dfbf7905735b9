/* Solves the problems of a file with the library of one solver, so that callgrind sees the solves and little else.
 *
 *     bench_driver LIBRARY PROBLEMS
 *
 * Each problem: guesses of w and of its multipliers, guess of the multipliers of g, parameters, bounds of w, bounds of g; see nmpc.h.
 * Prints how many it solved.
 */
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>

#include "nmpc.h"

enum { NUMBERS = 4 * NMPC_VARIABLES + 3 * NMPC_CONSTRAINTS + NMPC_PARAMETERS };

static double in[NUMBERS], w[NMPC_VARIABLES], lam_w[NMPC_VARIABLES], lam_g[NMPC_CONSTRAINTS];
static const double *const lam_w_guess = in + NMPC_VARIABLES, *const lam_g_guess = in + 2 * NMPC_VARIABLES;
static const double *const parameters = in + 2 * NMPC_VARIABLES + NMPC_CONSTRAINTS;
static const double *const w_bounds = in + 2 * NMPC_VARIABLES + NMPC_CONSTRAINTS + NMPC_PARAMETERS;
static const double *const g_bounds = in + 4 * NMPC_VARIABLES + NMPC_CONSTRAINTS + NMPC_PARAMETERS;

static void *library;

/* Set a pointer to a function of the library; the cast is how POSIX does it, since C has none from an object's address to a function's. */
#define LOAD(pointer, name) (*(void **)&(pointer) = dlsym(library, name))

static int solve_with_riccati(FILE *problems, double linear, double quadratic)
{
    size_t (*bytes)(void);
    nmpc_statistics (*solve)(nmpc_solver *, const nmpc_problem *, double *, double *, double *);
    LOAD(bytes, "nmpc_solver_bytes");
    LOAD(solve, "nmpc_solve");
    nmpc_solver *solver = aligned_alloc(64, (bytes() + 63) / 64 * 64);
    const nmpc_problem problem = {
        .w_guess = in, .lam_w_guess = lam_w_guess, .lam_g_guess = lam_g_guess, .parameters = parameters,
        .w_lower = w_bounds, .w_upper = w_bounds + NMPC_VARIABLES, .g_lower = g_bounds, .g_upper = g_bounds + NMPC_CONSTRAINTS,
        .penalty_linear = linear, .penalty_quadratic = quadratic,
    };
    int count = 0;
    for (; solver && fread(in, sizeof in, 1, problems) == 1; count++) solve(solver, &problem, w, lam_w, lam_g);
    free(solver);
    return count;
}

static int solve_with_casadi(FILE *problems)
{
    long long sizes[4];
    int (*checkout)(void), (*work)(long long *, long long *, long long *, long long *);
    int (*solve)(const double **, double **, long long *, double *, int);
    LOAD(checkout, "nmpc_checkout");
    LOAD(work, "nmpc_work");
    LOAD(solve, "nmpc");
    work(sizes, sizes + 1, sizes + 2, sizes + 3);
    const int memory = checkout();
    const double **arguments = calloc((size_t)sizes[0], sizeof *arguments);
    double **results = calloc((size_t)sizes[1], sizeof *results), *reals = calloc((size_t)sizes[3] + 1, sizeof *reals);
    long long *integers = calloc((size_t)sizes[2] + 1, sizeof *integers);
    int count = 0;
    while (arguments && results && reals && integers && fread(in, sizeof in, 1, problems) == 1) {
        /* x0, p, lbx, ubx, lbg, ubg, lam_x0, lam_g0 to x, f, g, lam_x, lam_g, lam_p; the work vectors may hold the rest. */
        const double *given[] = {in, parameters, w_bounds, w_bounds + NMPC_VARIABLES, g_bounds, g_bounds + NMPC_CONSTRAINTS,
                                 lam_w_guess, lam_g_guess};
        for (int i = 0; i < 8; i++) arguments[i] = given[i];
        for (int i = 0; i < 6; i++) results[i] = NULL;
        results[0] = w, results[3] = lam_w, results[4] = lam_g;
        solve(arguments, results, integers, reals, memory);
        count++;
    }
    free(arguments), free(results), free(reals), free(integers);
    return count;
}

int main(int argc, char **argv)
{
    double penalties[2];
    FILE *problems = argc == 3 ? fopen(argv[2], "rb") : NULL;
    library = argc == 3 ? dlopen(argv[1], RTLD_NOW) : NULL;
    if (!problems || !library || fread(penalties, sizeof penalties, 1, problems) != 1) return 1;
    printf("%d\n", dlsym(library, "nmpc_solve") ? solve_with_riccati(problems, penalties[0], penalties[1]) : solve_with_casadi(problems));
    return fclose(problems);
}
