/* Solves the test vectors and compares the answers with those recorded when this library was exported.
 *
 * One line for each that fails, then a summary; exit code 0 when none does. Two solvers take turns: what one answers must be, bit by
 * bit, what the other answers to the same problem, whatever each of them solved before.
 */
#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "nmpc.h"
#include "vectors.h"

/* Another compiler rounds otherwise, so that an iteration more or less is possible; both ends are within the solver's own tolerances
 * of the optimum: 1e-6 on constraints, 1e-4 on gradients. */
#define INPUT_TOLERANCE 1e-6      /* of the first input, rad and share of the drive */
#define W_TOLERANCE 2e-6          /* m, m/s, rad, rad/s */
#define MULTIPLIER_TOLERANCE 1e-4 /* of 1 + the multiplier */

typedef struct {
    int status;
    double w[NMPC_VARIABLES], lam_w[NMPC_VARIABLES], lam_g[NMPC_CONSTRAINTS];
} answer;

typedef struct {
    double input, w, multiplier;
} difference;

static answer of_first, of_second;

static nmpc_solver *new_solver(void)
{
    const size_t alignment = nmpc_solver_alignment();
    nmpc_solver *solver = aligned_alloc(alignment, (nmpc_solver_bytes() + alignment - 1) / alignment * alignment);
    if (!solver) {
        fprintf(stderr, "check: no memory for a solver\n");
        exit(2);
    }
    return solver;
}

static void solve(nmpc_solver *solver, const test_vector *vector, answer *to)
{
    memset(to, 0, sizeof *to); /* so that two answers can be compared as memory */
    to->status = (int)nmpc_solve(solver, &vector->problem, to->w, to->lam_w, to->lam_g).status;
}

/* NaN is larger than everything. */
static double larger(double a, double b) { return a >= b ? a : isnan(a) ? a : isnan(b) ? b : b; }

static double largest_difference(const double *a, const double *b, int count, bool is_relative)
{
    double largest = 0.0;
    for (int i = 0; i < count; i++) largest = larger(largest, fabs(a[i] - b[i]) / (is_relative ? 1.0 + fabs(b[i]) : 1.0));
    return largest;
}

static difference compare(const answer *got, const test_vector *expected)
{
    return (difference){
        .input = largest_difference(got->w + N_STATES, expected->w + N_STATES, N_INPUTS, false),
        .w = largest_difference(got->w, expected->w, NMPC_VARIABLES, false),
        .multiplier = larger(largest_difference(got->lam_w, expected->lam_w, NMPC_VARIABLES, true),
                             largest_difference(got->lam_g, expected->lam_g, NMPC_CONSTRAINTS, true)),
    };
}

static bool fails(const test_vector *vector, const char *what, double value, double tolerance)
{
    if (value <= tolerance) return false;
    printf("FAIL %s: %s differs by %.3g, allowed %.3g\n", vector->name, what, value, tolerance);
    return true;
}

static bool check_answer(const test_vector *vector, const answer *got, difference *largest)
{
    if (got->status != vector->status) {
        printf("FAIL %s: status %d instead of %d\n", vector->name, got->status, vector->status);
        return false;
    }
    if (vector->status != NMPC_CONVERGED) return true; /* how far a solver came before it gave up is no contract */
    const difference now = compare(got, vector);
    largest->input = larger(largest->input, now.input);
    largest->w = larger(largest->w, now.w);
    largest->multiplier = larger(largest->multiplier, now.multiplier);
    const bool input_fails = fails(vector, "the first input", now.input, INPUT_TOLERANCE);
    const bool w_fails = fails(vector, "the plan", now.w, W_TOLERANCE);
    const bool multiplier_fails = fails(vector, "a multiplier", now.multiplier, MULTIPLIER_TOLERANCE);
    return !input_fails && !w_fails && !multiplier_fails;
}

int main(void)
{
    nmpc_solver *first = new_solver(), *second = new_solver();
    difference largest = {0.0, 0.0, 0.0};
    int failed = 0;
    /* The second solver is one problem ahead of the first. */
    solve(second, &TEST_VECTORS[0], &of_second);
    for (int i = 0; i < TEST_VECTOR_COUNT; i++) {
        const test_vector *vector = &TEST_VECTORS[i];
        solve(first, vector, &of_first);
        bool is_good = check_answer(vector, &of_first, &largest);
        if (memcmp(&of_first, &of_second, sizeof of_first) != 0) {
            printf("FAIL %s: two solvers that take turns answer differently\n", vector->name);
            is_good = false;
        }
        if (!is_good) failed++;
        solve(second, &TEST_VECTORS[(i + 1) % TEST_VECTOR_COUNT], &of_second);
    }
    printf("%d of %d vectors pass; largest difference: first input %.2g, plan %.2g, multipliers %.2g; lanes %d, bytes of a solver %lu\n",
           TEST_VECTOR_COUNT - failed, TEST_VECTOR_COUNT, largest.input, largest.w, largest.multiplier, nmpc_lanes(),
           (unsigned long)nmpc_solver_bytes());
    free(first);
    free(second);
    return failed > 0;
}
