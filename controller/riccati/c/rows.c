/* Inequality rows: components of z_k, and the corridor, the distance n_k' ((X, Y)_k - (X, Y)_ref,k) to the left of the reference.
 * Their order is in solver.h.
 */
#include "solver.h"

/* Values of the rows for a linear argument: of a step, or of anything where the corridor is measured from the origin. */
void row_products(const problem_data *p, const double z[N + 1][NZ], row_array product)
{
    for (int k = 0; k < N; k++) {
        double *row = &product[k * STAGE_ROWS];
        for (int i = 0; i < STAGE_BOUNDS; i++) row[i] = z[k][BOUNDED_COMPONENT[i]];
        row[STAGE_BOUNDS] = p->normal[k][0] * z[k][X] + p->normal[k][1] * z[k][Y];
    }
    for (int j = 0; j < NX; j++) product[LAST_ROW + j] = z[N][j];
    product[LAST_ROW + NX] = p->normal[N][0] * z[N][X] + p->normal[N][1] * z[N][Y];
    for (int i = ROWS; i < ROW_ROOM; i++) product[i] = 0.0;
}

void row_values(const problem_data *p, const iterate *at, row_array value)
{
    row_products(p, at->z, value);
    for (int k = 0; k <= N; k++) { /* by the difference, for the sake of digits far from the origin */
        const double dx = at->z[k][X] - p->reference[k][X], dy = at->z[k][Y] - p->reference[k][Y];
        value[corridor_row(k)] = p->normal[k][0] * dx + p->normal[k][1] * dy;
    }
}

/* Add the transposed rows of stage k times `row` to a gradient with respect to z_k. */
void add_row_gradients(const problem_data *p, int k, const double row[ROWS], double gradient[NZ])
{
    const double *of_stage = &row[k * STAGE_ROWS];
    if (k < N) {
        for (int i = 0; i < STAGE_BOUNDS; i++) gradient[BOUNDED_COMPONENT[i]] += of_stage[i];
    } else {
        for (int j = 0; j < NX; j++) gradient[j] += of_stage[j];
    }
    gradient[X] += p->normal[k][0] * row[corridor_row(k)];
    gradient[Y] += p->normal[k][1] * row[corridor_row(k)];
}

void clip_inputs(const problem_data *p, iterate *point)
{
    for (int k = 0; k < N; k++) {
        const double *lower = &p->lower[k * STAGE_ROWS], *upper = &p->upper[k * STAGE_ROWS];
        double *input = &point->z[k][NX];
        for (int j = 0; j < NU; j++) {
            if (input[j] > upper[j]) input[j] = upper[j];
            if (input[j] < lower[j]) input[j] = lower[j];
        }
    }
}
