/* A law over samples whose inputs are numbers, one run after the other.

   Built with constants and CasADi's function in front (see seaopt/control/running/law_step.py):
   seaopt_step: (kept, c, r, y, w, place) -> (kept+, command), the law at one sample. */
#include <string.h>

typedef struct {
    long n;                            /* samples */
    const double *c;                   /* the law's numbers */
    const double *r, *y, *w, *place;   /* n, n x NY, n x NW, n where there is a schedule */
    double *kept, *out;                /* NK, in and out; n */
} seaopt_law_args;

static void run(const seaopt_law_args *a) {
    double kept[NK], after[NK], work[SZ_W + 1];
    const double *arg[SZ_ARG + 6];
    double *res[SZ_RES + 2];
    casadi_int iw[SZ_IW + 1];
    memcpy(kept, a->kept, sizeof kept);
    for (long k = 0; k < a->n; k++) {
        arg[0] = kept; arg[1] = a->c; arg[2] = a->r + k; arg[3] = a->y + k * NY; arg[4] = a->w + k * NW;
        arg[5] = a->place + k * NP;
        res[0] = after; res[1] = a->out + k;
        seaopt_step(arg, res, iw, work, 0);
        memcpy(kept, after, sizeof kept);
    }
    memcpy(a->kept, kept, sizeof kept);
}

#if defined(_WIN32)
__declspec(dllexport)
#else
__attribute__((visibility("default")))
#endif
int seaopt_laws(const seaopt_law_args *runs, long count) {
    for (long i = 0; i < count; i++) run(runs + i);
    return 0;
}
