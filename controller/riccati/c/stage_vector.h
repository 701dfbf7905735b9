/* Rows of a stage's matrices: NZ numbers, with room up to a multiple of LANES, so that they can be worked on LANES at a time. */
#pragma once

#include "lanes.h"
#include "problem_size.h"

enum { STAGE_LANES = (N_STATES + N_INPUTS + LANES - 1) / LANES, STAGE_ROOM = STAGE_LANES * LANES };

typedef double stage_row[STAGE_ROOM] __attribute__((aligned(8 * LANES)));

typedef struct {
    lanes part[STAGE_LANES];
} stage_vector;

static inline stage_vector load(const double *row)
{
    stage_vector vector;
    for (int i = 0; i < STAGE_LANES; i++) vector.part[i] = ((const lanes *)row)[i];
    return vector;
}

static inline void store(double *row, stage_vector vector)
{
    for (int i = 0; i < STAGE_LANES; i++) ((lanes *)row)[i] = vector.part[i];
}

static inline stage_vector scaled(double factor, const double *row)
{
    stage_vector vector;
    for (int i = 0; i < STAGE_LANES; i++) vector.part[i] = factor * ((const lanes *)row)[i];
    return vector;
}

/* vector + factor * row */
static inline stage_vector plus(stage_vector vector, double factor, const double *row)
{
    for (int i = 0; i < STAGE_LANES; i++) vector.part[i] += factor * ((const lanes *)row)[i];
    return vector;
}

/* Component by component. */
static inline stage_vector product(const double *a, const double *b)
{
    stage_vector vector;
    for (int i = 0; i < STAGE_LANES; i++) vector.part[i] = ((const lanes *)a)[i] * ((const lanes *)b)[i];
    return vector;
}
