/* Passes over stretches of a log: state, sensitivities, outputs, weighted residuals and their Gram matrices.

   Built with constants, sums.h, layout.h, step.h and pass.h in front (see seaopt/simulation/compiled.py). Its sizes are all that
   it knows of a plant: a linear one is its matrices, of another a->plant makes steps and outputs (step.c).

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
/* All that a sample touches stands close together. */
typedef struct {
    double z[NX][NJP], next[NX][NJP], y[NY][NJP];
    double v[NY][BLOCK][NCP], weight[NY][BLOCK]; /* samples that wait to be summed */
    double sum[NY][NCP][NCP];
    long waiting[NY];
    double filter[NY][MAX_SECTIONS][2][NCP];
#if LINEAR
    double model[(NX + NY) * (NX + (NX + NI) * NJP)] __attribute__((aligned(32)));
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
    a->plant->output[DERIVED(wide)](q->z, t, u, du, m + SETTINGS, out);
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
            a->plant->step[DERIVED(wide)](q->z, t, &in, m + SETTINGS, h, dh);
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
    return on_own_stack(run_jobs, &all, STACK + (count && list->plant ? list->plant->room : 0));
}
