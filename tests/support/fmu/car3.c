/* A kinematic car behind the functions of FMI 3.0 that a co-simulation needs: prototypes as in fmi3FunctionTypes.h, written out here. */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>

typedef void (*Log)(void *environment, int status, const char *category, const char *message);
enum { STEER, GAS, X, Y, YAW, SPEED, YAW_RATE, X_0, SPEED_0, FAIL_AT, ZERO, AX, AY, NUMBERS };
enum { OK = 0, DISCARD = 2, ERROR = 3 };

struct Car {
    double at[NUMBERS];
    void *environment;
    Log log;
};

static void start(struct Car *car) {
    for (int k = 0; k < NUMBERS; ++k) car->at[k] = 0.0;
    car->at[FAIL_AT] = 1e9;
}

const char *fmi3GetVersion(void) { return "3.0"; }

void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, bool visible, bool logging, bool events,
                                  bool early, const uint32_t *intermediate, size_t n, void *environment, Log log, void *update) {
    (void)name; (void)token; (void)resources; (void)visible; (void)logging; (void)events; (void)early; (void)intermediate; (void)n; (void)update;
    struct Car *car = malloc(sizeof *car);
    car->environment = environment;
    car->log = log;
    start(car);
    return car;
}

void fmi3FreeInstance(void *car) { free(car); }

int fmi3EnterInitializationMode(void *instance, bool has_tolerance, double tolerance, double time, bool has_stop, double stop) {
    (void)instance; (void)has_tolerance; (void)tolerance; (void)time; (void)has_stop; (void)stop;
    return OK;
}

int fmi3ExitInitializationMode(void *instance) {
    struct Car *car = instance;
    car->at[X] = car->at[X_0];
    car->at[SPEED] = car->at[SPEED_0];
    return OK;
}

int fmi3Terminate(void *instance) { (void)instance; return OK; }
int fmi3Reset(void *instance) { start(instance); return OK; }

int fmi3GetFloat64(void *instance, const uint32_t *references, size_t n, double *values, size_t m) {
    struct Car *car = instance;
    if (n != m) return ERROR;
    for (size_t k = 0; k < n; ++k) values[k] = car->at[references[k]];
    return OK;
}

int fmi3SetFloat64(void *instance, const uint32_t *references, size_t n, const double *values, size_t m) {
    struct Car *car = instance;
    if (n != m) return ERROR;
    for (size_t k = 0; k < n; ++k) car->at[references[k]] = values[k];
    return OK;
}

int fmi3DoStep(void *instance, double time, double step, bool no_set, bool *event, bool *terminate, bool *early, double *last) {
    struct Car *car = instance;
    double *at = car->at;
    (void)no_set;
    if (time >= at[FAIL_AT]) {
        car->log(car->environment, ERROR, "logStatusError", "the road\n  has ended");
        return ERROR;
    }
    at[SPEED] += step * at[GAS];
    at[YAW_RATE] = at[SPEED] * tan(at[STEER]) / 2.5;
    at[YAW] += step * at[YAW_RATE];
    at[X] += step * at[SPEED] * cos(at[YAW]);
    at[Y] += step * at[SPEED] * sin(at[YAW]);
    at[AX] = at[GAS];
    at[AY] = at[SPEED] * at[YAW_RATE];
    *event = *terminate = *early = false;
    *last = time + step;
    return OK;
}

/* The standard wants all functions to be there. */
#define NONE(name) int fmi3##name(void) { return ERROR; }
NONE(ActivateModelPartition) NONE(CompletedIntegratorStep) NONE(DeserializeFMUState) NONE(EnterConfigurationMode)
NONE(EnterContinuousTimeMode) NONE(EnterEventMode) NONE(EnterStepMode) NONE(EvaluateDiscreteStates) NONE(ExitConfigurationMode)
NONE(FreeFMUState) NONE(GetAdjointDerivative) NONE(GetBinary) NONE(GetBoolean) NONE(GetClock) NONE(GetContinuousStateDerivatives)
NONE(GetContinuousStates) NONE(GetDirectionalDerivative) NONE(GetEventIndicators) NONE(GetFMUState) NONE(GetFloat32) NONE(GetInt16)
NONE(GetInt32) NONE(GetInt64) NONE(GetInt8) NONE(GetIntervalDecimal) NONE(GetIntervalFraction) NONE(GetNominalsOfContinuousStates)
NONE(GetNumberOfContinuousStates) NONE(GetNumberOfEventIndicators) NONE(GetNumberOfVariableDependencies) NONE(GetOutputDerivatives)
NONE(GetShiftDecimal) NONE(GetShiftFraction) NONE(GetString) NONE(GetUInt16) NONE(GetUInt32) NONE(GetUInt64) NONE(GetUInt8)
NONE(GetVariableDependencies) NONE(InstantiateModelExchange) NONE(InstantiateScheduledExecution) NONE(SerializeFMUState)
NONE(SerializedFMUStateSize) NONE(SetBinary) NONE(SetBoolean) NONE(SetClock) NONE(SetContinuousStates) NONE(SetDebugLogging)
NONE(SetFMUState) NONE(SetFloat32) NONE(SetInt16) NONE(SetInt32) NONE(SetInt64) NONE(SetInt8) NONE(SetIntervalDecimal)
NONE(SetIntervalFraction) NONE(SetShiftDecimal) NONE(SetShiftFraction) NONE(SetString) NONE(SetTime) NONE(SetUInt16) NONE(SetUInt32)
NONE(SetUInt64) NONE(SetUInt8) NONE(UpdateDiscreteStates)
