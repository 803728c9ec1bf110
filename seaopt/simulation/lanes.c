/* Passes over stretches of a log of a smooth plant, four side by side: see seaopt/simulation/parts.py, and pass.c for what
   a pass is.

   Built with constants, sums.h, pass.h and lanes.h in front. Bands, corrections, influences and what is resumed are for
   pass.c. A vector holds a number of each of four stretches. Stretches are of one point; each makes its own number of steps
   in a row, and steps of no length until the last one is through.

   In front stand, made of CasADi's functions,
     seaopt_rate(t, x, u, du, c, f, fx, fp), seaopt_output(&t, x, u, du, c, h, hx, hp)    and their nonzero derivatives
     seaopt_rate_chain(a, b, z, out), seaopt_output_chain(...)                           out = A Z + B, but for column 0
   z[i][0] is the state x_i, and z[i][j] its derivative to unknown j. */
#define BLOCK 4

/* What a stretch comes to: the state and its derivatives. */
typedef struct { double z[NX][NJP]; } state;

/* All that a sample touches stands close together. */
typedef struct {
    lanes z[NX][NJ], before[NX];
    lanes v[BLOCK][NY][NCP], weight[BLOCK][NY]; /* samples that wait to be summed */
    lanes x0[NX], x[NX], x1[NX], place[NX][NJ], slope[NX][NJ], total[NX][NJ];
    lanes c[CONSTANTS + 1];
    int waiting;
    lanes rho[NY], count[NY], sum[NY][NCP][NCP];
} hot;

/* The stretches, which of them there are, and where they are in their logs. */
typedef struct {
    const seaopt_pass_args *a[LANES];
    long row[LANES];
    int live[LANES]; /* whether the row is one of the stretch's */
    int count;
} place;

/* The input at the start and the end of a step, and how fast the delay moves it. */
typedef struct { lanes u0[NU], u1[NU], du0[NU], du1[NU]; } line;

static inline void inputs_at(const place *p, int which, lanes *u) {
    double one[NU];
    for (int l = 0; l < LANES; l++) {
        const seaopt_pass_args *a = p->a[l];
        at(a, p->row[l], which == 0 ? a->lag_a : which == 1 ? a->lag_b : a->lag_c, one);
        for (int i = 0; i < NU; i++) u[i][l] = one[i];
    }
}

/* A Runge-Kutta step of order four of the states and their derivatives K = f_x Z + f_p; the delay moves h itself, by dh.
   All stages are the first in a step of no length, which its delay alone moves. */
INLINE void make_step(hot *q, lanes t, const line *in, lanes h, lanes dh, int stages, int derived) {
    static const double reach[4] = {0.0, 0.5, 0.5, 1.0}, weight[4] = {1.0 / 6, 1.0 / 3, 1.0 / 3, 1.0 / 6};
    lanes f[NX], fx[NNZ_FX + 1], fp[NNZ_FP + 1];
    for (int i = 0; i < NX; i++) {
        q->x[i] = q->x0[i] = q->x1[i] = q->z[i][0];
    }
    for (int stage = 0; stage < stages; stage++) {
        const lanes part = reach[stage] * h, share = (stages == 1 ? 1.0 : weight[stage]) * h;
        const lanes early = reach[stage] * dh, delayed = (stages == 1 ? 1.0 : weight[stage]) * dh;
        lanes u[NU], du[NU], at;
        for (int i = 0; stage && i < NX; i++) {
            q->x[i] = q->x0[i] + part * f[i];
            for (int j = 1; derived && j < NJ; j++) q->place[i][j] = q->z[i][j] + part * q->slope[i][j];
            if (derived && DELAYED) q->place[i][1 + NQ] += early * f[i];
        }
        for (int i = 0; i < NU; i++) {
            u[i] = in->u0[i] + reach[stage] * (in->u1[i] - in->u0[i]);
            du[i] = in->du0[i] + reach[stage] * (in->du1[i] - in->du0[i]);
        }
        at = t + part;
        seaopt_rate(&at, q->x, u, du, q->c, f, fx, fp);
        if (derived) seaopt_rate_chain(fx, fp, (const lanes (*)[NJ])(stage ? q->place : q->z), q->slope);
        lanes (*const from)[NJ] = stage ? q->total : q->z, (*const to)[NJ] = stage + 1 < stages ? q->total : q->z;
        for (int i = 0; i < NX; i++) {
            q->x1[i] += share * f[i];
            for (int j = 1; derived && j < NJ; j++) to[i][j] = from[i][j] + share * q->slope[i][j];
            if (derived && DELAYED) to[i][1 + NQ] += delayed * f[i];
        }
    }
    for (int i = 0; i < NX; i++) q->z[i][0] = q->x1[i];
}

/* With a fractional delay the older input acts first, for m[1] seconds: u_b held, or the line from u_c to u_a; then u_a
   held, or the line from u_a to u_b. */
INLINE void advance(hot *q, const place *p, long times, int derived) {
    const double *m = p->a[0]->model, parts[2] = {m[1], m[0] - m[1]};
    const int foh = m[2] > 0.5;
    const lanes zero = {0.0};
    lanes ua[NU], ub[NU], uc[NU], t;
    for (int l = 0; l < LANES; l++) t[l] = p->a[l]->t0 + p->row[l] * m[0];
    inputs_at(p, 0, ua);
    inputs_at(p, 1, ub);
    inputs_at(p, 2, uc);
    for (int part = 0; part < 2; part++) {
        if (parts[part] <= 0.0 && !DELAYED) continue;
        long steps[LANES], most = 1;
        lanes h, dh, count, rise[NU];
        for (int l = 0; l < LANES; l++) {
            /* A part of no length has no steps; how it grows with the delay takes one. */
            steps[l] = parts[part] > 0.0 ? times * p->a[l]->steps[p->row[l]] : 1;
            most = steps[l] > most ? steps[l] : most;
            count[l] = steps[l];
        }
        h = parts[part] / count;
        dh = (part ? -1.0 : 1.0) / count;
        for (int c = 0; c < NU; c++) rise[c] = (part ? ub[c] - ua[c] : ua[c] - uc[c]) / m[0];
        for (long i = 0; i < most; i++) {
            line in;
            const lanes from = part ? zero + (double)i : (double)i - count;
            for (int l = 0; l < LANES; l++)
                if (i == steps[l]) h[l] = dh[l] = 0.0;
            for (int c = 0; c < NU; c++) {
                /* The older line ends at u_a, the newer one begins there. */
                const lanes base = foh || part ? ua[c] : ub[c];
                if (foh) {
                    in.u0[c] = base + rise[c] * h * from;
                    in.u1[c] = base + rise[c] * h * (from + 1.0);
                    in.du0[c] = rise[c] * dh * from;
                    in.du1[c] = rise[c] * dh * (from + 1.0);
                } else {
                    in.u0[c] = in.u1[c] = base;
                    in.du0[c] = in.du1[c] = zero;
                }
            }
            for (int c = NU - READ; c < NU; c++) /* the delay moves where steps begin on a reading's curve */
                for (int l = 0; l < LANES; l++) {
                    double du[2];
                    in.u0[c][l] = follow(p->a[l], p->row[l], c, (m[1] + h[l] * from[l]) / m[0], du);
                    in.u1[c][l] = follow(p->a[l], p->row[l], c, (m[1] + h[l] * (from[l] + 1.0)) / m[0], du + 1);
                    in.du0[c][l] = du[0] * (1.0 + dh[l] * from[l]) / m[0];
                    in.du1[c][l] = du[1] * (1.0 + dh[l] * (from[l] + 1.0)) / m[0];
                }
            make_step(q, t, &in, h, dh, parts[part] > 0.0 ? 4 : 1, derived);
            t += h;
        }
    }
}

/* Model outputs with their derivatives. */
INLINE void observe(hot *q, const place *p, lanes (*y)[NJ], int derived) {
    const double *m = p->a[0]->model;
    const double foh = m[2] > 0.5;
    lanes u[NU], du[NU], older[NU], h[NY], hx[NNZ_HX + 1], hp[NNZ_HP + 1], x[NX], t;
    for (int l = 0; l < LANES; l++) t[l] = p->a[l]->t0 + p->row[l] * m[0];
    inputs_at(p, foh == 0.0 && m[1] > 0.0 ? 1 : 0, u);
    inputs_at(p, 2, older);
    for (int i = 0; i < NU; i++) {
        du[i] = foh * (older[i] - u[i]) / m[0];
        u[i] += m[1] * du[i];
    }
    for (int i = NU - READ; i < NU; i++)
        for (int l = 0; l < LANES; l++) {
            u[i][l] = p->a[l]->u[i][p->row[l]];
            du[i][l] = 0.0;
        }
    for (int i = 0; i < NX; i++) x[i] = q->z[i][0];
    seaopt_output(&t, x, u, du, q->c, h, hx, hp);
    if (derived) seaopt_output_chain(hx, hp, (const lanes (*)[NJ])q->z, y);
    for (int o = 0; o < NY; o++) y[o][0] = h[o];
}

/* Residual and derivatives of output o: gain y + offset + drift - measured; nothing where it is not measured. */
INLINE void residual(hot *q, const place *p, int o, const lanes *y) {
    const seaopt_pass_args *a = p->a[0];
    const double gain = a->gain[o];
    const long own = NJ, d = a->drift_terms;
    lanes measured, tau, there, value, *v = q->v[q->waiting][o], older = {1.0, 1.0, 1.0, 1.0};
    for (int l = 0; l < LANES; l++) {
        const seaopt_pass_args *one = p->a[l];
        const double read = one->y[o][p->row[l]];
        there[l] = p->live[l] && isfinite(read) && !(one->keep[o] && !one->keep[o][p->row[l]]);
        measured[l] = there[l] != 0.0 ? read : 0.0;
        tau[l] = one->tau0 + p->row[l] * one->dtau;
    }
    value = gain * y[0] + a->offset[o] - measured;
    for (int j = 1; j < NJ; j++) v[j] = gain * y[j];
    v[own] = older;
    for (long i = 0; i < d; i++) { /* Legendre's recurrence */
        if (i == 0) v[own + 1] = tau;
        else v[own + 1 + i] = ((2.0 * i + 1.0) * tau * v[own + i] - (double)i * older) / (i + 1.0);
        if (i > 0) older = v[own + i];
        value += a->drift[o * d + i] * v[own + 1 + i];
    }
    v[own + 1 + d] = y[0];
    v[0] = value;
    q->weight[q->waiting][o] = there;
    for (int l = 0; l < LANES; l++)
        for (long j = 0; there[l] == 0.0 && j < a->v_columns; j++) v[j][l] = 0.0; /* it may have overflowed */
}

static void sum_waiting(hot *q) {
    for (int k = q->waiting; k < BLOCK; k++)
        for (int o = 0; o < NY; o++) q->weight[k][o] = (lanes){0.0};
    q->waiting = 0;
    for (int o = 0; o < NY; o++)
        for (int r = 0; r < NCP; r++) {
            lanes row[BLOCK];
            for (int k = 0; k < BLOCK; k++) row[k] = q->weight[k][o] * q->v[k][o][r];
            for (int c = r; c < NCP; c++)
                for (int k = 0; k < BLOCK; k++) q->sum[o][r][c] += row[k] * q->v[k][o][c];
        }
}

/* The loss, by which the weight of outliers is less; the sample waits for its block to fill. */
INLINE void weigh(hot *q, const place *p, int o) {
    const lanes *v = q->v[q->waiting][o];
    lanes weight = q->weight[q->waiting][o], rho = 0.5 * v[0] * v[0];
    for (int l = 0; l < LANES; l++) {
        if (weight[l] == 0.0) continue;
        if (p->a[0]->loss) weight[l] = robust(p->a[l], o, v[0][l], (double *)&rho + l);
        q->rho[o][l] += rho[l];
        q->count[o][l] += 1.0;
    }
    q->weight[q->waiting][o] = weight;
}

ONCE void tell_columns(const hot *q, const place *p) {
    for (int l = 0; l < p->count; l++) {
        const seaopt_pass_args *a = p->a[l];
        const long k = p->row[l] - a->from;
        for (int o = 0; p->live[l] && o < NY; o++)
            for (long j = 0; j < a->v_columns; j++) a->columns[(k * NY + o) * a->v_columns + j] = q->v[q->waiting][o][j][l];
    }
}

INLINE void tell_states(hot *q, const place *p, const lanes (*y)[NJ]) {
    for (int l = 0; l < p->count; l++) {
        const seaopt_pass_args *a = p->a[l];
        const long k = p->row[l] - a->from;
        if (!p->live[l]) continue;
        for (int i = 0; a->states && i < NX; i++) a->states[k * NX + i] = q->z[i][0][l];
        for (int o = 0; a->outputs && k < a->output_rows && o < NY; o++) a->outputs[k * NY + o] = y[o][0][l];
    }
}

/* The next state's change by steps of half the length, which come first. */
ONCE void tell_changes(hot *q, const place *p, long times) {
    for (int i = 0; i < NX; i++) {
        for (int l = 0; l < p->count; l++) {
            double *change = p->a[l]->changes + (p->row[l] - p->a[l]->from) * NX + i;
            if (p->live[l]) *change = times == 2 ? q->z[i][0][l] : *change - q->z[i][0][l];
        }
        if (times == 2) q->z[i][0] = q->before[i];
    }
}

EXPORTED long count_lanes(void) { return LANES; }

EXPORTED long carry_size(void) { return sizeof(state) / sizeof(double); }

ONCE void begin(hot *q, const place *p) {
    memset(q, 0, sizeof *q);
    for (int i = 0; i < CONSTANTS; i++) q->c[i] += p->a[0]->model[SETTINGS + i];
    for (int l = 0; l < LANES; l++) {
        const seaopt_pass_args *a = p->a[l];
        for (int i = 0; i < NX; i++) {
            q->z[i][0][l] = a->x0[i];
            q->z[i][1 + a->shared + i][l] = 1.0;
        }
    }
}

/* A stretch's state as its last row leaves it: it may have ended one row before others. */
ONCE void end_stretch(const hot *q, const place *p, int l) {
    state *after = (state *)p->a[l]->carry;
    for (int i = 0; after && i < NX; i++)
        for (int j = 0; j < NJ; j++) after->z[i][j] = q->z[i][j][l];
}

ONCE void deliver(const hot *q, const place *p) {
    for (int l = 0; l < p->count; l++) {
        const seaopt_pass_args *a = p->a[l];
        const long n = a->v_columns;
        for (int o = 0; a->gram && o < NY; o++) {
            a->rho[o] += q->rho[o][l];
            a->count[o] += q->count[o][l];
            for (long r = 0; r < n; r++)
                for (long c = 0; c < n; c++) a->gram[(o * n + r) * n + c] += q->sum[o][r < c ? r : c][r < c ? c : r][l];
        }
    }
}

INLINE void passes(const seaopt_pass_args *list, int count, int derived) {
    hot here, *const q = &here;
    place p = {.count = count};
    long longest = 0;
    for (int l = 0; l < LANES; l++) {
        p.a[l] = list + (l < count ? l : 0);
        if (l < count && p.a[l]->to - p.a[l]->from > longest) longest = p.a[l]->to - p.a[l]->from;
    }
    begin(q, &p);
    for (long k = 0; k < longest; k++) {
        lanes y[NY][NJ];
        for (int l = 0; l < LANES; l++) {
            const seaopt_pass_args *a = p.a[l];
            p.live[l] = l < count && a->from + k < a->to;
            p.row[l] = a->from + k < a->to ? a->from + k : a->to - 1;
            if (l < count && a->from + k == a->to) end_stretch(q, &p, l);
        }
        observe(q, &p, y, derived);
        if (list->states || list->outputs) tell_states(q, &p, (const lanes (*)[NJ])y);
        for (int o = 0; derived && o < NY; o++) residual(q, &p, o, y[o]);
        if (derived && list->columns) tell_columns(q, &p);
        for (int o = 0; derived && list->gram && o < NY; o++) weigh(q, &p, o);
        if (derived && list->gram && ++q->waiting == BLOCK) sum_waiting(q);
        for (int i = 0; !derived && i < NX; i++) q->before[i] = q->z[i][0];
        for (long times = !derived && list->changes ? 2 : 1; times; times--) {
            advance(q, &p, times, derived);
            if (!derived && list->changes) tell_changes(q, &p, times);
        }
    }
    for (int l = 0; l < count; l++)
        if (p.a[l]->to - p.a[l]->from == longest) end_stretch(q, &p, l);
    if (derived) sum_waiting(q);
    deliver(q, &p);
}

ONCE void pass_states(const seaopt_pass_args *list, int count) { passes(list, count, 0); }

/* What goes on in states that are let go `run_up` rows before their passes begin. */
ONCE void run_up(const seaopt_pass_args *list, int count) {
    seaopt_pass_args alone[LANES];
    state reached[LANES];
    double *to[LANES];
    int some = 0;
    for (int l = 0; l < count; l++) {
        if (!list[l].run_up) continue;
        seaopt_pass_args *one = alone + some;
        *one = list[l];
        one->from = one->start = list[l].from - list[l].run_up;
        one->to = list[l].from;
        one->gram = one->outputs = one->columns = one->states = one->changes = 0;
        one->carry = (double *)(reached + some);
        to[some++] = list[l].x0;
    }
    if (some) pass_states(alone, some);
    for (int l = 0; l < some; l++)
        for (int i = 0; i < NX; i++) to[l][i] = reached[l].z[i][0];
}

typedef struct { const seaopt_pass_args *list; long count; } jobs;

static void *run_jobs(void *given) {
    const jobs *all = given;
    const unsigned long mode = flush_denormals();
    for (long i = 0; i < all->count; i += LANES) {
        const seaopt_pass_args *list = all->list + i;
        const int count = all->count - i < LANES ? all->count - i : LANES;
        run_up(list, count);
        if (list->gram || list->columns) passes(list, count, 1);
        else pass_states(list, count);
    }
    restore_denormals(mode);
    return 0;
}

#define STACK (3 * sizeof(hot) + sizeof(lanes) * (4 * (NX + NY) * (NJ + NU + 2) + 4 * (NNZ_FX + NNZ_FP + NNZ_HX + NNZ_HP)) + 8192)

EXPORTED int seaopt_passes(const seaopt_pass_args *list, long count) {
    jobs all = {list, count};
    return on_own_stack(run_jobs, &all, STACK);
}
