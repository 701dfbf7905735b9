/* Newton step of the quadratic programme with linear dynamics, by dynamic programming.
 *
 *   minimise  sum over k of  1/2 d_k' H_k d_k + g_k' d_k  +  1/2 (du_k - du_k-1)' 2S (du_k - du_k-1) - (du_k-1)' 2S (u_k - u_k-1)
 *   subject to  dx_k+1 = J_k d_k + gap_k,  dx_0 = 0,  du_-1 = 0,          d_k = (dx_k, du_k)
 *
 * H_k = 2 diag(Q, R) + exact_share * (Hessian of the dynamics) + rows' diag(row_weight) rows; g_k likewise has rows' row_gradient.
 * The previous input is part of the state: the value function of stage k is 1/2 s' P s + p' s in s = (dx_k, du_k-1),
 * for which the recursion is (Rawlings, Mayne, Diehl: Model Predictive Control, section 8.8.3, with a cross term)
 *
 *   M = H + (0, 2S) + W' P_next W,  W = (J; 0 I),  m = g + W' (p_next + P_next (gap; 0))
 *   du = -K s - k,  K = M_uu^-1 (M_ux, -2S),  k = M_uu^-1 m_u
 *   P = diag(M_xx, 2S) - (M_ux, -2S)' K,  p = (m_x, -2S (u_k - u_k-1)) - K' m_u
 *
 * The factorization (P, K) needs the matrices alone, the solution (p, k, d) is repeated for other right-hand sides.
 */
#include <math.h>
#include <string.h>

#include "solver.h"

/* Pivots below these have no descent: curvature per unit of input, and of the second after the first. */
#define SMALLEST_PIVOT 1e-8
#define SMALLEST_DETERMINANT 1e-9

typedef double square[NZ][NZ];

static void add_corridor_weight(const double normal[2], double weight, square matrix)
{
    matrix[X][X] += weight * normal[0] * normal[0];
    matrix[X][Y] += weight * normal[0] * normal[1];
    matrix[Y][X] += weight * normal[0] * normal[1];
    matrix[Y][Y] += weight * normal[1] * normal[1];
}

/* M = H + W' P W. */
static void stage_matrix(const problem_data *p, const linearization *model, const riccati *kkt, int k, square M)
{
    const double(*restrict J)[NZ] = model->jacobian[k], (*restrict H)[NZ] = model->hessian[k];
    const double(*restrict P)[NZ] = kkt->value_hessian[k + 1];
    square PW;
    for (int i = 0; i < NZ; i++) {
        double sum[NZ] = {0};
        for (int j = NX; j < NZ; j++) sum[j] = P[i][j];
        for (int l = 0; l < NX; l++) {
            for (int j = 0; j < NZ; j++) sum[j] += P[i][l] * J[l][j];
        }
        memcpy(PW[i], sum, sizeof sum);
    }
    for (int i = 0; i < NZ; i++) {
        double sum[NZ];
        for (int j = 0; j < NZ; j++) sum[j] = kkt->exact_share * H[i][j] + (i >= NX ? PW[i][j] : 0.0);
        for (int l = 0; l < NX; l++) {
            for (int j = 0; j < NZ; j++) sum[j] += J[l][i] * PW[l][j];
        }
        memcpy(M[i], sum, sizeof sum);
    }
    const double *weight = &kkt->row_weight[k * STAGE_ROWS];
    for (int j = 0; j < NZ; j++) M[j][j] += 2.0 * p->weight[j] + (j >= NX ? 2.0 * p->difference_weight[j - NX] : 0.0);
    for (int i = 0; i < STAGE_BOUNDS; i++) M[BOUNDED_COMPONENT[i]][BOUNDED_COMPONENT[i]] += weight[i];
    add_corridor_weight(p->normal[k], weight[STAGE_BOUNDS], M);
}

/* Inverse of M_uu as (11, 12, 22); false when it is not positive definite. */
static bool invert_pivot(square M, double inverse[3])
{
    const double a = M[NX][NX], b = M[NX][NX + 1], c = M[NX + 1][NX + 1], determinant = a * c - b * b;
    if (!(a > SMALLEST_PIVOT && determinant > SMALLEST_DETERMINANT * a && isfinite(determinant))) return false;
    inverse[0] = c / determinant;
    inverse[1] = -b / determinant;
    inverse[2] = a / determinant;
    return true;
}

static void eliminate_input(const problem_data *p, riccati *kkt, int k, square M)
{
    const double *inverse = kkt->inverse_pivot[k];
    double(*restrict K)[NZ] = kkt->feedback[k], (*restrict P)[NZ] = kkt->value_hessian[k];
    double cross[NU][NZ]; /* (M_ux, -2S) */
    for (int i = 0; i < NU; i++) {
        for (int j = 0; j < NX; j++) cross[i][j] = M[NX + i][j];
        for (int j = 0; j < NU; j++) cross[i][NX + j] = i == j ? -2.0 * p->difference_weight[i] : 0.0;
    }
    for (int j = 0; j < NZ; j++) {
        K[0][j] = inverse[0] * cross[0][j] + inverse[1] * cross[1][j];
        K[1][j] = inverse[1] * cross[0][j] + inverse[2] * cross[1][j];
    }
    for (int i = 0; i < NZ; i++) {
        for (int j = 0; j < NZ; j++) {
            const double own = i < NX && j < NX ? M[i][j] : i == j ? 2.0 * p->difference_weight[i - NX] : 0.0;
            P[i][j] = own - cross[0][i] * K[0][j] - cross[1][i] * K[1][j];
        }
    }
}

bool riccati_factorize(const problem_data *p, const linearization *model, riccati *kkt)
{
    double(*P)[NZ] = kkt->value_hessian[N];
    memset(P, 0, sizeof(square));
    for (int j = 0; j < NX; j++) P[j][j] = 2.0 * p->last_weight[j] + kkt->row_weight[LAST_ROW + j];
    add_corridor_weight(p->normal[N], kkt->row_weight[LAST_ROW + NX], P);
    for (int k = N - 1; k >= 0; k--) {
        square M;
        stage_matrix(p, model, kkt, k, M);
        if (!invert_pivot(M, kkt->inverse_pivot[k])) return false;
        eliminate_input(p, kkt, k, M);
    }
    return true;
}

/* p and k of the stages, from the last to the first. */
static void backward(const problem_data *p, const iterate *at, const linearization *model, riccati *kkt)
{
    memcpy(kkt->value_gradient[N], model->gradient[N], sizeof kkt->value_gradient[N]); /* without input: zeros there */
    add_row_gradients(p, N, kkt->row_gradient, kkt->value_gradient[N]);
    for (int k = N - 1; k >= 0; k--) {
        const double(*restrict J)[NZ] = model->jacobian[k];
        double(*restrict P)[NZ] = kkt->value_hessian[k + 1];
        double next[NZ], m[NZ];
        for (int i = 0; i < NZ; i++) next[i] = kkt->value_gradient[k + 1][i];
        for (int l = 0; l < NX; l++) { /* P is symmetric: by columns, which are rows in memory */
            for (int i = 0; i < NZ; i++) next[i] += P[l][i] * model->gap[k][l];
        }
        for (int j = 0; j < NZ; j++) m[j] = model->gradient[k][j] + (j >= NX ? next[j] : 0.0);
        for (int l = 0; l < NX; l++) {
            for (int j = 0; j < NZ; j++) m[j] += J[l][j] * next[l];
        }
        add_row_gradients(p, k, kkt->row_gradient, m);
        const double *inverse = kkt->inverse_pivot[k], *previous = k > 0 ? &at->z[k - 1][NX] : p->previous_input;
        kkt->feedforward[k][0] = inverse[0] * m[NX] + inverse[1] * m[NX + 1];
        kkt->feedforward[k][1] = inverse[1] * m[NX] + inverse[2] * m[NX + 1];
        for (int j = 0; j < NZ; j++) {
            const double own = j < NX ? m[j] : -2.0 * p->difference_weight[j - NX] * (at->z[k][j] - previous[j - NX]);
            kkt->value_gradient[k][j] = own - kkt->feedback[k][0][j] * m[NX] - kkt->feedback[k][1][j] * m[NX + 1];
        }
    }
}

/* Steps and multipliers of the stages, from the first to the last. */
static void forward(const linearization *model, riccati *kkt)
{
    double s[NZ] = {0}; /* (dx_k, du_k-1) */
    for (int k = 0; k < N; k++) {
        double *d = kkt->step[k];
        memcpy(d, s, NX * sizeof *s);
        for (int i = 0; i < NU; i++) {
            double sum = -kkt->feedforward[k][i];
            for (int j = 0; j < NZ; j++) sum -= kkt->feedback[k][i][j] * s[j];
            d[NX + i] = sum;
        }
        for (int i = 0; i < NX; i++) {
            double sum = model->gap[k][i];
            for (int j = 0; j < NZ; j++) sum += model->jacobian[k][i][j] * d[j];
            s[i] = sum;
        }
        memcpy(&s[NX], &d[NX], NU * sizeof *s);
        for (int i = 0; i < NX; i++) {
            double sum = kkt->value_gradient[k + 1][i];
            for (int j = 0; j < NZ; j++) sum += kkt->value_hessian[k + 1][i][j] * s[j];
            kkt->gap_multiplier[k + 1][i] = sum;
        }
    }
    memcpy(kkt->step[N], s, NX * sizeof *s);
    memset(&kkt->step[N][NX], 0, NU * sizeof *s);
}

void riccati_solve(const problem_data *problem, const iterate *at, const linearization *model, riccati *kkt)
{
    backward(problem, at, model, kkt);
    forward(model, kkt);
}
