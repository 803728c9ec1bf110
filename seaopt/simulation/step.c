/* A step of a plant and its outputs, with the derivatives: all of a pass that depends on the plant's equations. It is a
   library of its own, as plants of one size share their passes (pass.c), which take longer to compile.

   Built with constants, sums.h, layout.h and step.h in front, and CasADi's functions, unless whole steps are (STEPPED, below):
     seaopt_rate(t, x, u, du, c) -> f and the nonzeros of f_x, f_p     seaopt_output(t, x, u, du, c) -> the same of h
   and seaopt_rate_chain, seaopt_output_chain, which add f_x Z + f_p to the derivatives of f, and of h. Where DELAYED
   is 2, f_p has a column for the delay, by which the input moves by du each second. Of a plant with a joint that sticks
   (JOINT, see events.py) the rate has the joint's mode as another argument, and there stands
     seaopt_joint(t, x, u, c) -> [speed, holding force, F(0)], d speed/dx, d speed/d theta, what a force adds to f. */

/* The state with its derivatives, and room for CasADi's functions. */
typedef struct { double (*z)[NJP], *work; } hot;

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

#if MEASURED
static void derived_step(double (*z)[NJP], double t, const line *in, const double *c, double h, double dh) {
    double work[SZ_W + 1];
    one_step(&(hot){z, work}, t, in, c, h, dh, ALL);
}

static void derived_output(double (*z)[NJP], double t, const double *u, const double *du, const double *c, double (*y)[NJP]) {
    double work[SZ_W + 1];
    output(&(hot){z, work}, t, u, du, c, y, ALL);
}
#else
#define derived_step plain_step
#define derived_output plain_output
#endif

static void plain_step(double (*z)[NJP], double t, const line *in, const double *c, double h, double dh) {
    double work[SZ_W + 1];
    one_step(&(hot){z, work}, t, in, c, h, dh, 1);
}

static void plain_output(double (*z)[NJP], double t, const double *u, const double *du, const double *c, double (*y)[NJP]) {
    double work[SZ_W + 1];
    output(&(hot){z, work}, t, u, du, c, y, 1);
}

EXPORTED const plant_steps seaopt_steps = {{plain_step, derived_step}, {plain_output, derived_output}, 2 * sizeof(double) * (SZ_W + 1)};
