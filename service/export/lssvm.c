/* u = beta' basis + sum of alpha K(x, support). Memory, µm in the frame of the identified stage: play operators, arc
 * states, slow states, end of the path. */
#define LANES 32 /* support vectors at a time: compilers make vector instructions of loops over them */

#ifdef EXPORT_SINGLE
typedef uint32_t bits_type;
#define MANTISSA 23
#define BIAS 127
#define ROUND 12582912.0f /* 1.5 * 2^23: adding it leaves the nearest integer in the low bits */
#define LOWEST -87.0f
#define LN2_HIGH 0.693359375f
#define LN2_LOW -2.12194440e-4f
#define TERMS 6
#else
typedef uint64_t bits_type;
#define MANTISSA 52
#define BIAS 1023
#define ROUND 6755399441055744.0
#define LOWEST -708.0
#define LN2_HIGH 6.93147180369123816490e-01
#define LN2_LOW 1.90821492927058770002e-10
#define TERMS 11
#endif

/* Sum of alpha K(x, support), K(x, s) = exp(-|x - s|²); x and support are divided by the widths. The exponential
 * reduces by multiples of ln 2 and ends with the Taylor series; partial sums keep rounding small. */
static double kernel_sum(const export_real *x)
{
    static const export_real series[11] = {
        (export_real)(1.0 / 479001600.0), (export_real)(1.0 / 39916800.0), (export_real)(1.0 / 3628800.0),
        (export_real)(1.0 / 362880.0), (export_real)(1.0 / 40320.0), (export_real)(1.0 / 5040.0),
        (export_real)(1.0 / 720.0), (export_real)(1.0 / 120.0), (export_real)(1.0 / 24.0),
        (export_real)(1.0 / 6.0), (export_real)(1.0 / 2.0)};
    export_real sum[LANES] = {0};
    double total = 0.0;
    for (int at = 0; at < SUPPORT; at += LANES) {
        export_real t[LANES] = {0}, r[LANES], e[LANES] = {0};
        union {
            export_real value[LANES];
            bits_type bits[LANES];
        } power;
        for (int j = 0; j < INPUTS; j++)
            for (int l = 0; l < LANES; l++) {
                export_real apart = support[j * SUPPORT + at + l] - x[j];
                t[l] -= apart * apart;
            }
        for (int l = 0; l < LANES; l++) {
            t[l] = t[l] < (export_real)LOWEST ? (export_real)LOWEST : t[l];
            power.value[l] = t[l] * (export_real)1.4426950408889634 + ROUND;
            export_real k = power.value[l] - ROUND;
            r[l] = (t[l] - k * LN2_HIGH) - k * LN2_LOW;
            power.bits[l] = (power.bits[l] + BIAS) << MANTISSA;
        }
        for (int i = 11 - TERMS; i < 11; i++)
            for (int l = 0; l < LANES; l++)
                e[l] = e[l] * r[l] + series[i];
        for (int l = 0; l < LANES; l++)
            sum[l] += alpha[at + l] * (((r[l] * r[l]) * e[l] + r[l] + (export_real)1) * power.value[l]);
    }
    for (int l = 0; l < LANES; l++)
        total += sum[l];
    return total;
}

static void rest(double *memory, double y_um)
{
    double y = (y_um - OFFSET_UM) * PER_GAIN, *arc = memory + PLAYS, *slow = arc + ARCS;
    for (int i = 0; i < PLAYS; i++) {
        double low = y - threshold_um[i], high = y + threshold_um[i];
        memory[i] = Y_REST_UM < low ? low : Y_REST_UM > high ? high : Y_REST_UM;
    }
    for (int i = 0; i < ARCS; i++)
        arc[i] = y + (Y_REST_UM - y) * exp(-fabs(y - Y_REST_UM) / arc_um[i]);
    for (int i = 0; i < SLOW + (ARCS > 0); i++)
        slow[i] = y;
}

static void advance(double *memory, double y)
{
    double *arc = memory + PLAYS, *slow = arc + ARCS, *end = slow + SLOW;
    for (int i = 0; i < PLAYS; i++) {
        double low = y - threshold_um[i], high = y + threshold_um[i];
        memory[i] = memory[i] < low ? low : memory[i] > high ? high : memory[i];
    }
    for (int i = 0; i < SLOW; i++)
        slow[i] = y + (slow[i] - y) * retain[i];
    if (ARCS > 0) {
        /* The path is counted behind a dead band: noise at rest is no path. */
        double before = *end, low = y - DEAD_UM, high = y + DEAD_UM;
        *end = before < low ? low : before > high ? high : before;
        double path = fabs(*end - before);
        for (int i = 0; i < ARCS && path > 0.0; i++)
            arc[i] = y + (arc[i] - y) * exp(-path / arc_um[i]);
    }
}

static double voltage(double *memory, double y_um, double v, double a)
{
    double y = (y_um - OFFSET_UM) * PER_GAIN, yn = (y - CENTRE_UM) * PER_UM, vn = v * PER_GAIN * PER_UM_PER_S;
    double basis[BASIS] = {1.0}, u = 0.0, known = 0.0;
    export_real x[INPUTS];
    int at = 6;
    if (!isfinite(y))
        return NAN;
    advance(memory, y);
    x[0] = (export_real)(yn * per_width[0]);
    x[1] = (export_real)(vn * per_width[1]);
    for (int i = 2; i < INPUTS; i++) {
        int j = kernel_play[i - 2];
        x[i] = (export_real)((y - memory[j]) / threshold_um[j] * per_width[i]);
    }
#if LINEAR
    basis[1] = yn, basis[2] = vn, basis[3] = a * PER_GAIN * PER_UM_PER_S2, basis[4] = yn * yn, basis[5] = yn * yn * yn;
    for (int i = 0; i < PLAYS; i++)
        basis[at++] = (y - memory[i]) / threshold_um[i];
    for (int i = 0; i < PLAYS * ASYMMETRIC; i++, at++)
        basis[at] = basis[at - PLAYS] * yn;
    for (int i = 0; i < ARCS; i++)
        basis[at++] = (y - memory[PLAYS + i]) / arc_um[i];
    for (int i = 0; i < SLOW; i++)
        basis[at++] = (y - memory[PLAYS + ARCS + i]) * PER_UM;
#else
    (void)a, (void)at;
#endif
    for (int i = 0; i < BASIS; i++) {
        u += beta[i] * basis[i];
        known += anchor[i] * basis[i];
    }
    if (SUPPORT > 0)
        u += kernel_sum(x);
    /* Whatever was learnt, no answer is further from the identified linear part. */
    if (ANCHORED && (u < known - ALLOWED_V || u > known + ALLOWED_V))
        u = u < known ? known - ALLOWED_V : known + ALLOWED_V;
    return u;
}
