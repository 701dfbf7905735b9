/* Stage sweep: the dynamics with their derivatives at all stages, LANES of them at once, and the gradient of the cost
 *
 *   sum over k < N of (x_k - r_k)' Q (x_k - r_k) + u_k' R u_k + (u_k - u_k-1)' S (u_k - u_k-1),  plus (x_N - r_N)' Q_N (x_N - r_N)
 */
#include <string.h>

#include "solver.h"
#include "stage.h"
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

static void scatter_gaps(const iterate *at, int first, const stage_group *group, linearization *model)
{
    for (int lane = 0; lane < LANES; lane++) {
        const int k = first + lane < N ? first + lane : N - 1;
        for (int j = 0; j < NX; j++) model->gap[first + lane][j] = group->next[j][lane] - at->z[k + 1][j];
    }
}

static void scatter_derivatives(int first, double jacobian[][LANES], double hessian[][LANES], linearization *model)
{
    double *J = model->jacobian[first][0], *H = model->hessian[first][0];
    for (int i = 0; i < JACOBIAN_NONZEROS; i++) {
        for (int lane = 0; lane < LANES; lane++) J[lane * NX * STAGE_ROOM + jacobian_place[i]] = jacobian[i][lane];
    }
    for (int i = 0; i < HESSIAN_NONZEROS; i++) {
        for (int lane = 0; lane < LANES; lane++) {
            double *of_stage = &H[lane * NZ * STAGE_ROOM];
            of_stage[hessian_place[i]] = of_stage[hessian_mirrored_place[i]] = hessian[i][lane];
        }
    }
}

/* gap_multiplier' times the Jacobian of a stage. */
static stage_vector adjoint_product(const iterate *at, const linearization *model, int k)
{
    stage_vector sum = scaled(at->gap_multiplier[k + 1][0], model->jacobian[k][0]);
    for (int i = 1; i < NX; i++) sum = plus(sum, at->gap_multiplier[k + 1][i], model->jacobian[k][i]);
    return sum;
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
    for (int k = 0; k < N; k++) store(model->adjoint[k], adjoint_product(at, model, k));
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
        for (int lane = 0; lane < LANES; lane++) {
            for (int j = 0; j < NZ; j++) model->adjoint[first + lane][j] = adjoint[j][lane];
        }
    }
    cost_gradient(problem, at, model);
    row_values(problem, at, model->row_value);
}

/* Put the gradient right for the use of a Jacobian of another iterate, after `linearize_gradient`. */
void correct_gradient(const iterate *at, linearization *model)
{
    for (int k = 0; k < N; k++) {
        stage_row product;
        store(product, adjoint_product(at, model, k));
        for (int j = 0; j < NZ; j++) model->gradient[k][j] += model->adjoint[k][j] - product[j];
    }
}
