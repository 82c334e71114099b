/* dehyst over zenoh: a handle that a service feeds. Link libdehyst_zenoh, which has the functions of dehyst.h too. */
#ifndef DEHYST_ZENOH_H
#define DEHYST_ZENOH_H

#include "dehyst.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Connect to the service of a stage and axis, fetch its model and limits, and follow the model from then on.
 * endpoint: such as "tcp/127.0.0.1:7447", several with commas between. model: "" for the service's default.
 * timeout_s: longest time until the first model is there. The handle is used and closed as in dehyst.h. */
int dehyst_open(const char *endpoint, const char *stage, const char *axis, const char *model, double timeout_s,
                dehyst **handle);

#ifdef __cplusplus
}
#endif
#endif
