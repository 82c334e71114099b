/* ORIGIN
 * export.h says how to use it. C99; needs the C library's math.h alone; allocates nothing. */
#include "export.h"

#include <math.h>
#include <stdint.h>

#ifdef __FAST_MATH__
#error "compile without -ffast-math: NaN and the order of operations have a meaning here"
#endif

TABLES

MODEL

/* The one rule of the service for what may leave: finite, within the limits, no further than STEP_V from before. */
static double limit(double u, double before, int *flags)
{
    int known = isfinite(before);
    if (!isfinite(u)) {
        u = known ? before : 0.5 * (U_MIN_V + U_MAX_V);
        *flags |= EXPORT_REPLACED;
    }
    if (u < U_MIN_V || u > U_MAX_V) {
        u = u < U_MIN_V ? U_MIN_V : U_MAX_V;
        *flags |= EXPORT_LIMITED_VOLTAGE;
    }
    if (known && (u > before + STEP_V || u < before - STEP_V)) {
        u = u > before ? before + STEP_V : before - STEP_V;
        *flags |= EXPORT_LIMITED_SLEW;
    }
    return u;
}

void export_init(export_state *axis, export_real y_um)
{
    rest(axis->memory, isfinite(y_um) ? (double)y_um : 0.0);
    axis->u_V = NAN;
    axis->flags = 0;
}

export_real export_step(export_state *axis, export_real y_um, export_real v_um_per_s, export_real a_um_per_s2)
{
    double y = y_um, v = v_um_per_s, a = a_um_per_s2, u = NAN;
    int flags = EXPORT_OUTSIDE_DOMAIN;
    if (isfinite(y) && isfinite(v) && isfinite(a) && y >= Y_MIN_UM && y <= Y_MAX_UM)
        u = voltage(axis->memory, y, v, a);
    if (y >= domain[0] && y <= domain[1] && v >= domain[2] && v <= domain[3] && a >= domain[4] && a <= domain[5])
        flags = 0;
    axis->u_V = limit(u, axis->u_V, &flags);
    axis->flags = flags;
    return (export_real)axis->u_V;
}
