/* One pass over a log: state, sensitivities, outputs, weighted residuals and their Gram matrices.

   Built with these constants in front (see seaopt/simulation/compiled.py):
     NX states, NU inputs, NY outputs, NP parameters (a free delay is the last), LINEAR 0 or 1.
   Columns of v, for each output: residual, d/dparameter (NP), d/dx0 (NX), d/doffset, d/dgain. */
#include <math.h>
#include <string.h>
#if defined(__SSE2__)
#include <xmmintrin.h>
#endif

#define NT (NP + NX)
#define NC (NT + 3)
#define MAX_SECTIONS 8

typedef struct {
    long n;                    /* samples */
    const double *u;           /* n x NU */
    const double *y;           /* n x NY, or NULL: simulate only */
    const unsigned char *keep; /* n x NY, or NULL: all kept */
    long lag_a, lag_b;         /* rows of u in force: u[k - lag_a], u[k - lag_b]; clamped to the log */
    const double *model;       /* LINEAR: F, H and derivatives; else p, then the step's settings */
    const double *x0, *offset, *gain;
    const double *sos;         /* sections x 5: b0 b1 b2 a1 a2 */
    long sections, settle;     /* samples left out while the filter settles */
    const double *knee;        /* NY: Huber's threshold on the filtered residual; infinite for squares */
    double *gram;              /* NY x NC x NC, upper triangle */
    double *rho;               /* NY: sum of losses */
    double *count;             /* NY: samples counted */
    double *outputs;           /* n x NY or NULL */
    double *columns;           /* n x NY x NC or NULL */
    double *states;            /* n x NX or NULL */
    double *last;              /* NX: state after the last sample's step, or NULL */
} seaopt_pass_args;

typedef struct {
    double X[NX], S[NT + 1][NX];       /* S[j] = dX/dtheta_j */
    double Y[NY], DY[NY][NT + 1];
#if !LINEAR
    double work[SZ_W + 1];
#endif
} state;

#if LINEAR
/* model: (1 + NP) blocks of [F (NX x NW), H (NY x NW)] with NW = NX + 2 NU + 1 and w = [x, u_a, u_b, 1]:
   x+ = F w, y = H w; the blocks after the first are the derivatives. */
#define NW (NX + 2 * NU + 1)
#define BLOCK ((NX + NY) * NW)

static void observe(state *q, const seaopt_pass_args *a, const double *ua, const double *ub, long k) {
    const double *H = a->model + NX * NW;
    double w[NW];
    for (int i = 0; i < NX; i++) w[i] = q->X[i];
    for (int i = 0; i < NU; i++) { w[NX + i] = ua[i]; w[NX + NU + i] = ub[i]; }
    w[NW - 1] = 1.0;
    (void)k;
    for (int o = 0; o < NY; o++) {
        double value = 0.0;
        for (int i = 0; i < NW; i++) value += H[o * NW + i] * w[i];
        q->Y[o] = value;
        for (int j = 0; j < NP; j++) {
            const double *dH = H + (j + 1) * BLOCK + o * NW;
            double d = 0.0;
            for (int i = 0; i < NW; i++) d += dH[i] * w[i];
            for (int i = 0; i < NX; i++) d += H[o * NW + i] * q->S[j][i];
            q->DY[o][j] = d;
        }
        for (int j = NP; j < NT; j++) {
            double d = 0.0;
            for (int i = 0; i < NX; i++) d += H[o * NW + i] * q->S[j][i];
            q->DY[o][j] = d;
        }
    }
}

static void advance(state *q, const seaopt_pass_args *a, const double *ua, const double *ub, long k) {
    const double *F = a->model;
    double w[NW], next[NX];
    (void)k;
    for (int i = 0; i < NX; i++) w[i] = q->X[i];
    for (int i = 0; i < NU; i++) { w[NX + i] = ua[i]; w[NX + NU + i] = ub[i]; }
    w[NW - 1] = 1.0;
    for (int j = 0; j < NT; j++) {
        for (int r = 0; r < NX; r++) {
            double value = 0.0;
            for (int i = 0; i < NX; i++) value += F[r * NW + i] * q->S[j][i];
            if (j < NP) {
                const double *dF = F + (j + 1) * BLOCK + r * NW;
                for (int i = 0; i < NW; i++) value += dF[i] * w[i];
            }
            next[r] = value;
        }
        for (int r = 0; r < NX; r++) q->S[j][r] = next[r];
    }
    for (int r = 0; r < NX; r++) {
        double value = 0.0;
        for (int i = 0; i < NW; i++) value += F[r * NW + i] * w[i];
        next[r] = value;
    }
    for (int r = 0; r < NX; r++) q->X[r] = next[r];
}
#else
/* CasADi's functions stand in front of this file:
     seaopt_step(t, x, u0, u1, p, h) -> x1, dx1/dx, dx1/d[p, h]     seaopt_output(t, x, u, p) -> y, dy/dx, dy/dp
   model: p (NA, of which the first NQ are differentiated), substeps, period, older part of the period (fractional delay), first-order hold flag, t0.
   NP = NQ + 1 where the delay is free too. */
static void one_step(state *q, const double *t, const double *u0, const double *u1, const double *p, const double *h, double dh) {
    double x1[NX], a[NX * NX], b[NX * (NQ + 1)], next[NX];
    const double *arg[SZ_ARG] = {t, q->X, u0, u1, p, h};
    double *res[SZ_RES] = {x1, a, b};
    seaopt_step(arg, res, 0, q->work, 0);
    for (int j = 0; j < NT; j++) { /* a and b are stored by columns */
        for (int r = 0; r < NX; r++) {
            double value = 0.0;
            for (int i = 0; i < NX; i++) value += a[i * NX + r] * q->S[j][i];
            if (j < NQ) value += b[j * NX + r];
            else if (j < NP) value += b[NQ * NX + r] * dh;
            next[r] = value;
        }
        for (int r = 0; r < NX; r++) q->S[j][r] = next[r];
    }
    for (int r = 0; r < NX; r++) q->X[r] = x1[r];
}

static void observe(state *q, const seaopt_pass_args *a, const double *ua, const double *ub, long k) {
    const double *p = a->model, *m = p + NA;
    double y[NY], c[NY * NX], d[NY * NQ + 1], t = m[4] + k * m[1];
    const double *now = (m[2] > 0.0) ? ub : ua;
    const double *arg[SZ_ARG] = {&t, q->X, now, p};
    double *res[SZ_RES] = {y, c, d};
    seaopt_output(arg, res, 0, q->work, 0);
    for (int o = 0; o < NY; o++) {
        q->Y[o] = y[o];
        for (int j = 0; j < NT; j++) {
            double value = j < NQ ? d[j * NY + o] : 0.0;
            for (int i = 0; i < NX; i++) value += c[i * NY + o] * q->S[j][i];
            q->DY[o][j] = value;
        }
    }
}

/* With a fractional delay the older input u_b acts first, for m[2] seconds, then u_a. */
static void advance(state *q, const seaopt_pass_args *a, const double *ua, const double *ub, long k) {
    const double *p = a->model, *m = p + NA;
    const long steps = (long)m[0];
    const int foh = m[3] > 0.5;
    double t = m[4] + k * m[1];
    double parts[2] = {m[2], m[1] - m[2]}, u0[NU + 1], u1[NU + 1];
    for (int part = 0; part < 2; part++) {
        const double h = parts[part] / steps, dh = (part ? -1.0 : 1.0) / steps;
        const double *from = part ? ua : ub;
        if (parts[part] <= 0.0 && !(NP > NQ)) continue;
        for (long i = 0; i < steps; i++) {
            for (int c = 0; c < NU; c++) {
                const double slope = foh ? (ub[c] - ua[c]) / steps : 0.0;
                const double base = foh ? ua[c] : from[c];
                u0[c] = base + slope * i;
                u1[c] = base + slope * (i + 1);
            }
            one_step(q, &t, u0, u1, p, &h, dh);
            t += h;
        }
    }
}
#endif

static double filtered(double value, const seaopt_pass_args *a, double (*z)[2]) {
    for (long k = 0; k < a->sections; k++) {
        const double *c = a->sos + 5 * k;
        const double out = c[0] * value + z[k][0];
        z[k][0] = c[1] * value - c[3] * out + z[k][1];
        z[k][1] = c[2] * value - c[4] * out;
        value = out;
    }
    return value;
}

static void accumulate(const state *q, const seaopt_pass_args *a, long k, double (*z)[NC][MAX_SECTIONS][2]) {
    for (int o = 0; o < NY; o++) {
        const double measured = a->y[k * NY + o];
        const int present = (a->keep ? a->keep[k * NY + o] : 1) && isfinite(measured);
        double v[NC];
        if (present) {
            v[0] = a->gain[o] * q->Y[o] + a->offset[o] - measured;
            for (int j = 0; j < NT; j++) v[1 + j] = a->gain[o] * q->DY[o][j];
            v[NC - 2] = 1.0;
            v[NC - 1] = q->Y[o];
        } else {
            for (int c = 0; c < NC; c++) v[c] = 0.0;
        }
        if (a->sections)
            for (int c = 0; c < NC; c++) v[c] = filtered(v[c], a, z[o][c]);
        if (a->columns) memcpy(a->columns + (k * NY + o) * NC, v, sizeof v);
        if (!present || k < a->settle) continue;
        const double size = fabs(v[0]), knee = a->knee[o];
        const double weight = size <= knee ? 1.0 : knee / size;
        double *gram = a->gram + o * NC * NC;
        a->rho[o] += size <= knee ? 0.5 * size * size : knee * (size - 0.5 * knee);
        a->count[o] += 1.0;
        for (int r = 0; r < NC; r++) {
            const double wr = weight * v[r];
            for (int c = 0; c < NC; c++) gram[r * NC + c] += wr * v[c];
        }
    }
}

static const double *row(const seaopt_pass_args *a, long k) {
    if (k < 0) k = 0;
    if (k >= a->n) k = a->n - 1;
    return a->u + k * NU;
}

/* Sensitivities to the initial state decay into denormal numbers, which cost a hundredfold: take them as zero. */
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

int seaopt_pass(const seaopt_pass_args *a) {
    const unsigned long mode = flush_denormals();
    state here, *const q = &here;
    double z[NY][NC][MAX_SECTIONS][2];
    memset(z, 0, sizeof z);
    memset(q, 0, sizeof here);
    for (int i = 0; i < NX; i++) { q->X[i] = a->x0[i]; q->S[NP + i][i] = 1.0; }
    if (a->gram) memset(a->gram, 0, sizeof(double) * NY * NC * NC);
    for (int o = 0; o < NY; o++) { a->rho[o] = 0.0; a->count[o] = 0.0; }
    for (long k = 0; k < a->n; k++) {
        const double *ua = row(a, k - a->lag_a), *ub = row(a, k - a->lag_b);
        observe(q, a, ua, ub, k);
        if (a->states) memcpy(a->states + k * NX, q->X, sizeof q->X);
        if (a->outputs) memcpy(a->outputs + k * NY, q->Y, sizeof q->Y);
        if (a->y) accumulate(q, a, k, z);
        if (k + 1 < a->n || a->last) advance(q, a, ua, ub, k);
    }
    if (a->last) memcpy(a->last, q->X, sizeof q->X);
    restore_denormals(mode);
    return 0;
}
