/* Problems that were solved when this library was exported, and the answers of then. */
#pragma once

#include "nmpc.h"

typedef struct {
    const char *name;
    nmpc_problem problem;
    int status;                         /* an nmpc_status */
    const double *w, *lam_w, *lam_g;    /* shaped as those that nmpc_solve fills in */
} test_vector;

extern const test_vector TEST_VECTORS[];
extern const int TEST_VECTOR_COUNT;
