/* The inverse of a Bouc-Wen stage; memory: last voltage u and hysteresis g, V. On the branch that leaves (u, g) the
 * drive u - g has to become what the motion needs. With q = sign(du) g this is q' = ALPHA - rate q along |du|, and
 * rate depends on the sign of q. Below FLAT, 1/V, a line replaces the exponential. */
#define FLAT 1e-7

static double grow(double q, double s, double rate)
{
    return fabs(rate) < FLAT ? q + ALPHA * s : q - (q - ALPHA / rate) * -expm1(-rate * s);
}

/* Change of the voltage until q < 0 has grown to zero; infinite where it never does. */
static double crossing(double q, double rate)
{
    if (fabs(rate) < FLAT)
        return ALPHA > 0.0 ? -q / ALPHA : INFINITY;
    if (ALPHA <= 0.0 || -q * rate / ALPHA <= -1.0)
        return INFINITY;
    return log1p(-q * rate / ALPHA) / rate;
}

/* Root s of s - (q(s) - q) = target, by Newton's method from the side where it cannot overshoot. */
static double solve(double q, double target, double rate)
{
    double span = q - ALPHA / rate, s = target / (1.0 - ALPHA + rate * q);
    if (fabs(rate) < FLAT)
        return target / (1.0 - ALPHA);
    for (int i = 0; i < 60; i++) {
        double shrink = expm1(-rate * s);
        double step = (s - span * shrink - target) / (1.0 + span * rate * (shrink + 1.0));
        s -= step;
        if (fabs(step) <= 1e-15 * (1.0 + s))
            break;
    }
    return s > 0.0 ? s : 0.0;
}

static double voltage(double *memory, double y, double v, double a)
{
    double bound = ALPHA / (BETA + GAMMA), u = memory[0], g = memory[1], s = 0.0;
    double w = (y - OFFSET_UM + LAG_S * v + INERTIA_S2 * a) * V_PER_UM;
    if (!isfinite(w))
        return NAN;
    g = g > bound ? bound : g < -bound ? -bound : g;
    double target = w - (u - g), sign = target > 0.0 ? 1.0 : -1.0, q = sign * g, rate = BETA + GAMMA;
    target = fabs(target);
    if (q < 0.0) {
        double zero = crossing(q, BETA - GAMMA);
        if (target < zero + q) {
            rate = BETA - GAMMA;
        } else {
            s = zero;
            target -= zero + q;
            q = 0.0;
        }
    }
    double rise = solve(q, target, rate);
    memory[0] = u + sign * (s + rise);
    memory[1] = sign * grow(q, rise, rate);
    return memory[0];
}

static void rest(double *memory, double y_um)
{
    memory[0] = memory[1] = 0.0;
    (void)voltage(memory, y_um, 0.0, 0.0);
}
