/* Sampled closed loops, sample by sample, one run after the other.

   Built with constants, CasADi's functions and piece.h in front (see seaopt/control/running/loop_kernel.py);
   seaopt_sample: (t, x, z, e, r, w, p, c, lag) -> (z+, u, late, y), sensor, law and delay at one sample. */

typedef struct {
    long n, substeps, finest;  /* samples; steps of the coarse solution in a sample, the fine one takes twice as many;
                                  those of the coarse one up to which both are doubled where they differ by more than most */
    double t0, period, late_s; /* after late_s of a sample the current `late` follows that of u */
    const double *p, *c, *lag; /* parameters, the law's numbers, which of the commands are in force */
    const double *most;        /* NX */
    const double *r, *w, *e;   /* n, n x NW, n x NE */
    double *x, *z;             /* in and out */
    double *peak, *error, *size; /* NY, NX, NX: largest |y| over all fine steps, |fine - coarse| and |x| */
    double *y, *applied, *states; /* n x NY, n, n x NX */
} seaopt_loop_args;

static void integrate(const seaopt_loop_args *a, double t, const double *u, const double *newer, long steps, double *x, double *peak) {
    if (a->late_s > 0.0) {
        double unmoved[NX];
        piece(a->p, t, a->late_s, u, steps, x, peak);
        memcpy(unmoved, x, sizeof unmoved);
        if (peak) piece(a->p, t + a->late_s, INSTANT * a->period, newer, 1, unmoved, peak); /* an output that the command reaches at once */
    }
    piece(a->p, t + a->late_s, a->period - a->late_s, newer, steps, x, peak);
}

static int agree(const seaopt_loop_args *a, const double *fine, const double *coarse) {
    for (int i = 0; i < NX; i++)
        if (!(fabs(fine[i] - coarse[i]) <= a->most[i])) return 0;
    return 1;
}

static inline double larger(double old, double value) { return value > old || value != value ? value : old; }

static void run(const seaopt_loop_args *a) {
    double x[NX], z[NZ + 1], after[NZ + 1], u[NU], newer[NU], coarse[NX], fine[NX], top[NY], work[SZ_W + 1];
    const double *arg[SZ_ARG + 9];
    double *res[SZ_RES + 4];
    casadi_int iw[SZ_IW + 1];
    int lost = 0; /* a state that is not finite stays so: nothing more to integrate */
    memcpy(x, a->x, sizeof x);
    memcpy(z, a->z, NZ * sizeof *z);
    for (long k = 0; k < a->n; k++) {
        double t = a->t0 + k * a->period;
        arg[0] = &t; arg[1] = x; arg[2] = z; arg[3] = a->e + k * NE; arg[4] = a->r + k; arg[5] = a->w + k * NW;
        arg[6] = a->p; arg[7] = a->c; arg[8] = a->lag;
        res[0] = after; res[1] = u; res[2] = newer; res[3] = a->y + k * NY;
        seaopt_sample(arg, res, iw, work, 0);
        memcpy(z, after, NZ * sizeof *z);
        for (int i = 1; i < NU; i++) newer[i] = u[i];
        memcpy(a->states + k * NX, x, sizeof x);
        a->applied[k] = newer[0];
        for (int i = 0; i < NY; i++) a->peak[i] = larger(a->peak[i], fabs(a->y[k * NY + i]));
        if (lost) continue;
        memcpy(fine, x, sizeof x);
        integrate(a, t, u, newer, a->substeps, fine, 0);
        for (long steps = a->substeps; steps <= a->finest; steps *= 2) {
            memcpy(coarse, fine, sizeof fine);
            memcpy(fine, x, sizeof x);
            memcpy(top, a->peak, sizeof top);
            integrate(a, t, u, newer, 2 * steps, fine, top);
            if (agree(a, fine, coarse)) break;
        }
        memcpy(x, fine, sizeof x);
        memcpy(a->peak, top, sizeof top);
        for (int i = 0; i < NX; i++) {
            a->error[i] = larger(a->error[i], fabs(x[i] - coarse[i]));
            a->size[i] = larger(a->size[i], fabs(x[i]));
            lost |= !isfinite(x[i]);
        }
    }
    memcpy(a->x, x, sizeof x);
    memcpy(a->z, z, NZ * sizeof *z);
}

#if defined(_WIN32)
__declspec(dllexport)
#else
__attribute__((visibility("default")))
#endif
int seaopt_loops(const seaopt_loop_args *runs, long count) {
    for (long i = 0; i < count; i++) run(runs + i);
    return 0;
}
