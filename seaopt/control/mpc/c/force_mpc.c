#include "force_mpc.h"

#include <string.h>

#include "force_mpc_workspace.h"
#include "osqp.h"

#define STATES FORCE_MPC_STATES
#define PLANT (FORCE_MPC_PLANT_STATES)
#define KNOTS FORCE_MPC_KNOTS
#define ROWS FORCE_MPC_ROWS
#define SIGNALS FORCE_MPC_SIGNALS /* with bounds, each held at SAMPLES of the horizon */
#define SAMPLES FORCE_MPC_SAMPLES
#define LIMITS (ROWS - 2 * SIGNALS * SAMPLES - SIGNALS) /* rows of the command, before those of the signals */
#define VARIABLES (KNOTS + SIGNALS)
#define DELAY FORCE_MPC_DELAY
#define PREVIEW FORCE_MPC_PREVIEW
#define KNOWN (PREVIEW > DELAY ? PREVIEW - DELAY : 0) /* samples of the horizon whose references differ */

static int finite_number(OSQPFloat x) { return x - x == 0; }

static OSQPFloat clip(OSQPFloat x, OSQPFloat low, OSQPFloat high) { return x < low ? low : x > high ? high : x; }

static OSQPFloat dot(const OSQPFloat *a, const OSQPFloat *b, int n) {
  OSQPFloat sum = 0;
  for (int i = 0; i < n; i++) sum += a[i] * b[i];
  return sum;
}

/* z := A z + B u */
static void advance(OSQPFloat *z, OSQPFloat u) {
  OSQPFloat next[STATES];
  for (int i = 0; i < STATES; i++) next[i] = dot(mpc_A[i], z, STATES) + mpc_B[i] * u;
  memcpy(z, next, sizeof next);
}

/* Row i of the program's constraints, times its variables. */
static OSQPFloat row(const OSQPFloat *theta, int i) {
  if (i < KNOTS) return theta[i];
#if FORCE_MPC_SLEWS
  if (i < LIMITS) return dot(mpc_M[i - KNOTS], theta, KNOTS);
#endif
#if SIGNALS
  i -= LIMITS;
  if (i < 2 * SIGNALS * SAMPLES) {
    int upper = i < SIGNALS * SAMPLES, k = upper ? i : i - SIGNALS * SAMPLES;
    OSQPFloat slack = mpc_slack_unit * theta[KNOTS + k / SAMPLES];
    return dot(mpc_forced[k], theta, KNOTS) + (upper ? -slack : slack);
  }
  return theta[KNOTS + i - 2 * SIGNALS * SAMPLES];
#else
  return 0;
#endif
}

/* Ends of the commands at rest that keep the bounds of signals: the least and the largest. */
static void admissible_rest(OSQPFloat drift, OSQPFloat *low, OSQPFloat *high) {
  *low = -mpc_limit;
  *high = mpc_limit;
#if SIGNALS
  for (int i = 0; i < SIGNALS; i++) {
    if (mpc_static[i] == 0) continue;
    OSQPFloat one = (mpc_centre[i] - 1) / mpc_static[i] - drift, other = (mpc_centre[i] + 1) / mpc_static[i] - drift;
    OSQPFloat least = one < other ? one : other, most = one < other ? other : one;
    if (least > *low) *low = least;
    if (most < *high) *high = most;
  }
  *low = clip(*low, -mpc_limit, mpc_limit);
  *high = clip(*high, -mpc_limit, mpc_limit);
  if (*low > *high) *low = *high = (*low + *high) / 2;
#endif
  (void)drift;
}

/* Limits of all rows. */
static void limit_rows(const force_mpc *s, const OSQPFloat *error, OSQPFloat rest, OSQPFloat drift, OSQPFloat *low,
                       OSQPFloat *high) {
  for (int i = 0; i < KNOTS; i++) {
    low[i] = -1 - rest / mpc_limit;
    high[i] = 1 - rest / mpc_limit;
  }
#if FORCE_MPC_SLEWS
  for (int i = KNOTS; i < LIMITS; i++) {
    OSQPFloat start = i == KNOTS ? (s->command - rest) / mpc_slew : 0;
    low[i] = start - 1;
    high[i] = start + 1;
  }
#endif
#if SIGNALS
  for (int k = 0; k < SIGNALS * SAMPLES; k++) {
    OSQPFloat base = mpc_static[k / SAMPLES] * (rest + drift) - mpc_centre[k / SAMPLES] + dot(mpc_free[k], error, PLANT);
    low[LIMITS + k] = -mpc_wide;
    high[LIMITS + k] = 1 - base;
    low[LIMITS + SIGNALS * SAMPLES + k] = -1 - base;
    high[LIMITS + SIGNALS * SAMPLES + k] = mpc_wide;
  }
  for (int i = ROWS - SIGNALS; i < ROWS; i++) {
    low[i] = 0;
    high[i] = mpc_wide;
  }
#endif
  (void)s, (void)error, (void)drift;
}

/* Solve from the last plan, shifted, which is in `plan`; return whether there is a solution that can be used. */
static int solve(force_mpc *s, OSQPFloat *plan, OSQPFloat *start, const OSQPFloat *error, const OSQPFloat *delta,
                 OSQPFloat rest, OSQPFloat drift) {
  OSQPFloat q[VARIABLES], low[ROWS], high[ROWS], first[VARIABLES];
  for (int i = 0; i < VARIABLES; i++) {
    q[i] = i < KNOTS ? dot(mpc_F[i], error, PLANT + 1) : mpc_penalty;
    first[i] = i < KNOTS ? (plan[i] - rest) / mpc_limit : 0;
  }
#if KNOWN
  for (int i = 0; i < KNOTS; i++) q[i] += dot(mpc_R[i], delta, KNOWN);
#endif
  (void)delta;
  limit_rows(s, error, rest, drift, low, high);
  if (osqp_update_data_vec(&force_mpc_solver, q, low, high) || osqp_warm_start(&force_mpc_solver, first, start) ||
      osqp_solve(&force_mpc_solver)) return 0;
  s->iterations = (int)force_mpc_solver.info->iter;
  if (force_mpc_solver.info->rho_updates) osqp_update_rho(&force_mpc_solver, mpc_rho);
  OSQPInt status = force_mpc_solver.info->status_val;
  if (status != OSQP_SOLVED && status != OSQP_MAX_ITER_REACHED) return 0;
  const OSQPFloat *theta = force_mpc_solver.solution->x, *dual = force_mpc_solver.solution->y;
  for (int i = 0; i < VARIABLES; i++) if (!finite_number(theta[i])) return 0;
  for (int i = 0; i < ROWS; i++) if (!finite_number(dual[i])) return 0;
  memcpy(s->dual, dual, sizeof s->dual); /* the next step goes on from here, whether or not this plan is used */
  for (int i = 0; i < ROWS; i++) {
    OSQPFloat value = row(theta, i);
    if (value < low[i] - mpc_violation || value > high[i] + mpc_violation) return 0;
  }
  for (int i = 0; i < KNOTS; i++) plan[i] = mpc_limit * theta[i] + rest;
  return 1;
}

#if FORCE_MPC_GATE
/* Whether a measurement is believed: in range, and no further from the last than the plant moves since. */
static int believed(force_mpc *s, OSQPFloat measurement) {
  OSQPFloat moved = measurement > s->measurement ? measurement - s->measurement : s->measurement - measurement;
  if (s->refused > FORCE_MPC_MAX_HELD) return 0;
  if (!(measurement >= mpc_low && measurement <= mpc_high) ||
      (s->known && !(moved <= mpc_step * (OSQPFloat)(s->refused + 1)))) {
    s->refused++;
    return 0;
  }
  s->measurement = measurement;
  s->known = 1;
  s->refused = 0;
  return 1;
}
#endif

void force_mpc_reset(force_mpc *s) {
  memset(s, 0, sizeof *s);
  s->age = FORCE_MPC_HORIZON;
}

OSQPFloat force_mpc_step(force_mpc *s, OSQPFloat reference, OSQPFloat measurement) {
  return force_mpc_step_ahead(s, &reference, 1, measurement);
}

OSQPFloat force_mpc_step_ahead(force_mpc *s, const OSQPFloat *references, int count, OSQPFloat measurement) {
  OSQPFloat ahead[STATES], error[PLANT + 1], target[PREVIEW + 1], delta[KNOWN + 1], plan[KNOTS], dual[ROWS];
  OSQPFloat least, most;
  OSQPFloat innovation = measurement - mpc_offset - dot(mpc_C, s->z, STATES);
  int used = finite_number(innovation);
#if FORCE_MPC_GATE
  used = believed(s, measurement);
#endif
  s->status = used ? FORCE_MPC_OK : FORCE_MPC_HELD;
  if (used)
    for (int i = 0; i < STATES; i++) s->z[i] += mpc_gain[i] * innovation;
  s->estimate = dot(mpc_C, s->z, STATES);

  memcpy(ahead, s->z, sizeof ahead);
  for (int i = 0; i < DELAY; i++) advance(ahead, s->past[i]);
  OSQPFloat drift = ahead[STATES - 1];
  admissible_rest(drift, &least, &most);
  OSQPFloat last = s->reference, rest = 0;
  for (int i = 0; i <= PREVIEW; i++) {
    if (i < count && finite_number(references[i])) last = references[i];
    if (i == 0) s->reference = last;
    rest = clip(last / mpc_static_gain - drift, least, most);
    target[i] = mpc_static_gain * (rest + drift);
  }
  delta[KNOWN] = 0;
  for (int j = 0; j < KNOWN; j++) {
    const OSQPFloat *at = target + DELAY + j;
    delta[j] = at[0] - target[PREVIEW] + mpc_lag * (at[1] - at[0]);
  }
  for (int i = 0; i < PLANT; i++) error[i] = ahead[i] - mpc_rest[i] * (rest + drift);
  error[PLANT] = s->command - rest;

  for (int i = 0; i < KNOTS; i++) plan[i] = dot(mpc_shift[i], s->plan, KNOTS);
  memcpy(dual, s->dual, sizeof dual);
  memset(s->dual, 0, sizeof s->dual); /* of a program that fails */
  s->solved = solve(s, plan, dual, error, delta, rest, drift);
  if (!s->solved && s->age >= FORCE_MPC_HORIZON)
    for (int i = 0; i < KNOTS; i++) plan[i] = rest; /* else the last plan goes on */
  s->age = s->solved ? 0 : s->age < FORCE_MPC_HORIZON ? s->age + 1 : FORCE_MPC_HORIZON;
#if FORCE_MPC_GATE
  if (s->refused > FORCE_MPC_MAX_HELD) {
    s->status = FORCE_MPC_FAULT;
    s->solved = 0;
    s->age = FORCE_MPC_HORIZON;
    memset(s->dual, 0, sizeof s->dual);
    rest = s->command > mpc_ramp ? s->command - mpc_ramp : s->command < -mpc_ramp ? s->command + mpc_ramp : 0;
    for (int i = 0; i < KNOTS; i++) plan[i] = rest;
  }
#endif
  memcpy(s->plan, plan, sizeof s->plan);
  OSQPFloat command = plan[0];
#if FORCE_MPC_SLEWS
  command = clip(command, s->command - mpc_slew, s->command + mpc_slew);
#endif
  s->command = clip(command, -mpc_limit, mpc_limit);
  s->past[DELAY] = s->command;
  advance(s->z, s->past[0]);
  memmove(s->past, s->past + 1, DELAY * sizeof *s->past);
  return s->command;
}
