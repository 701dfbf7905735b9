/* Classical Runge-Kutta steps of the emulated car; `derivatives` and `motion` are generated. The sizes come from the build. */

#include <string.h>

int derivatives(const double **arg, double **res, long long int *iw, double *w, int mem);
int motion(const double **arg, double **res, long long int *iw, double *w, int mem);

enum { STAGES = 4 };
static const double AHEAD[STAGES] = {0.0, 0.5, 0.5, 1.0};
static const double WEIGHT[STAGES] = {1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0};

/* Advance by `steps` steps of `step_s` with the inputs held.
 *
 * state: of the car, replaced by the state reached.
 * outputs: `motion` of the state reached, and behind it what is felt in the last stage of the last step, which is the state reached
 *          but for an error of third order in the step.
 */
__attribute__((visibility("default"))) void advance(double *state, double *outputs, const double *inputs, const double *parameters,
                                                    double step_s, int steps)
{
    double rate[STATES] = {0.0}, stage[STATES], reached[STATES];
    const double *arguments[] = {stage, inputs, parameters};
    double *results[] = {rate, outputs + MOTIONS};
    while (steps-- > 0) {
        memcpy(reached, state, sizeof reached);
        for (int k = 0; k < STAGES; k++) {
            for (int i = 0; i < STATES; i++)
                stage[i] = state[i] + AHEAD[k] * step_s * rate[i];
            derivatives(arguments, results, 0, 0, 0);
            for (int i = 0; i < STATES; i++)
                reached[i] += WEIGHT[k] * step_s * rate[i];
        }
        memcpy(state, reached, sizeof reached);
    }
    const double *motion_arguments[] = {state, parameters};
    motion(motion_arguments, &outputs, 0, 0, 0);
}
