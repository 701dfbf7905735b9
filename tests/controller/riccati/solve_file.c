/* Solves the problems of a file with nothing but the public header, and writes status and answer of each. */
#include <stdio.h>
#include <stdlib.h>

#include "nmpc.h"

enum { NUMBERS = 4 * NMPC_VARIABLES + 3 * NMPC_CONSTRAINTS + NMPC_PARAMETERS };

int main(int argc, char **argv)
{
    static double in[NUMBERS], w[NMPC_VARIABLES], lam_w[NMPC_VARIABLES], lam_g[NMPC_CONSTRAINTS];
    FILE *problems = argc == 3 ? fopen(argv[1], "rb") : NULL, *answers = argc == 3 ? fopen(argv[2], "wb") : NULL;
    nmpc_solver *solver = aligned_alloc(64, (nmpc_solver_bytes() + 63) / 64 * 64);
    if (!problems || !answers || !solver) return 1;
    while (fread(in, sizeof in, 1, problems) == 1) {
        const double *bounds = in + 2 * NMPC_VARIABLES + NMPC_CONSTRAINTS + NMPC_PARAMETERS;
        const nmpc_problem problem = {
            .w_guess = in,
            .lam_w_guess = in + NMPC_VARIABLES,
            .lam_g_guess = in + 2 * NMPC_VARIABLES,
            .parameters = in + 2 * NMPC_VARIABLES + NMPC_CONSTRAINTS,
            .w_lower = bounds,
            .w_upper = bounds + NMPC_VARIABLES,
            .g_lower = bounds + 2 * NMPC_VARIABLES,
            .g_upper = bounds + 2 * NMPC_VARIABLES + NMPC_CONSTRAINTS,
            .penalty_linear = 500.0,
            .penalty_quadratic = 400.0,
        };
        const double status = nmpc_solve(solver, &problem, w, lam_w, lam_g).status;
        fwrite(&status, sizeof status, 1, answers);
        fwrite(w, sizeof w, 1, answers);
    }
    free(solver);
    fclose(problems);
    return fclose(answers);
}
