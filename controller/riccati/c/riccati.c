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
 *   M_uu = L D L',  C = (M_ux, -2S),  du = -K s - k,  K = M_uu^-1 C,  k = M_uu^-1 m_u
 *   P = diag(M_xx, 2S) - (L^-1 C)' D^-1 (L^-1 C),  p = (m_x, -2S (u_k - u_k-1)) - K' m_u
 *
 * The factorization (P, K) needs the matrices alone, the solution (p, k, d) is repeated for other right-hand sides. Both go from the
 * last stage to the first, so that a change at one stage leaves the later ones as they are.
 */
#include <math.h>
#include <string.h>

#include "solver.h"

#define SMALLEST_PIVOT 1e-8 /* curvature per unit of input below which there is no descent */

typedef stage_row square[NZ];

static const stage_row INPUT_PART = {[NX ... NZ - 1] = 1.0};

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
    const stage_row *J = model->jacobian[k], *H = model->hessian[k], *P = kkt->value_hessian[k + 1];
    square PW;
    for (int i = 0; i < NZ; i++) {
        stage_vector sum = product(P[i], INPUT_PART);
        for (int l = 0; l < NX; l++) sum = plus(sum, P[i][l], J[l]);
        store(PW[i], sum);
    }
    for (int i = 0; i < NZ; i++) {
        stage_vector sum = scaled(kkt->exact_share, H[i]);
        if (i >= NX) sum = plus(sum, 1.0, PW[i]);
        for (int l = 0; l < NX; l++) sum = plus(sum, J[l][i], PW[l]);
        store(M[i], sum);
    }
    const double *weight = &kkt->row_weight[k * STAGE_ROWS];
    for (int j = 0; j < NZ; j++) M[j][j] += 2.0 * p->weight[j];
    for (int j = 0; j < NU; j++) M[NX + j][NX + j] += 2.0 * p->difference_weight[j];
    for (int i = 0; i < STAGE_BOUNDS; i++) M[BOUNDED_COMPONENT[i]][BOUNDED_COMPONENT[i]] += weight[i];
    add_corridor_weight(p->normal[k], weight[STAGE_BOUNDS], M);
}

/* L below the diagonal and 1 / D on it; false when M_uu is not positive definite. */
static bool factorize_pivot(square M, double pivot[NU][NU])
{
    for (int j = 0; j < NU; j++) {
        double d = M[NX + j][NX + j];
        for (int l = 0; l < j; l++) d -= pivot[j][l] * pivot[j][l] / pivot[l][l];
        if (!(d > SMALLEST_PIVOT && d < INFINITY)) return false;
        pivot[j][j] = 1.0 / d;
        for (int i = j + 1; i < NU; i++) {
            double sum = M[NX + i][NX + j];
            for (int l = 0; l < j; l++) sum -= pivot[i][l] * pivot[j][l] / pivot[l][l];
            pivot[i][j] = sum * pivot[j][j];
        }
    }
    return true;
}

/* K and P. */
static void eliminate_input(const problem_data *p, riccati *kkt, int k, square M)
{
    const double(*L)[NU] = kkt->pivot[k];
    stage_row *K = kkt->feedback[k], *P = kkt->value_hessian[k], reduced[NU]; /* L^-1 C */
    for (int i = 0; i < NU; i++) {
        for (int j = 0; j < NU; j++) M[NX + i][NX + j] = i == j ? -2.0 * p->difference_weight[i] : 0.0; /* now C */
        stage_vector sum = load(M[NX + i]);
        for (int l = 0; l < i; l++) sum = plus(sum, -L[i][l], reduced[l]);
        store(reduced[i], sum);
        store(K[i], scaled(L[i][i], reduced[i]));
    }
    for (int i = 0; i < NX; i++) {
        for (int j = NX; j < NZ; j++) M[i][j] = 0.0;
    }
    for (int i = NX; i < NZ; i++) {
        for (int j = 0; j < NX; j++) M[i][j] = 0.0;
        M[i][i] = 2.0 * p->difference_weight[i - NX];
    }
    for (int i = 0; i < NZ; i++) {
        stage_vector sum = load(M[i]);
        for (int l = 0; l < NU; l++) sum = plus(sum, -reduced[l][i], K[l]);
        store(P[i], sum);
    }
    for (int i = NU - 2; i >= 0; i--) {
        stage_vector sum = load(K[i]);
        for (int l = i + 1; l < NU; l++) sum = plus(sum, -L[l][i], K[l]);
        store(K[i], sum);
    }
}

bool riccati_factorize(const problem_data *p, const linearization *model, int last, riccati *kkt)
{
    if (last == N) {
        stage_row *P = kkt->value_hessian[N];
        memset(P, 0, sizeof(square));
        for (int j = 0; j < NX; j++) P[j][j] = 2.0 * p->last_weight[j] + kkt->row_weight[LAST_ROW + j];
        add_corridor_weight(p->normal[N], kkt->row_weight[LAST_ROW + NX], P);
    }
    for (int k = last < N ? last : N - 1; k >= 0; k--) {
        square M;
        stage_matrix(p, model, kkt, k, M);
        if (!factorize_pivot(M, kkt->pivot[k])) return false;
        eliminate_input(p, kkt, k, M);
    }
    return true;
}

/* k = M_uu^-1 m_u */
static void solve_pivot(double pivot[NU][NU], const double m[NU], double k[NU])
{
    for (int i = 0; i < NU; i++) {
        k[i] = m[i];
        for (int l = 0; l < i; l++) k[i] -= pivot[i][l] * k[l];
    }
    for (int i = NU - 1; i >= 0; i--) {
        k[i] *= pivot[i][i];
        for (int l = i + 1; l < NU; l++) k[i] -= pivot[l][i] * k[l];
    }
}

/* p and k of the stages, from the last to the first. */
static void backward(const problem_data *p, const iterate *at, const linearization *model, int last, riccati *kkt)
{
    if (last == N) {
        memcpy(kkt->value_gradient[N], model->gradient[N], sizeof kkt->value_gradient[N]); /* without input: zeros there */
        add_row_gradients(p, N, kkt->row_gradient, kkt->value_gradient[N]);
    }
    for (int k = last < N ? last : N - 1; k >= 0; k--) {
        const stage_row *J = model->jacobian[k], *P = kkt->value_hessian[k + 1];
        stage_row next, m;
        stage_vector sum = load(kkt->value_gradient[k + 1]);
        for (int l = 0; l < NX; l++) sum = plus(sum, model->gap[k][l], P[l]); /* P is symmetric: by columns, which are rows in memory */
        store(next, sum);
        sum = load(model->gradient[k]);
        for (int l = 0; l < NX; l++) sum = plus(sum, next[l], J[l]);
        store(m, sum);
        for (int j = NX; j < NZ; j++) m[j] += next[j];
        add_row_gradients(p, k, kkt->row_gradient, m);
        solve_pivot(kkt->pivot[k], &m[NX], kkt->feedforward[k]);
        const double *previous = k > 0 ? &at->z[k - 1][NX] : p->previous_input;
        double m_u[NU];
        memcpy(m_u, &m[NX], sizeof m_u);
        for (int j = NX; j < NZ; j++) m[j] = -2.0 * p->difference_weight[j - NX] * (at->z[k][j] - previous[j - NX]);
        sum = load(m);
        for (int l = 0; l < NU; l++) sum = plus(sum, -m_u[l], kkt->feedback[k][l]);
        store(kkt->value_gradient[k], sum);
    }
}

/* Steps of the stages, from the first to the last. */
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
    }
    memcpy(kkt->step[N], s, NX * sizeof *s);
    memset(&kkt->step[N][NX], 0, NU * sizeof *s);
}

void riccati_solve(const problem_data *problem, const iterate *at, const linearization *model, int last, riccati *kkt)
{
    backward(problem, at, model, last, kkt);
    forward(model, kkt);
}

/* Gradients of the value functions at the solution. */
void riccati_gap_multipliers(riccati *kkt)
{
    for (int k = 1; k <= N; k++) {
        stage_row multiplier;
        stage_vector sum = load(kkt->value_gradient[k]);
        for (int l = 0; l < NX; l++) sum = plus(sum, kkt->step[k][l], kkt->value_hessian[k][l]);
        for (int l = NX; l < NZ; l++) sum = plus(sum, kkt->step[k - 1][l], kkt->value_hessian[k][l]);
        store(multiplier, sum);
        memcpy(kkt->gap_multiplier[k], multiplier, sizeof kkt->gap_multiplier[k]);
    }
}
