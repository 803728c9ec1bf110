/* A plant over a time in which its inputs are held, in even steps; `peak` keeps the largest |y|, 0 where nobody asks.

   Built with constants and CasADi's functions in front:
   seaopt_step: (t, x, u, p, h) -> x+, one integration step; seaopt_observe: (t, x, u, p) -> y;
   where friction sticks (STICKS) seaopt_slide: (t, x, u, p, h) -> (x+, stops), a step whose joints slide on, a fraction
   of seaopt_step, which is needed where one stops. */
#include <math.h>
#include <string.h>

static void piece(const double *p, double t, double lasting, const double *u, long steps, double *x, double *peak) {
    double h = lasting / steps, next[NX], y[NY], work[SZ_W + 1];
    const double *arg[SZ_ARG + 5];
    double *res[SZ_RES + 2];
    casadi_int iw[SZ_IW + 1];
    for (long i = 0; i < steps; i++) {
        double at = t + i * h, stops = 1.0;
        arg[0] = &at; arg[1] = x; arg[2] = u; arg[3] = p; arg[4] = &h;
        res[0] = next; res[1] = &stops;
#if STICKS
        seaopt_slide(arg, res, iw, work, 0);
#endif
        if (stops) seaopt_step(arg, res, iw, work, 0);
        memcpy(x, next, sizeof next);
        if (!peak) continue;
        at += h;
        res[0] = y;
        seaopt_observe(arg, res, iw, work, 0);
        for (int o = 0; o < NY; o++) peak[o] = fmax(peak[o], fabs(y[o]));
    }
}
