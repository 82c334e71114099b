/* FMI 2.0 for co-simulation around export.h. Value references: 0 to 2 y, v, a; 3 u; 4 flags; 5 y at the start. */
#include "export.h"

#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

typedef void (*logger_type)(void *, const char *, int, const char *, const char *, ...);
typedef struct {
    export_state axis;
    double real[6];
    int started;
    logger_type logger;
    void *environment;
} instance;

#define API __attribute__((visibility("default")))

static int failed(instance *c, const char *text)
{
    if (c->logger)
        c->logger(c->environment, "export", 3, "logStatusError", "%s", text);
    return 3;
}

/* Functions without an effect here, and those that this model does not offer; the standard wants all of them. */
#define NOTHING(name)                                                                                                  \
    API int name(void *c)                                                                                              \
    {                                                                                                                  \
        return c ? 0 : 3;                                                                                              \
    }
#define NOT_OFFERED(name)                                                                                              \
    API int name(void *c)                                                                                              \
    {                                                                                                                  \
        return failed(c, #name ": this model does not offer it");                                                      \
    }
NOTHING(fmi2SetDebugLogging)
NOTHING(fmi2SetupExperiment)
NOTHING(fmi2EnterInitializationMode)
NOTHING(fmi2Terminate)
NOT_OFFERED(fmi2SetInteger)
NOT_OFFERED(fmi2GetBoolean)
NOT_OFFERED(fmi2SetBoolean)
NOT_OFFERED(fmi2GetString)
NOT_OFFERED(fmi2SetString)
NOT_OFFERED(fmi2GetFMUstate)
NOT_OFFERED(fmi2SetFMUstate)
NOT_OFFERED(fmi2FreeFMUstate)
NOT_OFFERED(fmi2SerializedFMUstateSize)
NOT_OFFERED(fmi2SerializeFMUstate)
NOT_OFFERED(fmi2DeSerializeFMUstate)
NOT_OFFERED(fmi2GetDirectionalDerivative)
NOT_OFFERED(fmi2SetRealInputDerivatives)
NOT_OFFERED(fmi2GetRealOutputDerivatives)
NOT_OFFERED(fmi2CancelStep)
NOT_OFFERED(fmi2GetStatus)
NOT_OFFERED(fmi2GetRealStatus)
NOT_OFFERED(fmi2GetIntegerStatus)
NOT_OFFERED(fmi2GetBooleanStatus)
NOT_OFFERED(fmi2GetStringStatus)

API const char *fmi2GetTypesPlatform(void)
{
    return "default";
}

API const char *fmi2GetVersion(void)
{
    return "2.0";
}

API int fmi2Reset(instance *c)
{
    memset(c->real, 0, sizeof c->real);
    c->real[0] = c->real[5] = Y_START_UM;
    c->started = 0;
    return 0;
}

/* callbacks: logger, allocate, free, step finished, environment */
API void *fmi2Instantiate(const char *name, int type, const char *guid, const char *resources, void *const *callbacks)
{
    instance *c = calloc(1, sizeof *c);
    (void)name, (void)resources;
    if (!c)
        return NULL;
    memcpy(&c->logger, callbacks, sizeof c->logger);
    c->environment = callbacks[4];
    if (type != 1 || strcmp(guid, "GUID")) {
        failed(c, "fmi2Instantiate: expected co-simulation and the GUID of modelDescription.xml");
        free(c);
        return NULL;
    }
    fmi2Reset(c);
    return c;
}

API void fmi2FreeInstance(instance *c)
{
    free(c);
}

API int fmi2ExitInitializationMode(instance *c)
{
    export_init(&c->axis, c->real[5]);
    export_state trial = c->axis;
    c->real[3] = export_step(&trial, c->real[5], 0.0, 0.0);
    c->started = 1;
    return 0;
}

API int fmi2GetReal(instance *c, const unsigned reference[], size_t n, double value[])
{
    for (size_t i = 0; i < n; i++) {
        if (reference[i] > 5 || reference[i] == 4)
            return failed(c, "fmi2GetReal: no such value reference");
        value[i] = c->real[reference[i]];
    }
    return 0;
}

API int fmi2SetReal(instance *c, const unsigned reference[], size_t n, const double value[])
{
    for (size_t i = 0; i < n; i++) {
        if (reference[i] > 2 && (reference[i] != 5 || c->started))
            return failed(c, "fmi2SetReal: not an input, or the start after the initialization");
        c->real[reference[i]] = value[i];
    }
    return 0;
}

API int fmi2GetInteger(instance *c, const unsigned reference[], size_t n, int value[])
{
    for (size_t i = 0; i < n; i++) {
        if (reference[i] != 4)
            return failed(c, "fmi2GetInteger: no such value reference");
        value[i] = c->axis.flags;
    }
    return 0;
}

API int fmi2DoStep(instance *c, double time_s, double step_s, int keep)
{
    double steps = step_s / EXPORT_DT_S, whole = floor(steps + 0.5);
    (void)time_s, (void)keep;
    if (!c->started || whole < 1.0 || fabs(steps - whole) > 1e-6 * whole)
        return failed(c, "fmi2DoStep: expected a step of a whole number of sample times, after the initialization");
    for (; whole > 0.0; whole -= 1.0)
        c->real[3] = export_step(&c->axis, c->real[0], c->real[1], c->real[2]);
    return 0;
}
