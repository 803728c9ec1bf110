/* Newton's method from above falls until it is there. */
static double root(double value)
{
    double next = (value > 1.0) ? value : 1.0;
    double x = 0.0;

    if (value > 0.0) {
        do {
            x = next;
            next = 0.5 * (x + (value / x));
        } while (next < x);
    }
    return x;
}

static double resistance_at(double rise)
{
    return RESISTANCE + (RESISTANCE_SLOPE * rise);
}

/* The largest command after which the winding has come no nearer to its largest temperature than by its share. */
static double cool_command(double rise_winding, double rise_case)
{
    const double free = (HEAT_A[0][0] * rise_winding) + (HEAT_A[0][1] * rise_case);
    const double target = rise_winding + (APPROACH * (ALLOWED_RISE - rise_winding));

    return root((target - free) / (HEAT_B[0] * resistance_at(target)));
}

/* Both rises after a sample of a command. */
static void warm(double *rise_winding, double *rise_case, double command)
{
    const double winding = *rise_winding;
    const double squared = command * command;
    const double free = (HEAT_A[0][0] * winding) + (HEAT_A[0][1] * *rise_case);
    const double end = free + ((HEAT_B[0] * resistance_at(winding)) * squared);
    const double loss = resistance_at((end > winding) ? end : winding) * squared;

    *rise_case = ((HEAT_A[1][0] * winding) + (HEAT_A[1][1] * *rise_case)) + (HEAT_B[1] * loss);
    *rise_winding = free + (HEAT_B[0] * loss);
}
