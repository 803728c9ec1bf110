#include "force_mpc.h"

#include <string.h>

#include "force_mpc_workspace.h"
#include "osqp.h"

#define STATES FORCE_MPC_STATES
#define PLANT (FORCE_MPC_PLANT_STATES)
#define KNOTS FORCE_MPC_KNOTS
#define ROWS FORCE_MPC_ROWS
#define DELAY FORCE_MPC_DELAY

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

/* Row i of the program's constraints, times theta. */
static OSQPFloat row(const OSQPFloat *theta, int i) {
#if ROWS > KNOTS
  if (i >= KNOTS) return dot(mpc_M[i - KNOTS], theta, KNOTS);
#endif
  return theta[i];
}

/* Solve from the last plan, shifted; return whether there is a solution that can be used. */
static int solve(force_mpc *s, const OSQPFloat *error, OSQPFloat rest) {
  OSQPFloat q[KNOTS], low[ROWS], high[ROWS], first[KNOTS];
  for (int i = 0; i < KNOTS; i++) {
    q[i] = dot(mpc_F[i], error, PLANT + 1);
    first[i] = (dot(mpc_shift[i], s->plan, KNOTS) - rest) / mpc_limit;
    low[i] = -1 - rest / mpc_limit;
    high[i] = 1 - rest / mpc_limit;
  }
#if ROWS > KNOTS
  for (int i = KNOTS; i < ROWS; i++) {
    OSQPFloat start = i == KNOTS ? (s->command - rest) / mpc_slew : 0;
    low[i] = start - 1;
    high[i] = start + 1;
  }
#endif
  if (osqp_update_data_vec(&force_mpc_solver, q, low, high) || osqp_warm_start(&force_mpc_solver, first, s->dual) ||
      osqp_solve(&force_mpc_solver)) return 0;
  s->iterations = (int)force_mpc_solver.info->iter;
  if (force_mpc_solver.info->rho_updates) osqp_update_rho(&force_mpc_solver, mpc_rho);
  if (force_mpc_solver.info->status_val != OSQP_SOLVED) return 0;
  const OSQPFloat *theta = force_mpc_solver.solution->x, *dual = force_mpc_solver.solution->y;
  for (int i = 0; i < KNOTS; i++) if (!finite_number(theta[i])) return 0;
  for (int i = 0; i < ROWS; i++) {
    OSQPFloat value = row(theta, i);
    if (!finite_number(dual[i]) || value < low[i] - mpc_violation || value > high[i] + mpc_violation) return 0;
  }
  for (int i = 0; i < KNOTS; i++) s->plan[i] = mpc_limit * theta[i] + rest;
  memcpy(s->dual, dual, sizeof s->dual);
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

void force_mpc_reset(force_mpc *s) { memset(s, 0, sizeof *s); }

OSQPFloat force_mpc_step(force_mpc *s, OSQPFloat reference, OSQPFloat measurement) {
  OSQPFloat ahead[STATES], error[PLANT + 1];
  if (finite_number(reference)) s->reference = reference;
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
  OSQPFloat rest = clip(s->reference / mpc_static_gain - drift, -mpc_limit, mpc_limit);
  for (int i = 0; i < PLANT; i++) error[i] = ahead[i] - mpc_rest[i] * (rest + drift);
  error[PLANT] = s->command - rest;

  s->solved = solve(s, error, rest);
#if FORCE_MPC_GATE
  if (s->refused > FORCE_MPC_MAX_HELD) {
    s->status = FORCE_MPC_FAULT;
    s->solved = 0;
    rest = s->command > mpc_ramp ? s->command - mpc_ramp : s->command < -mpc_ramp ? s->command + mpc_ramp : 0;
  }
#endif
  if (!s->solved) {
    for (int i = 0; i < KNOTS; i++) s->plan[i] = rest;
    memset(s->dual, 0, sizeof s->dual);
  }
  OSQPFloat command = s->plan[0];
#if ROWS > KNOTS
  command = clip(command, s->command - mpc_slew, s->command + mpc_slew);
#endif
  s->command = clip(command, -mpc_limit, mpc_limit);
  s->past[DELAY] = s->command;
  advance(s->z, s->past[0]);
  memmove(s->past, s->past + 1, DELAY * sizeof *s->past);
  return s->command;
}
