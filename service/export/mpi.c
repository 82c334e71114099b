/* The inverse of a modified Prandtl-Ishlinskii model; memory: the states of the inverse plays, µm. */
static double voltage(double *memory, double y, double v, double a)
{
    double lead = y - Y_REF_UM + LAG_S * v, x = 0.0, u = 0.0;
    (void)a;
    if (!isfinite(lead))
        return NAN;
    for (int j = 0; j < ZONES; j++)
        if (zone_um[j] <= 0.0 || lead > zone_um[j])
            x += zone_weight[j] * (zone_um[j] > 0.0 ? lead - zone_um[j] : lead);
    x -= C_UM;
    for (int i = 0; i < PLAYS; i++) {
        double low = x - play_um[i], high = x + play_um[i];
        memory[i] = memory[i] < low ? low : memory[i] > high ? high : memory[i];
        u += play_V_per_um[i] * memory[i];
    }
    return u;
}

static void rest(double *memory, double y_um)
{
    for (int i = 0; i < PLAYS; i++)
        memory[i] = 0.0;
    (void)voltage(memory, y_um, 0.0, 0.0);
}
