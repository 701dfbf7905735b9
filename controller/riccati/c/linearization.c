/* Stage sweep: the dynamics with their derivatives at all stages, LANES of them at once, and the gradient of the cost
 *
 *   sum over k < N of (x_k - r_k)' Q (x_k - r_k) + u_k' R u_k + (u_k - u_k-1)' S (u_k - u_k-1),  plus (x_N - r_N)' Q_N (x_N - r_N)
 */
#include "solver.h"
#include "stage_functions.h"

/* Numbers of LANES stages: values of the first component for all of them, then of the second, and so on. */
typedef struct {
    _Alignas(lanes) double z[NZ][LANES];
    _Alignas(lanes) double multiplier[NX][LANES];
    _Alignas(lanes) double next[NX][LANES];
} stage_group;

#define AS_LANES(array) ((lanes *)(array))

/* The stages from `first` on; the last is repeated where there are no more. */
static void gather(const iterate *at, int first, stage_group *group)
{
    for (int lane = 0; lane < LANES; lane++) {
        const int k = first + lane < N ? first + lane : N - 1;
        for (int j = 0; j < NZ; j++) group->z[j][lane] = at->z[k][j];
        for (int j = 0; j < NX; j++) group->multiplier[j][lane] = at->gap_multiplier[k + 1][j];
    }
}

static int lanes_used(int first) { return N - first < LANES ? N - first : LANES; }

static void scatter_gaps(const iterate *at, int first, const stage_group *group, linearization *model)
{
    for (int lane = 0; lane < lanes_used(first); lane++) {
        for (int j = 0; j < NX; j++) model->gap[first + lane][j] = group->next[j][lane] - at->z[first + lane + 1][j];
    }
}

static void scatter_derivatives(int first, double jacobian[][LANES], double hessian[][LANES], linearization *model)
{
    for (int lane = 0; lane < lanes_used(first); lane++) {
        double(*J)[NZ] = model->jacobian[first + lane], (*H)[NZ] = model->hessian[first + lane];
        for (int i = 0; i < JACOBIAN_NONZEROS; i++) J[jacobian_row[i]][jacobian_column[i]] = jacobian[i][lane];
        for (int i = 0; i < HESSIAN_NONZEROS; i++) {
            H[hessian_row[i]][hessian_column[i]] = H[hessian_column[i]][hessian_row[i]] = hessian[i][lane];
        }
    }
}

static void multiply_adjoint(const iterate *at, linearization *model)
{
    for (int k = 0; k < N; k++) {
        for (int j = 0; j < NZ; j++) model->adjoint[k][j] = 0.0;
        for (int i = 0; i < NX; i++) {
            for (int j = 0; j < NZ; j++) model->adjoint[k][j] += model->jacobian[k][i][j] * at->gap_multiplier[k + 1][i];
        }
    }
}

static void cost_gradient(const problem_data *p, const iterate *at, linearization *model)
{
    for (int k = 0; k <= N; k++) {
        const double *weight = k < N ? p->weight : p->last_weight;
        for (int j = 0; j < NX; j++) model->gradient[k][j] = 2.0 * weight[j] * (at->z[k][j] - p->reference[k][j]);
    }
    const double *previous = p->previous_input;
    for (int k = 0; k < N; k++) {
        const double *input = &at->z[k][NX];
        for (int j = 0; j < NU; j++) {
            model->gradient[k][NX + j] =
                2.0 * p->weight[NX + j] * input[j] + 2.0 * p->difference_weight[j] * (input[j] - previous[j]);
        }
        previous = input;
    }
}

/* Everything, with second derivatives. */
void linearize(const problem_data *problem, const iterate *at, linearization *model)
{
    for (int first = 0; first < N; first += LANES) {
        stage_group group;
        _Alignas(lanes) double jacobian[JACOBIAN_NONZEROS][LANES], hessian[HESSIAN_NONZEROS][LANES];
        gather(at, first, &group);
        stage_derivatives(AS_LANES(group.z), AS_LANES(group.multiplier), AS_LANES(group.next), AS_LANES(jacobian), AS_LANES(hessian));
        scatter_gaps(at, first, &group, model);
        scatter_derivatives(first, jacobian, hessian, model);
    }
    multiply_adjoint(at, model);
    cost_gradient(problem, at, model);
    row_values(problem, at, model->row_value);
}

/* The same without the derivatives: Jacobian and Hessian stay those of an earlier iterate, the adjoint is that of this one. */
void linearize_gradient(const problem_data *problem, const iterate *at, linearization *model)
{
    for (int first = 0; first < N; first += LANES) {
        stage_group group;
        _Alignas(lanes) double adjoint[NZ][LANES];
        gather(at, first, &group);
        stage_adjoint(AS_LANES(group.z), AS_LANES(group.multiplier), AS_LANES(group.next), AS_LANES(adjoint));
        scatter_gaps(at, first, &group, model);
        for (int lane = 0; lane < lanes_used(first); lane++) {
            for (int j = 0; j < NZ; j++) model->adjoint[first + lane][j] = adjoint[j][lane];
        }
    }
    cost_gradient(problem, at, model);
    row_values(problem, at, model->row_value);
}
