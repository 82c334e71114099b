/* ORIGIN
 *
 * One state per axis. Ask for each sample of the motion once and in order, one sample time apart: hysteresis has memory.
 *
 *     export_state axis;
 *     export_init(&axis, y_now_um);       at rest at this displacement, reached in one move from the rest position
 *     axis.u_V = voltage_now;             optional: the first step then keeps the slew limit too
 *     u_V = export_step(&axis, y_um, v_um_per_s, a_um_per_s2);
 *
 * Define EXPORT_SINGLE for this header and for export.c alike to compute in single precision: the support vectors are
 * then floats. What adds up from sample to sample, the memory, stays in double: there are few such numbers, and
 * single precision would round away what a slow state moves in one sample. Do not compile with -ffast-math. */
#ifndef EXPORT_H
#define EXPORT_H

#ifdef __cplusplus
extern "C" {
#endif

#ifdef EXPORT_SINGLE
typedef float export_real;
#define EXPORT_ERROR_V ERROR_SINGLE /* largest error of a voltage against the model in double, V, for equal inputs */
#else
typedef double export_real;
#define EXPORT_ERROR_V ERROR_DOUBLE /* largest difference of a voltage from the model in Python, V */
#endif

#define EXPORT_DT_S SAMPLE_TIME_S /* sample time, s */

/* Bits of the flags, as in the protocol of the service. */
#define EXPORT_LIMITED_VOLTAGE 1 /* the voltage was cut to the limits */
#define EXPORT_LIMITED_SLEW 2    /* the step from the voltage before was cut */
#define EXPORT_OUTSIDE_DOMAIN 4  /* the motion is outside the learnt range: the voltage is a guess */
#define EXPORT_REPLACED 8        /* refused, not finite or beyond the displacement limits: the voltage before is held */

typedef struct {
    double memory[MEMORY_SIZE]; /* of the hysteresis */
    double u_V;                 /* voltage before, V; NaN: none yet */
    int flags;                  /* of the last voltage */
} export_state;

/* Begin at rest at y_um, µm. */
void export_init(export_state *axis, export_real y_um);

/* Voltage, V, for the next sample: wanted displacement µm, velocity µm/s and acceleration µm/s². */
export_real export_step(export_state *axis, export_real y_um, export_real v_um_per_s, export_real a_um_per_s2);

#ifdef __cplusplus
}
#endif
#endif
