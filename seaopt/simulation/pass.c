/* Passes over stretches of a log: state, sensitivities, outputs, weighted residuals and their Gram matrices.

   Built with constants, sums.h and layout.h in front (see seaopt/simulation/compiled.py).

   Every array that is summed over derivatives has them last and padded to whole vectors: Z[i][0] is the state x_i and
   Z[i][j] its derivative to unknown j, so that one loop over j advances all.

   Columns of v, for each output: residual, shared, initial state (NX), then the output's own: offset, drift, gain. With
   a correction the own columns of every output act on the state: then v holds those of all. */
/* What goes on from one sample to the next. */
typedef struct {
    double z[NX][NJP];
    double filter[NY][MAX_SECTIONS][2][NCP];
} state;

#define BLOCK 16
#define ALL (NJP / 4) /* vectors of a row of Z */
#define DERIVED(wide) (MEASURED && (wide) == ALL) /* whether derivatives are made, but for what shares a vector with x */
/* All that a sample touches stands close together. */
typedef struct {
    double z[NX][NJP], next[NX][NJP], y[NY][NJP];
    double v[NY][BLOCK][NCP], weight[NY][BLOCK]; /* samples that wait to be summed */
    double sum[NY][NCP][NCP];
    long waiting[NY];
    double filter[NY][MAX_SECTIONS][2][NCP];
#if LINEAR
    double model[(NX + NY) * (NX + (NX + NI) * NJP)] __attribute__((aligned(32)));
#else
    double work[SZ_W + 1];
#endif
    double rho[NY], count[NY];
} hot __attribute__((aligned(32)));

#if LINEAR
#define NF (NX + NI)

/* Rows of [x+; y] with all derivatives: A Z + D [x; forcing]. */
INLINE void rows(const double *restrict model, const double (*restrict z)[NJP], const double *restrict w, int first, int count,
                 double (*restrict out)[NJP], int wide) {
    const double *A = model + (NX + NY) * NF * NJP + first * NX, *D = model + first * NF * NJP;
    for (int r = 0; r < count; r++) {
        for (int j = 0; j < wide; j++) {
            vec sum = {0.0, 0.0, 0.0, 0.0};
            for (int i = 0; i < NX; i++) sum += A[r * NX + i] * ((const vec *)z[i])[j];
            for (int i = 0; i < NF; i++) sum += w[i] * ((const vec *)(D + (r * NF + i) * NJP))[j];
            ((vec *)out[r])[j] = sum;
        }
    }
}

static inline void forcing(const hot *q, const seaopt_pass_args *a, long k, double *w) {
    double u[NU];
    for (int i = 0; i < NX; i++) w[i] = q->z[i][0];
    at(a, k, a->lag_a, u);
    for (int i = 0; i < NU && i < NI; i++) w[NX + i] = u[i];
#if DELAYED
    at(a, k, a->lag_b, u);
    for (int i = 0; i < NU; i++) w[NX + NU + i] = u[i];
#endif
#if DELAYED > 1
    at(a, k, a->lag_c, u);
    for (int i = 0; i < NU; i++) w[NX + 2 * NU + i] = u[i];
#endif
    if (NI > NU * (1 + DELAYED)) w[NF - 1] = 1.0;
}

INLINE void observe(hot *q, const seaopt_pass_args *a, long k, double (*restrict y)[NJP], int wide) {
    double w[NF + 1];
    forcing(q, a, k, w);
    rows(q->model, (const double (*)[NJP])q->z, w, NX, NY, y, wide);
}

INLINE void advance(hot *q, const seaopt_pass_args *a, long k, long times, int wide) {
    double w[NF + 1];
    (void)times; /* it has no steps */
    forcing(q, a, k, w);
    rows(q->model, (const double (*)[NJP])q->z, w, 0, NX, q->next, wide);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < wide; j++) ((vec *)q->z[i])[j] = ((vec *)q->next[i])[j];
}
#else
/* In front of this file stand CasADi's functions, unless whole steps are (STEPPED, below):
     seaopt_rate(t, x, u, du, c) -> f and the nonzeros of f_x, f_p     seaopt_output(t, x, u, du, c) -> the same of h
   and seaopt_rate_chain, seaopt_output_chain, which add f_x Z + f_p to the derivatives of f, and of h. Where DELAYED
   is 2, f_p has a column for the delay, by which the input moves by du each second. Of a plant with a joint that sticks
   (JOINT, see events.py) the rate has the joint's mode as another argument, and there stands
     seaopt_joint(t, x, u, c) -> [speed, holding force, F(0)], d speed/dx, d speed/d theta, what a force adds to f.
   model: settings, then c. */

typedef double hot_columns[NX][NJP] __attribute__((aligned(32)));

/* The input at the start and the end of a step, and how fast the delay moves it. */
typedef struct { double u0[NU], u1[NU], du0[NU], du1[NU]; } line;

#if STEPPED
/* In front stand, in place of the rates and with the parameters p in place of c,
     seaopt_step(t, x, u0, u1, p, h) -> x+, dx+/dx, dx+/d[theta, h, u0, u1]      seaopt_plain_step(...) -> x+
     seaopt_output(t, x, u, p) -> y, dy/dx, dy/dtheta, dy/du                       seaopt_plain_output(...) -> y
   with matrices column by column. */
INLINE void chain(const double *a, const double *b, int rows, const double (*restrict z)[NJP], double (*restrict out)[NJP]) {
    for (int r = 0; r < rows; r++) {
        for (int j = 0; j < ALL; j++) {
            vec sum = {0.0, 0.0, 0.0, 0.0};
            for (int i = 0; i < NX; i++) sum += a[i * rows + r] * ((const vec *)z[i])[j];
            ((vec *)out[r])[j] = sum;
        }
        for (int i = 0; i < NQ; i++) out[r][1 + i] += b[i * rows + r];
    }
}

INLINE void one_step(hot *q, double t, const line *in, const double *c, double h, double dh, int wide) {
    double x[NX], after[NX], a[NX * NX], b[NX * (NQ + 1 + 2 * NU)];
    hot_columns out;
    const double *arg[SZ_ARG] = {&t, x, in->u0, in->u1, c, &h};
    double *res[SZ_RES] = {after, a, b};
    for (int i = 0; i < NX; i++) x[i] = q->z[i][0];
    if (!DERIVED(wide)) {
        seaopt_plain_step(arg, res, 0, q->work, 0);
        for (int i = 0; i < NX; i++) ((vec *)q->z[i])[0] = (vec){after[i], 0.0, 0.0, 0.0};
        return;
    }
    seaopt_step(arg, res, 0, q->work, 0);
    chain(a, b, NX, (const double (*)[NJP])q->z, out);
    for (int r = 0; r < NX; r++) {
        if (DELAYED) {
            double along = b[NQ * NX + r] * dh;
            for (int i = 0; i < NU; i++) along += b[(NQ + 1 + i) * NX + r] * in->du0[i] + b[(NQ + 1 + NU + i) * NX + r] * in->du1[i];
            out[r][1 + NQ] += along;
        }
        out[r][0] = after[r];
    }
    memcpy(q->z, out, sizeof out);
}

INLINE void output(hot *q, double t, const double *u, const double *du, const double *c, double (*restrict out)[NJP], int wide) {
    double x[NX], y[NY], hx[NY * NX], hp[NY * NQ + 1], hu[NY * NU];
    const double *arg[SZ_ARG] = {&t, x, u, c};
    double *res[SZ_RES] = {y, hx, hp, hu};
    for (int i = 0; i < NX; i++) x[i] = q->z[i][0];
    if (!DERIVED(wide)) seaopt_plain_output(arg, res, 0, q->work, 0);
    else {
        seaopt_output(arg, res, 0, q->work, 0);
        chain(hx, hp, NY, (const double (*)[NJP])q->z, out);
        for (int o = 0; DELAYED && o < NY; o++)
            for (int i = 0; i < NU; i++) out[o][1 + NQ] += hu[i * NY + o] * du[i];
    }
    for (int o = 0; o < NY; o++) out[o][0] = y[o];
}
#else
/* The rate f at x, and K = f_x Z + f_p at the derivatives Z. */
INLINE void slope(hot *q, double t, const double *x, const double *u, const double *du, const double *c,
                  const double (*restrict z)[NJP], double mode, double *f, double (*restrict k)[NJP], int wide) {
    double fx[NNZ_FX + 1], fp[NNZ_FP + 1];
    const double *arg[SZ_ARG + 1] = {&t, x, u, du, c, &mode};
    double *res[SZ_RES] = {f, DERIVED(wide) ? fx : 0, DERIVED(wide) ? fp : 0};
    seaopt_rate(arg, res, 0, q->work, 0);
    if (DERIVED(wide)) seaopt_rate_chain(fx, fp, z, k);
}

/* A Runge-Kutta step of order four of the state and its derivatives; the delay moves h itself, by dh. The state goes
   through its four stages apart from its vectors of derivatives: a pass waits for nothing else. */
INLINE void smooth_step(hot *q, double t, const line *in, const double *c, double mode, double h, double dh, int wide) {
    static const double reach[4] = {0.0, 0.5, 0.5, 1.0}, weight[4] = {1.0 / 6, 1.0 / 3, 1.0 / 3, 1.0 / 6};
    hot_columns k, z, sum;
    double u[NU], du[NU], x[NX], x0[NX], x1[NX], f[NX];
    for (int i = 0; i < NX; i++) x[i] = x0[i] = x1[i] = q->z[i][0];
    if (DERIVED(wide)) {
        memcpy(z, q->z, sizeof z);
        memcpy(sum, q->z, sizeof sum);
    }
    const int stages = h == 0.0 ? 1 : 4; /* all are the first in a step of no length, which its delay alone moves */
    for (int stage = 0; stage < stages; stage++) {
        const double part = reach[stage] * h, share = stages == 1 ? 1.0 : weight[stage];
        for (int i = 0; stage && i < NX; i++) {
            x[i] = x0[i] + part * f[i];
            for (int j = 0; DERIVED(wide) && j < wide; j++) ((vec *)z[i])[j] = ((vec *)q->z[i])[j] + part * ((vec *)k[i])[j];
            if (DERIVED(wide) && DELAYED) z[i][1 + NQ] += reach[stage] * dh * f[i];
        }
        for (int i = 0; i < NU; i++) {
            u[i] = in->u0[i] + reach[stage] * (in->u1[i] - in->u0[i]);
            du[i] = in->du0[i] + reach[stage] * (in->du1[i] - in->du0[i]);
        }
        slope(q, t + part, x, u, du, c, (const double (*)[NJP])z, mode, f, k, wide);
        for (int i = 0; i < NX; i++) {
            x1[i] += share * h * f[i];
            for (int j = 0; DERIVED(wide) && j < wide; j++) ((vec *)sum[i])[j] += share * h * ((vec *)k[i])[j];
            if (DERIVED(wide) && DELAYED) sum[i][1 + NQ] += share * dh * f[i];
        }
    }
    for (int i = 0; i < NX; i++) {
        if (DERIVED(wide)) memcpy(q->z[i], sum[i], sizeof sum[i]);
        q->z[i][0] = x1[i];
    }
}

#if JOINT
/* The joint as it is at a place: see seaopt/simulation/events.py, whose steps these are. */
typedef struct { double speed, holding, level, by_x[NX], by_p[NQ + 1], effect[NX]; } joint;

#define PHASES 8
#define STILL_S 1e-13
#define ROUNDS 8

static inline joint look(hot *q, double t, const double *u, const double *c) {
    double x[NX], figures[3];
    joint at;
    const double *arg[SZ_ARG] = {&t, x, u, c};
    double *res[SZ_RES] = {figures, at.by_x, at.by_p, at.effect};
    for (int i = 0; i < NX; i++) x[i] = q->z[i][0];
    seaopt_joint(arg, res, 0, q->work, 0);
    at.speed = figures[0];
    at.holding = figures[1];
    at.level = figures[2];
    return at;
}

static inline double along(const joint *at, const double *rate) {
    double sum = 0.0;
    for (int i = 0; i < NX; i++) sum += at->by_x[i] * rate[i];
    return sum;
}

static inline double choose_mode(const joint *at) {
    return fabs(at->holding) <= at->level ? 0.0 : at->holding > 0.0 ? 1.0 : -1.0;
}

static inline void find_rate(hot *q, double t, const double *u, const double *c, double mode, double *f) {
    double x[NX], still[NU] = {0.0};
    const double *arg[SZ_ARG] = {&t, x, u, still, c, &mode};
    double *res[SZ_RES] = {f};
    for (int i = 0; i < NX; i++) x[i] = q->z[i][0];
    seaopt_rate(arg, res, 0, q->work, 0);
}

/* Move by so much of the speed, which is zero or nearly: what its derivatives say of when it is. */
INLINE void take_speed(hot *q, const joint *at, const double *share, int wide) {
    double w[NJP] __attribute__((aligned(32))) = {0.0};
    if (DERIVED(wide)) {
        for (int i = 0; i < NX; i++)
            for (int j = 0; j < NJP; j++) w[j] += at->by_x[i] * q->z[i][j];
        for (int i = 0; i < NQ; i++) w[1 + i] += at->by_p[i];
    }
    w[0] = at->speed;
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < 4 * wide; j++) q->z[i][j] -= share[i] * w[j];
}

/* Where the cubic of these values and slopes at 0 and 1 falls through zero. */
static double find_turn(double w0, double d0, double w1, double d1) {
    const double a = d0 + d1 - 2.0 * (w1 - w0), b = 3.0 * (w1 - w0) - 2.0 * d0 - d1;
    double low = 0.0, high = 1.0, r = w0 / (w0 - w1);
    if (w0 <= 0.0) {
        if (w0 + 0.5 * (d0 + 0.5 * (b + 0.5 * a)) <= 0.0) return 0.0;
        r = low = 0.5;
    }
    for (int i = 0; i < ROUNDS; i++) {
        const double w = w0 + r * (d0 + r * (b + r * a)), d = d0 + r * (2.0 * b + 3.0 * a * r);
        if (w > 0.0) low = r;
        else high = r;
        r -= w / d;
        if (!(r >= low && r <= high)) r = 0.5 * (low + high);
    }
    return r;
}

static inline line cut(const line *in, double from, double to) {
    line out;
    for (int i = 0; i < NU; i++) {
        const double u = in->u1[i] - in->u0[i], du = in->du1[i] - in->du0[i];
        out.u0[i] = in->u0[i] + from * u;
        out.u1[i] = in->u0[i] + to * u;
        out.du0[i] = in->du0[i] + from * du;
        out.du1[i] = in->du0[i] + to * du;
    }
    return out;
}

INLINE void one_step(hot *q, double t, const line *in, const double *c, double h, double dh, int wide) {
    double place = 0.0, mode = 0.0;
    for (int phase = 0; phase < PHASES; phase++) {
        const line rest = cut(in, place, 1.0);
        const double left = 1.0 - place, begin = t + place * h;
        const joint first = look(q, begin, rest.u0, c);
        const double effect = along(&first, first.effect);
        if (!phase) {
            const int still = fabs(first.speed) <= STILL_S * fabs(effect) * first.level;
            mode = still ? choose_mode(&first) : first.speed > 0.0 ? 1.0 : -1.0;
        }
        if (mode == 0.0) {
            double share[NX];
            for (int i = 0; i < NX; i++) share[i] = first.effect[i] / effect;
            take_speed(q, &first, share, wide);
        }
        hot_columns before;
        memcpy(before, q->z, sizeof before);
        smooth_step(q, begin, &rest, c, mode, left * h, left * dh, wide);
        if (!(h > 0.0) || phase == PHASES - 1) return;
        const joint last = look(q, t + h, rest.u1, c);
        double share, f0[NX], f1[NX];
        if (mode == 0.0) {
            double low = 0.0, high = 1.0, below = first.level - fabs(first.holding), above = last.level - fabs(last.holding);
            if (!(above < 0.0)) return;
            for (int i = 0; i < 2; i++) {
                share = low + (high - low) * below / (below - above);
                const line part = cut(&rest, 0.0, share);
                memcpy(q->z, before, sizeof before);
                smooth_step(q, begin, &part, c, mode, share * left * h, share * left * dh, wide);
                const joint there = look(q, begin + share * left * h, part.u1, c);
                const double room = there.level - fabs(there.holding);
                if (room >= 0.0) low = share, below = room;
                else high = share, above = room;
            }
            share = low + (high - low) * below / (below - above);
        } else {
            if (!(mode * last.speed <= 0.0)) return;
            find_rate(q, t + h, rest.u1, c, mode, f1);
            memcpy(q->z, before, sizeof before);
            find_rate(q, begin, rest.u0, c, mode, f0);
            const double length = mode * left * h;
            share = find_turn(mode * first.speed, length * along(&first, f0), mode * last.speed, length * along(&last, f1));
        }
        const line part = cut(&rest, 0.0, share);
        memcpy(q->z, before, sizeof before);
        smooth_step(q, begin, &part, c, mode, share * left * h, share * left * dh, wide);
        place += share * left;
        const joint now = look(q, t + place * h, part.u1, c);
        const double next = mode == 0.0 ? (now.holding > 0.0 ? 1.0 : -1.0) : choose_mode(&now);
        if (mode * next < 0.0) {
            find_rate(q, t + place * h, part.u1, c, mode, f0);
            find_rate(q, t + place * h, part.u1, c, next, f1);
            const double slowing = along(&now, f0);
            for (int i = 0; i < NX; i++) f1[i] = (f0[i] - f1[i]) / slowing;
            take_speed(q, &now, f1, wide);
        }
        mode = next;
    }
}
#else
INLINE void one_step(hot *q, double t, const line *in, const double *c, double h, double dh, int wide) {
    smooth_step(q, t, in, c, 0.0, h, dh, wide);
}
#endif

INLINE void output(hot *q, double t, const double *u, const double *du, const double *c, double (*restrict out)[NJP], int wide) {
    double x[NX], y[NY], hx[NNZ_HX + 1], hp[NNZ_HP + 1];
    const double *arg[SZ_ARG] = {&t, x, u, du, c};
    double *res[SZ_RES] = {y, DERIVED(wide) ? hx : 0, DERIVED(wide) ? hp : 0};
    for (int i = 0; i < NX; i++) x[i] = q->z[i][0];
    seaopt_output(arg, res, 0, q->work, 0);
    if (DERIVED(wide)) seaopt_output_chain(hx, hp, (const double (*)[NJP])q->z, out);
    for (int o = 0; o < NY; o++) out[o][0] = y[o];
}
#endif

#ifdef SAMPLED
/* A device that samples sets its memories: from the state as it was at the sample. */
INLINE void set_samples(hot *q, const double (*restrict before)[NJP], int wide) {
    for (int s = 0; s < SAMPLED; s++)
        for (int j = 0; j < wide; j++) {
            vec sum = {0.0, 0.0, 0.0, 0.0};
            for (int i = 0; i < NX; i++) sum += sampled_from[s][i] * ((const vec *)before[i])[j];
            ((vec *)q->z[sampled_state[s]])[j] = sum;
        }
}
#endif

INLINE void observe(hot *q, const seaopt_pass_args *a, long k, double (*restrict out)[NJP], int wide) {
    const double *m = a->model, t = a->t0 + k * m[0];
    double u[NU], du[NU], older[NU];
    const int foh = m[2] > 0.5;
    at(a, k, !foh && m[1] > 0.0 ? a->lag_b : a->lag_a, u);
    at(a, k, a->lag_c, older);
    for (int i = 0; i < NU; i++) {
        du[i] = foh ? (older[i] - u[i]) / m[0] : 0.0;
        u[i] += m[1] * du[i];
    }
    for (int i = NU - READ; i < NU; i++) {
        u[i] = a->u[i][k];
        du[i] = 0.0;
    }
    output(q, t, u, du, m + SETTINGS, out, wide);
}

#ifdef KEPT
/* A device reads states anew at row k, unless it keeps what it has. */
INLINE void read_states(hot *q, const seaopt_pass_args *a, long k) {
    if (a->u[KEPT_BY][k < a->length ? k : a->length - 1] > 0.0) return;
    for (int s = 0; s < KEPT; s++) memcpy(q->z[kept_state[s]], q->z[kept_of[s]], sizeof q->z[0]);
}
#endif

/* With a fractional delay the older input acts first, for m[1] seconds: u_b held, or the line from u_c to u_a; then u_a
   held, or the line from u_a to u_b. */
INLINE void advance(hot *q, const seaopt_pass_args *a, long k, long times, int wide) {
    const double *m = a->model, parts[2] = {m[1], m[0] - m[1]};
    const long steps = times * a->steps[k];
    const int foh = m[2] > 0.5;
    double t = a->t0 + k * m[0], ua[NU], ub[NU], uc[NU];
#ifdef SAMPLED
    hot_columns before;
    memcpy(before, q->z, sizeof before);
#endif
    at(a, k, a->lag_a, ua);
    at(a, k, a->lag_b, ub);
    at(a, k, a->lag_c, uc);
    for (int part = 0; part < 2; part++) {
        if (parts[part] <= 0.0 && !DELAYED) continue;
        /* A part of no length has no steps; how it grows with the delay takes one. */
        const long count = parts[part] > 0.0 ? steps : 1;
        const double h = parts[part] / count, dh = (part ? -1.0 : 1.0) / count;
        for (long i = 0; i < count; i++) {
            line in;
            for (int c = 0; c < NU; c++) {
                /* The older line ends at u_a, the newer one begins there. */
                const double base = foh || part ? ua[c] : ub[c], slope = foh ? (part ? ub[c] - ua[c] : ua[c] - uc[c]) / m[0] : 0.0;
                const long from = part ? i : i - count;
                in.u0[c] = base + slope * h * from;
                in.u1[c] = base + slope * h * (from + 1);
                in.du0[c] = slope * dh * from;
                in.du1[c] = slope * dh * (from + 1);
            }
            for (int c = NU - READ; c < NU; c++) { /* the delay moves where steps begin on a reading's curve */
                const long from = part ? i : i - count;
                in.u0[c] = follow(a, k, c, (m[1] + h * from) / m[0], &in.du0[c]);
                in.u1[c] = follow(a, k, c, (m[1] + h * (from + 1)) / m[0], &in.du1[c]);
                in.du0[c] *= (1.0 + dh * from) / m[0];
                in.du1[c] *= (1.0 + dh * (from + 1)) / m[0];
            }
            one_step(q, t, &in, m + SETTINGS, h, dh, wide);
            t += h;
        }
    }
#ifdef SAMPLED
    set_samples(q, (const double (*)[NJP])before, wide);
#endif
#ifdef KEPT
    read_states(q, a, k + 1);
#endif
}
#endif

/* Residual and derivatives of output o: gain y + offset + drift - measured. */
INLINE void residual(const seaopt_pass_args *a, int o, const double *restrict y, double measured, double tau, double *restrict v,
                     int wide) {
    const double gain = a->gain[o];
    double basis[NCP], older = 1.0, value = gain * y[0] + a->offset[o] - measured;
    for (long d = 0; d < a->drift_terms; d++) { /* Legendre's recurrence */
        basis[d] = d == 0 ? tau : ((2 * d + 1) * tau * basis[d - 1] - d * older) / (d + 1);
        if (d > 0) older = basis[d - 1];
        value += a->drift[o * a->drift_terms + d] * basis[d];
    }
    for (int j = 0; j < wide; j++) ((vec *)v)[j] = gain * ((const vec *)y)[j];
    v[0] = value;
    if (wide < ALL) return;
    for (int j = NJP; j < NCP; j++) v[j] = 0.0;
    double *own = v + 1 + a->shared + NX + (CORRECT ? o * (2 + a->drift_terms) : 0);
    own[0] += 1.0;
    for (long d = 0; d < a->drift_terms; d++) own[1 + d] += basis[d];
    own[1 + a->drift_terms] += y[0];
}

ONCE void filtered(const seaopt_pass_args *a, double *restrict v, double (*restrict z)[2][NCP]) {
    for (long s = 0; s < a->sections; s++) {
        const double *c = a->sos + 5 * s;
        for (int j = 0; j < NCP; j++) {
            const double out = c[0] * v[j] + z[s][0][j];
            z[s][0][j] = c[1] * v[j] - c[3] * out + z[s][1][j];
            z[s][1][j] = c[2] * v[j] - c[4] * out;
            v[j] = out;
        }
    }
}

static inline void sum_waiting(const seaopt_pass_args *a, hot *q, int o) {
    sums->add_products(q->v[o][0], q->weight[o], q->waiting[o], q->sum[o][0], NCP);
    q->waiting[o] = 0;
}

/* The sample in v waits for its block to fill. */
static inline void accumulate(const seaopt_pass_args *a, hot *q, int o) {
    const long k = q->waiting[o];
    double rho;
    q->weight[o][k] = robust(a, o, q->v[o][k][0], &rho);
    q->rho[o] += rho;
    q->count[o] += 1.0;
    q->waiting[o] = k + 1;
    if (k + 1 == BLOCK) sum_waiting(a, q, o);
}

EXPORTED long count_lanes(void) { return 1; }

EXPORTED long carry_size(void) { return sizeof(state) / sizeof(double) + 1; }

ONCE void begin(hot *q, const seaopt_pass_args *a) {
    memset(q, 0, sizeof *q);
#if LINEAR
    memcpy(q->model, a->model, sizeof q->model);
#endif
    if (a->carry && a->from > a->start) {
        const state *before = (const state *)a->carry;
        memcpy(q->z, before->z, sizeof q->z);
        memcpy(q->filter, before->filter, sizeof q->filter);
        return;
    }
    for (int i = 0; i < NX; i++) { q->z[i][0] = a->x0[i]; q->z[i][1 + a->shared + i] = 1.0; }
}

ONCE void deliver(hot *q, const seaopt_pass_args *a) {
    for (int o = 0; o < NY; o++) sum_waiting(a, q, o);
    if (a->carry) {
        state *after = (state *)a->carry;
        memcpy(after->z, q->z, sizeof q->z);
        memcpy(after->filter, q->filter, sizeof q->filter);
    }
    for (int o = 0; a->gram && o < NY; o++) {
        a->rho[o] += q->rho[o];
        a->count[o] += q->count[o];
        sums->add_gram(q->sum[o][0], NCP, a->gram + o * a->v_columns * a->v_columns, a->v_columns);
    }
}

INLINE void one_pass(const seaopt_pass_args *a, int wide) {
    const int summed = DERIVED(wide), compared = summed || (MEASURED && CORRECT);
    hot here, *const q = &here;
    long slot = 0; /* of the ring of influences */
    begin(q, a);
    for (long k = a->from; k < a->to; k++) {
        int present[NY];
        observe(q, a, k, q->y, wide);
        if (a->states)
            for (int i = 0; i < NX; i++) a->states[(k - a->from) * NX + i] = q->z[i][0];
        if (a->outputs && k - a->from < a->output_rows)
            for (int o = 0; o < NY; o++) a->outputs[(k - a->from) * NY + o] = q->y[o][0];
        double *v[NY];
        for (int o = 0; compared && o < NY; o++) {
            const double measured = a->y[o][k];
            v[o] = q->v[o][q->waiting[o]];
            present[o] = isfinite(measured) && !(a->keep[o] && !a->keep[o][k]);
            if (present[o]) residual(a, o, q->y[o], measured, a->tau0 + k * a->dtau, v[o], wide);
            else memset(v[o], 0, NCP * sizeof(double));
        }
        double *change = wide == 1 && a->changes ? a->changes + (k - a->from) * NX : 0;
        if (change) memcpy(q->next, q->z, sizeof q->z);
        for (long times = change ? 2 : 1; times; times--) {
            advance(q, a, k, times, wide);
            for (int i = 0; change && i < NX; i++) change[i] = times == 2 ? q->z[i][0] : change[i] - q->z[i][0];
            if (times == 2) memcpy(q->z, q->next, sizeof q->z);
        }
#if CORRECT
        for (int o = 0; o < NY; o++)
            if (MEASURED && present[o])
                for (int i = 0; i < NX; i++) {
                    const double *g = a->correction + (i * NY + o) * NJP;
                    for (int j = 1; j < 4 * wide; j++) q->z[i][j] -= g[0] * v[o][j] + g[j] * v[o][0];
                    q->z[i][0] -= g[0] * v[o][0];
                }
#endif
        for (int o = 0; summed && o < NY; o++) {
            if (a->sections) filtered(a, v[o], q->filter[o]);
            if (a->columns) memcpy(a->columns + ((k - a->from) * NY + o) * a->v_columns, v[o], a->v_columns * sizeof(double));
            present[o] = present[o] && k >= a->start + a->settle;
            if (a->gram && present[o] && k >= a->from + a->warm) accumulate(a, q, o);
        }
        if (summed && a->into.into) {
            sums->add_influence(&a->into, v, present, slot, k >= a->from + a->warm);
            slot = slot < a->into.lags ? slot + 1 : 0;
        }
    }
    deliver(q, a);
}

typedef struct { const seaopt_pass_args *list; long count; } jobs;

static void *run_jobs(void *given) {
    const jobs *all = given;
    const unsigned long mode = flush_denormals();
    for (long i = 0; i < all->count; i++) {
        const seaopt_pass_args *one = all->list + i;
        if (MEASURED && (ALL == 1 || one->gram || one->columns || one->into.into)) one_pass(one, ALL);
        else one_pass(one, 1);
    }
    restore_denormals(mode);
    return 0;
}

/* Both ways of a pass have their arrays in one frame; then come those of a step, of CasADi's functions, and of influences. */
#define STACK (2 * sizeof(hot) + sizeof(double) * (24 * (NX + NY) * (NJP + 2 * NU + 2) + 4 * NY * NY))

EXPORTED int seaopt_passes(const seaopt_pass_args *list, long count) {
    jobs all = {list, count};
    return on_own_stack(run_jobs, &all, STACK);
}
