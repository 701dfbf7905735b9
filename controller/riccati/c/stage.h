/* One sample of the model at LANES stages, see stage.c. Arrays hold the lanes of each component; of matrices, of each nonzero. */
#pragma once

#include "lanes.h"

/* For a stage z and the multiplier lam of the next state: x_next, and the gradient of lam' x_next with respect to z. */
void stage_adjoint(const lanes *z, const lanes *lam, lanes *x_next, lanes *adjoint);

/* The same with x_next, its Jacobian, and the lower triangle of the Hessian of lam' x_next. */
void stage_derivatives(const lanes *z, const lanes *lam, lanes *x_next, lanes *jacobian, lanes *hessian);

/* State after a duration of constant input. */
void stage_advance(const lanes *x, const lanes *u, lanes duration_s, lanes *x_after);
