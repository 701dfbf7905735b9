/* One sample of the model with its derivatives: the classical Runge-Kutta method, its sensitivities, and its adjoint backwards.
 *
 * Each step from y, with h = sample time / steps, and sensitivities V with respect to the inner variables (see stage.py):
 *
 *   y_i = y + h a_i k_i-1     k_i = f(y_i, u)                     y := y + h sum of b_i k_i
 *   V_i = V + h a_i K_i-1     K_i = df/dy V_i + df/du             V := V + h sum of b_i K_i
 *
 * and back through it, from the adjoint bar of the state after the step to that before it (Griewank and Walther, Evaluating
 * Derivatives, chapter 3), with the second derivative added up on the way:
 *
 *   k_i' = h b_i bar + h a_i+1 y_i+1'     y_i' = (df/dy)' k_i'     bar := bar + sum of y_i'     u' := u' + sum of (df/du)' k_i'
 *   curvature := curvature + (V_i, I)' (Hessian of k_i'' f) (V_i, I)
 *
 * The evaluations of f and the ways back through them are generated.
 */
#include "stage.h"

#include <string.h>

#include "problem_size.h"
#include "stage_functions.h"

enum { NX = N_STATES, NU = N_INPUTS, NV = SENSITIVITY_NONZEROS, ORDER = 4, EVALUATIONS = INTEGRATOR_STEPS * ORDER };

static const double STEP_S = SAMPLE_TIME_S / INTEGRATOR_STEPS;
static const double OFFSET[ORDER + 1] = {0.0, 0.5, 0.5, 1.0, 0.0}; /* a; nothing comes after the last evaluation of a step */
static const double WEIGHT[ORDER] = {1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0}; /* b */

static inline void clear(lanes *values, int count) { memset(values, 0, (size_t)count * sizeof *values); }

/* to = from + factor * change */
static inline void add(lanes *to, const lanes *from, double factor, const lanes *change, int count)
{
    for (int j = 0; j < count; j++) to[j] = from[j] + factor * change[j];
}

/* y := y + h sum of b_i k_i */
static inline void finish_step(lanes *y, const lanes *k, int count)
{
    for (int j = 0; j < count; j++) {
        const lanes ends = k[j] + k[3 * count + j], middle = k[count + j] + k[2 * count + j];
        y[j] += STEP_S * WEIGHT[0] * ends + STEP_S * WEIGHT[1] * middle;
    }
}

/* Adjoint of evaluation number i of a step: k_bar = h b_i bar + h a_i+1 later */
static inline void adjoint_of_evaluation(int i, const lanes *bar, const lanes *later, lanes *k_bar)
{
    for (int j = 0; j < NX; j++) k_bar[j] = STEP_S * WEIGHT[i] * bar[j] + STEP_S * OFFSET[i + 1] * later[j];
}

void stage_adjoint(const lanes *z, const lanes *lam, lanes *x_next, lanes *adjoint)
{
    lanes y[NX], u[NU], sensitivity[NV], bar[NX], turn[2], k[ORDER][NX];
    lanes constants[PLAIN_CONSTANTS_TAPE], tape[EVALUATIONS][PLAIN_FORWARD_TAPE], point[EVALUATIONS][NX];
    stage_begin(z, lam, y, u, sensitivity, bar, turn);
    plain_constants(u, constants);
    clear(k[ORDER - 1], NX);
    for (int first = 0; first < EVALUATIONS; first += ORDER) {
        for (int i = 0; i < ORDER; i++) {
            add(point[first + i], y, STEP_S * OFFSET[i], k[(i + ORDER - 1) % ORDER], NX);
            plain_forward(constants, u, point[first + i], k[i], tape[first + i]);
        }
        finish_step(y, k[0], NX);
    }
    lanes u_bar[NU], later[NX], sum[NX], k_bar[NX], input_bar[NU];
    clear(u_bar, NU);
    clear(later, NX);
    for (int first = EVALUATIONS - ORDER; first >= 0; first -= ORDER) {
        memcpy(sum, bar, sizeof sum);
        for (int i = ORDER - 1; i >= 0; i--) {
            adjoint_of_evaluation(i, bar, later, k_bar);
            plain_backward(constants, tape[first + i], u, point[first + i], k_bar, later, input_bar);
            add(sum, sum, 1.0, later, NX);
            add(u_bar, u_bar, 1.0, input_bar, NU);
        }
        memcpy(bar, sum, sizeof bar);
    }
    plain_end(lam, turn, z, y, bar, u_bar, x_next, adjoint);
}

void stage_derivatives(const lanes *z, const lanes *lam, lanes *x_next, lanes *jacobian, lanes *hessian)
{
    lanes y[NX], u[NU], V[NV], bar[NX], turn[2], k[ORDER][NX], K[ORDER][NV];
    lanes constants[CURVED_CONSTANTS_TAPE], tape[EVALUATIONS][CURVED_FORWARD_TAPE], point[EVALUATIONS][NX], V_at[EVALUATIONS][NV];
    stage_begin(z, lam, y, u, V, bar, turn);
    curved_constants(u, constants);
    clear(k[ORDER - 1], NX);
    clear(K[ORDER - 1], NV);
    for (int first = 0; first < EVALUATIONS; first += ORDER) {
        for (int i = 0; i < ORDER; i++) {
            add(point[first + i], y, STEP_S * OFFSET[i], k[(i + ORDER - 1) % ORDER], NX);
            add(V_at[first + i], V, STEP_S * OFFSET[i], K[(i + ORDER - 1) % ORDER], NV);
            curved_forward(constants, u, point[first + i], V_at[first + i], k[i], K[i], tape[first + i]);
        }
        finish_step(y, k[0], NX);
        finish_step(V, K[0], NV);
    }
    lanes later[NX], sum[NX], k_bar[NX], input_bar[NU], curvature[2][CURVATURE_NONZEROS];
    clear(later, NX);
    clear(curvature[0], CURVATURE_NONZEROS);
    for (int first = EVALUATIONS - ORDER; first >= 0; first -= ORDER) {
        memcpy(sum, bar, sizeof sum);
        for (int i = ORDER - 1; i >= 0; i--) {
            adjoint_of_evaluation(i, bar, later, k_bar);
            curved_backward(constants, tape[first + i], u, point[first + i], V_at[first + i], k_bar, curvature[(i + 1) % 2], later,
                            input_bar, curvature[i % 2]);
            add(sum, sum, 1.0, later, NX);
        }
        memcpy(bar, sum, sizeof bar);
    }
    curved_end(lam, turn, z, y, V, curvature[0], x_next, jacobian, hessian);
}

void stage_advance(const lanes *x, const lanes *u, lanes duration_s, lanes *x_after)
{
    lanes k[NX], sum[NX], point[NX], constants[PLAIN_CONSTANTS_TAPE], tape[PLAIN_FORWARD_TAPE];
    const lanes h = duration_s * (1.0 / INTEGRATOR_STEPS);
    memcpy(x_after, x, sizeof sum);
    clear(k, NX);
    plain_constants(u, constants);
    for (int step = 0; step < INTEGRATOR_STEPS; step++) {
        memcpy(sum, x_after, sizeof sum);
        for (int i = 0; i < ORDER; i++) {
            for (int j = 0; j < NX; j++) point[j] = x_after[j] + h * OFFSET[i] * k[j];
            plain_forward(constants, u, point, k, tape);
            for (int j = 0; j < NX; j++) sum[j] += h * WEIGHT[i] * k[j];
        }
        memcpy(x_after, sum, sizeof sum);
    }
}
