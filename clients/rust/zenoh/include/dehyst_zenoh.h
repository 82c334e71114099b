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

/* Bytes to and from the keys of an axis, without a model, for a stage or a controller that asks the service ahead. A
 * key is what follows dehyst/v1/STAGE/AXIS/ in docs/protocol.md, which has the payloads. All return 0, or another status
 * with the reason in dehyst_error(). These functions allocate and wait: keep them out of a loop with hard deadlines. */
typedef struct dehyst_link dehyst_link;

/* receive: the key that dehyst_link_receive takes payloads from, such as "command"; NULL for none. */
int dehyst_link_open(const char *endpoint, const char *stage, const char *axis, const char *receive, double timeout_s,
                     dehyst_link **link);

/* Publish n samples of the stage, 1 to 65536: what the service learns from. seq: their numbers, one for each sample time,
 * rising; t_s: their times, s; u_V: voltages applied from these times on, V; y_um: readings at these times, um, NaN
 * where there is none. Signed with the key of the service where there is one. Waits while the wire is full, so that
 * nothing is dropped. A link may be used by several threads at a time, but numbers have to arrive in order. */
int dehyst_samples(const dehyst_link *link, size_t n, const int64_t *seq, const double *t_s, const double *u_V,
                   const double *y_um);

/* Publish a payload. Waits while the wire is full, so that nothing is dropped. The first one on "command" makes this link
 * the owner of the axis' voltages until it is closed; while another controller owns them, it is an error that names it. */
int dehyst_link_send(const dehyst_link *link, const char *key, const uint8_t *payload, size_t bytes);

/* Own the voltages from now on. force: not 0, although another controller does, whose commands are then left out. */
int dehyst_take_command(const dehyst_link *link, int force);

/* The next payload that came; *bytes is 0 where none came within wait_s. One thread at a time. */
int dehyst_link_receive(const dehyst_link *link, double wait_s, uint8_t *payload, size_t room, size_t *bytes);

/* The reply to a query with a payload, such as one of kind 4 on "feedforward"; waits up to the time-out. */
int dehyst_link_ask(const dehyst_link *link, const char *key, const uint8_t *query, size_t query_bytes, uint8_t *reply,
                    size_t room, size_t *bytes);

void dehyst_link_close(dehyst_link *link);

#ifdef __cplusplus
}
#endif
#endif
