/* dehyst: evaluates the model of a dehyst service in the controller's process.
 *
 * Every function returns 0, or a negative number: -1 refused (dehyst_error says which field, what was got, what was
 * expected), -2 internal error. Units: µm, µm/s, µm/s², V, s. Doubles are IEEE.
 *
 * Threads: one thread at a time uses a handle, except that dehyst_update may be called by another one meanwhile.
 * dehyst_point, dehyst_block and dehyst_warm neither lock nor allocate, whatever dehyst_update does; only the text of a refusal is
 * allocated.
 */
#ifndef DEHYST_H
#define DEHYST_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct dehyst dehyst;

/* Limits of the axis, as the status of the service has them. No limit: -INFINITY or INFINITY (not for u_min, u_max). */
typedef struct {
    double u_min_V, u_max_V, slew_V_per_s, y_min_um, y_max_um;
} dehyst_limits;

/* Bits of flags; docs/protocol.md, "Feedforward reply". */
enum {
    DEHYST_LIMITED_VOLTAGE = 1,
    DEHYST_LIMITED_SLEW = 2,
    DEHYST_OUTSIDE_DOMAIN = 4,
    DEHYST_NOT_FINITE_REPLACED = 8,
    DEHYST_BLENDED = 16,
    DEHYST_STAND_IN = 32,
    DEHYST_STALE = 64,
    DEHYST_CORRECTED = 128
};

typedef struct {
    double u_V;     /* finite, within the limits (from a voltage outside: nearer), within the slew limit */
    double std_V;   /* one standard deviation; NaN where the model has none */
    uint32_t flags;
} dehyst_answer;

typedef struct {
    int64_t snapshot_seq;        /* last sample that the model in use has seen; -1 before any */
    uint64_t received, refused;  /* payloads, the first one included */
    uint64_t answered;           /* points */
    double age_s;                /* since the model in use arrived */
    double trust;                /* weight of the model inside its domain, 0 to 1 */
    double dt_s;                 /* distance of points */
    double gain, offset_um;      /* frame of the learning model; 1 and 0 for a model without one */
    dehyst_answer last;
    uint32_t memory_size, stale;
    char source[132];            /* model of the last voltage: "A+B" where B was blended in; empty where held */
} dehyst_report_t;

/* 1, the version of the wire and of this interface. */
uint32_t dehyst_version(void);

/* Text of the last error of this thread; valid until its next call. */
const char *dehyst_error(void);

/* A handle from the payload of `.../model` (kind 6) and the limits. */
int dehyst_open_payload(const uint8_t *payload, size_t bytes, const dehyst_limits *limits, dehyst **handle);

/* A newer payload of the same model, from any thread: a whole model (kind 6) or a change (kind 7), of `.../model`,
 * `.../model_delta` or `.../champion_delta`. Refused payloads are counted and change nothing. Returns 1
 * (DEHYST_WHOLE_NEEDED) where the whole model of a change has not come: query `.../model?name=NAME;changes=1` and give the
 * answer to this function, unless a whole model comes before. */
#define DEHYST_WHOLE_NEEDED 1
int dehyst_update(dehyst *handle, const uint8_t *payload, size_t bytes);

/* Begin from the memory of the newest payload: that after sample snapshot_seq of the report. u_before_V: voltage from
 * which the slew limit counts; NAN: none. Then dehyst_advance along what was commanded for the samples since. */
int dehyst_start(dehyst *handle, double u_before_V);

/* Memory after n points that were commanded with these voltages, without an answer. */
int dehyst_advance(dehyst *handle, size_t n, const double *y_um, const double *u_V);

/* The voltage for the next point of the wanted motion. */
int dehyst_point(dehyst *handle, double y_um, double v_um_per_s, double a_um_per_s2, dehyst_answer *answer);

/* Correct the voltages by fresh readings (docs/correction.md): by an integral of the residual, and motion that repeats by
 * the pass before. Settings as the status of the service has them under "correction" and "repetition"; NULL: not so. Per
 * sample: dehyst_read what has come, dehyst_number of the next point unless it counts on, then the point. This function
 * allocates and takes some milliseconds; the others, and a point that they correct, do not allocate. */
typedef struct {
    double share;    /* largest correction as a share of the voltage range, above 0, up to 1 */
    double mode_Hz;  /* lowest frequency at which the stage rings, with the heaviest payload, Hz */
    double fade_s;   /* time over which a correction without good readings is let go, s */
} dehyst_correction;
int dehyst_correct(dehyst *handle, const dehyst_correction *integral, const dehyst_correction *repetition);

/* The motion from the next point on repeats with period_s, 16 to 4096 samples, in s; NAN: find it. What was learnt of the
 * motion before is let go. */
int dehyst_period(dehyst *handle, double period_s);

/* The next point is for sample seq (0 to 2^62). Without a number nothing is corrected. */
int dehyst_number(dehyst *handle, int64_t seq);

/* n readings of samples, um, rising numbers. Those that were taken before are left out; an error changes nothing. */
int dehyst_read(dehyst *handle, size_t n, const int64_t *seq, const double *y_um);

/* One of the two corrections; all 0 where it is off. */
typedef struct {
    double u_V;                /* what it adds to the voltage, V */
    double factor;             /* share of its gain in use; what grows or oscillates halves it */
    uint64_t halved, doubted;  /* times that its gain was halved, readings that were not used */
} dehyst_added;

/* on 0 lets the corrections go, over fade_s. corrected may be NULL. */
typedef struct {
    dehyst_added integral, repetition;
    double noise_um;  /* standard deviation of a reading, um; NAN without an integral */
    double period;    /* of the motion, in samples, stated or found; NAN: none */
    int64_t age;      /* samples from a reading to the voltage that it changes */
    uint32_t active;  /* 1: the last point was corrected by the pass before, and the integral stays as it is */
} dehyst_corrected_t;
int dehyst_corrected(dehyst *handle, int on, dehyst_corrected_t *corrected);

/* Evaluate a point on a copy of the memory and throw the answer away. Called some 50 us before dehyst_point with about the
 * same motion, it loads what a point reads into the caches. Memory, slew limit and report stay as they are. */
int dehyst_warm(dehyst *handle, double y_um, double v_um_per_s, double a_um_per_s2);

/* The voltages for the next n points, dt_s apart. v and a may be NULL for 0. Outputs have n elements. */
int dehyst_block(dehyst *handle, size_t n, const double *y_um, const double *v_um_per_s, const double *a_um_per_s2,
                 double *u_V, double *std_V, uint8_t *flags);

/* The reply (kind 5) to a query (kind 4) as the service gives it; age_s: of the newest sample, NAN: none. Changes
 * nothing in the handle. Allocates: to compare, not for a loop. On a reply longer than room only length is set. */
int dehyst_query(dehyst *handle, const uint8_t *query, size_t bytes, double age_s, uint8_t *reply, size_t room,
                 size_t *length);

/* Copy the hysteresis memory, memory_size doubles of the report. */
int dehyst_memory(dehyst *handle, double *memory, size_t room);

int dehyst_report(dehyst *handle, dehyst_report_t *report);

/* NULL is allowed. */
void dehyst_close(dehyst *handle);

#ifdef __cplusplus
}
#endif
#endif
