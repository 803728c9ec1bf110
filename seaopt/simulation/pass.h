/* What a pass is asked for, and what all kinds of passes need: see pass.c, lanes.c. */
#if defined(__SSE2__)
#include <xmmintrin.h>
#endif

typedef struct {
    const double *u[NU];
    const double *y[NY];           /* of MEASURED */
    const unsigned char *keep[NY]; /* NULL: all kept */
    const long *steps;             /* of each row, unless LINEAR */
    long from, to;                 /* rows of the log: first, and one past the last */
    long length;                   /* rows: inputs are clamped to them */
    long lead;                     /* rows of inputs that go before row 0 */
    long shared;                   /* derivatives that all outputs share: parameters (NQ), then a free delay, then what only
                                      the correction gain depends on */
    long drift_terms;              /* per output */
    long v_columns;                /* of v; NCP is the room for them, as NJP is for those of Z */
    long lag_a, lag_b, lag_c;      /* rows of u in force: u[k - lag_a], and so on; clamped to the log */
    long settle;                   /* rows from `start` that are left out while the filter settles */
    long start;                    /* first row of the stretch; later than `from` is not allowed */
    long output_rows;              /* rows from `from` whose outputs are kept */
    long sections;                 /* of sos */
    long loss;                     /* 0 squares, 1 Huber, 2 soft l1 */
    long warm;                     /* rows from `from` that bring the state about, and are in no sum */
    long run_up;                   /* rows before `from` through which the state goes alone, from x0 */
    double t0;                     /* time of row 0 */
    double tau0, dtau;             /* drift's coordinate, -1 to 1 over the log, at row 0, and its step */
    const struct plant_steps *plant; /* unless LINEAR, or in lanes */
    const double *model;           /* LINEAR: D (NX + NY)(NX + NI)(NJP), A (NX + NY)(NX); else the step's settings, then c */
    const double *correction;      /* CORRECT: NX x NY x NJP, gain and its derivatives */
    double *x0;                    /* NX: the state at the first row; where the state runs up alone, given at its first row and
                                      left as it is at `from` */
    const double *offset, *gain;   /* NY */
    const double *drift;           /* NY x drift_terms */
    const double *sos;             /* sections x 5: b0 b1 b2 a1 a2 */
    const double *knee;            /* NY: where a robust loss leaves the square */
    double *gram;                  /* NY x v_columns x v_columns, added to, or NULL: no sums are made; without sums, columns
                                      and influences there are no derivatives */
    double *rho;                   /* NY: sum of losses, added to; unless gram is NULL */
    double *count;                 /* NY: samples counted, added to; unless gram is NULL */
    double *outputs;               /* output_rows x NY or NULL */
    double *columns;               /* (to - from) x NY x v_columns or NULL */
    double *states;                /* (to - from) x NX or NULL */
    double *changes;               /* (to - from) x NX or NULL: of the next state, by steps of half the length from the same one; of
                                      passes without derivatives */
    double *carry;                 /* state between calls on one stretch, or NULL; see carry_size */
    influences into;               /* of estimates, into.into NULL: none */
} seaopt_pass_args;

EXPORTED const column_sums *sums; /* of sums.c, set by who loads this */

#define ONCE static __attribute__((noinline)) /* what both ways of a pass share: compiling it twice takes longer than it saves */

static inline void at(const seaopt_pass_args *a, long k, long lag, double *u) {
    long row = k - lag;
    if (row < -a->lead) row = -a->lead;
    if (row >= a->length) row = a->length - 1;
    for (int i = 0; i < NU; i++) u[i] = a->u[i][row];
}

#if !LINEAR
#define SETTINGS 3 /* of a model: period, older part of the period (fractional delay), first-order hold */

/* A reading at a place s in the period, 0 to 1, with du per unit of s: the cubic through both samples that has there the
   slopes between their neighbours (Catmull and Rom 1974). */
static inline double follow(const seaopt_pass_args *a, long k, int c, double s, double *du) {
    double w[4];
    for (int i = 0; i < 4; i++) {
        long row = k - 1 + i;
        if (row < -a->lead) row = -a->lead;
        if (row >= a->length) row = a->length - 1;
        w[i] = a->u[c][row];
    }
    const double c1 = 0.5 * (w[2] - w[0]), c3 = 0.5 * (w[3] - w[0]) + 1.5 * (w[1] - w[2]), c2 = w[2] - w[1] - c1 - c3;
    *du = c1 + s * (2.0 * c2 + 3.0 * s * c3);
    return w[1] + s * (c1 + s * (c2 + s * c3));
}
#endif

static inline double robust(const seaopt_pass_args *a, int o, double r, double *rho) {
    const double knee = a->knee[o], size = fabs(r);
    if (a->loss == 2) {
        const double part = r / knee, root = sqrt(1.0 + part * part);
        *rho = knee * knee * (root - 1.0);
        return 1.0 / root;
    }
    if (a->loss == 0 || size <= knee) {
        *rho = 0.5 * r * r;
        return 1.0;
    }
    *rho = knee * (size - 0.5 * knee);
    return knee / size;
}

/* Denormal numbers, into which sensitivities to the initial state decay, cost a hundredfold: take them as zero. */
static unsigned long flush_denormals(void) {
#if defined(__SSE2__)
    const unsigned int before = _mm_getcsr();
    _mm_setcsr(before | 0x8040);
    return before;
#elif defined(__aarch64__)
    unsigned long before;
    __asm__ volatile("mrs %0, fpcr" : "=r"(before));
    __asm__ volatile("msr fpcr, %0" : : "r"(before | (1UL << 24)));
    return before;
#else
    return 0;
#endif
}

static void restore_denormals(unsigned long before) {
#if defined(__SSE2__)
    _mm_setcsr((unsigned int)before);
#elif defined(__aarch64__)
    __asm__ volatile("msr fpcr, %0" : : "r"(before));
#else
    (void)before;
#endif
}
