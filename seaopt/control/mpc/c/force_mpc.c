#include "force_mpc.h"

#include <string.h>

#include "arithmetic.h"
#if FORCE_MPC_HEAT
#include "heat.h"
#endif

#define STATES FORCE_MPC_STATES
#define PLANT (FORCE_MPC_PLANT_STATES)
#define KNOTS FORCE_MPC_KNOTS
#define ROWS FORCE_MPC_ROWS
#define SIGNALS FORCE_MPC_SIGNALS /* with bounds, each held at SAMPLES of the horizon */
#define SAMPLES FORCE_MPC_SAMPLES
#define LIMITS (ROWS - 2 * SIGNALS * SAMPLES - SIGNALS) /* rows of the command, before those of the signals */
#define VARIABLES FORCE_MPC_VARIABLES
#define DELAY FORCE_MPC_DELAY
#define PREVIEW FORCE_MPC_PREVIEW
#define LINK_ORDER FORCE_MPC_LINK_ORDER
#define KNOWN (PREVIEW > DELAY ? PREVIEW - DELAY : 0) /* samples of the horizon whose references differ */

static int finite_number(real x) { return x - x == 0; }

/* Of what is given: finite, and within a range in which nothing that follows overflows. */
static int is_number(real x) { return x >= (real)-1e15 && x <= (real)1e15; }

#if FORCE_MPC_OUTER
#include "outer.h"

real force_mpc_outer(force_mpc *s, real reference, real position) {
  return outer_reference(&s->outer_state, &s->outer_known, &s->outer_last, reference, position);
}
#endif

#if FORCE_MPC_PREFILTER
/* A value behind a filter, in transposed form. */
static real shape(real *state, int order, const real *num, const real *den, real value) {
  real out = num[0] * value + state[0];
  for (int i = 0; i < order; i++)
    state[i] = num[i + 1] * value - den[i + 1] * out + (i + 1 < order ? state[i + 1] : 0);
  return out;
}
#endif

static real clip(real x, real low, real high) { return x < low ? low : x > high ? high : x; }

#if FORCE_MPC_TERMS
#if FORCE_MPC_GRAVITY || FORCE_MPC_RIPPLE || FORCE_MPC_FRICTION
static real limited(real x, real most) { return clip(x, -most, most); }
#endif
#include "terms.h"

#if FORCE_MPC_LINK
/* The link's place behind its filters, at rest before, in transposed form. All of it is double: poles and zeros lie so
   near 1 that in float they would be others. */
static double feed_back(double *state, int *known, double place) {
  if (!*known)
    for (int i = LINK_ORDER; i-- > 0;)
      state[i] = (LINK_NUM[i + 1] - LINK_REST * LINK_DEN[i + 1]) * place + (i + 1 < LINK_ORDER ? state[i + 1] : 0);
  *known = 1;
  double out = LINK_NUM[0] * place + state[0];
  for (int i = 0; i < LINK_ORDER; i++)
    state[i] = LINK_NUM[i + 1] * place - LINK_DEN[i + 1] * out + (i + 1 < LINK_ORDER ? state[i + 1] : 0);
  return out;
}
#endif

void force_mpc_terms(force_mpc *s, real reference, const real *readings) {
  int used = is_number(reference);
  for (int i = 0; i < FORCE_MPC_READINGS; i++) used = used && is_number(readings[i]);
  (void)readings;
  s->unread = !used;
  if (!used) return;
  real effort = 0;
#if FORCE_MPC_GRAVITY
  s->weight = weight_at(readings[FORCE_MPC_GRAVITY - 1]);
#endif
#if FORCE_MPC_RIPPLE
  effort += ripple_at(readings[FORCE_MPC_RIPPLE - 1]);
#endif
#if FORCE_MPC_FRICTION
#if FORCE_MPC_FRICTION > 1
  real now = readings[FORCE_MPC_FRICTION - 2];
#else
  real now = reference;
#endif
  if (s->differenced) effort += FRICTION_EFFORT * limited(FRICTION_SHARE * (now - s->before), 1);
  s->before = now;
  s->differenced = 1;
#endif
#if FORCE_MPC_LINK
  effort -= (real)feed_back(s->linked, &s->linked_known, readings[FORCE_MPC_LINK - 1]);
#endif
  s->added = mpc_per_effort * effort;
}
#endif

/* The limit of the command at this sample. */
static real limit_of(const force_mpc *s) {
#if FORCE_MPC_HEAT
  return (real)s->limit;
#else
  (void)s;
  return mpc_limit;
#endif
}

/* z := A z + B newer + B' older: where a drive's delay is no whole number of samples, the older command still acts */
static void advance(real *z, real older, real newer) {
  real next[STATES];
  for (int i = 0; i < STATES; i++) next[i] = dot(mpc_A[i], z, STATES) + mpc_B[i] * newer + mpc_late[i] * older;
  memcpy(z, next, sizeof next);
}

/* Row i of the program's constraints, times its variables. */
static real row(const real *theta, int i) {
  if (i < KNOTS) return theta[i];
#if FORCE_MPC_SLEWS
  if (i < LIMITS) return dot(mpc_M[i - KNOTS], theta, KNOTS);
#endif
#if SIGNALS
  i -= LIMITS;
  if (i < 2 * SIGNALS * SAMPLES) {
    int upper = i < SIGNALS * SAMPLES, k = upper ? i : i - SIGNALS * SAMPLES;
    real slack = mpc_slack_unit * theta[KNOTS + k / SAMPLES];
    return dot(mpc_forced[k], theta, KNOTS) + (upper ? -slack : slack);
  }
  return theta[KNOTS + i - 2 * SIGNALS * SAMPLES];
#else
  return 0;
#endif
}

/* Ends of the commands at rest that keep the bounds of signals, within given ones: the least and the largest. */
static void admissible_rest(real bottom, real top, real drift, real *low, real *high) {
  *low = bottom;
  *high = top;
#if SIGNALS
  for (int i = 0; i < SIGNALS; i++) {
    if (mpc_static[i] == 0) continue;
    real one = (mpc_centre[i] - 1) / mpc_static[i] - drift, other = (mpc_centre[i] + 1) / mpc_static[i] - drift;
    real least = one < other ? one : other, most = one < other ? other : one;
    if (least > *low) *low = least;
    if (most < *high) *high = most;
  }
  *low = clip(*low, bottom, top);
  *high = clip(*high, bottom, top);
  if (*low > *high) *low = *high = (*low + *high) / 2;
#endif
  (void)drift;
}

/* Limits of all rows; `added`: to the command that is planned. */
static void limit_rows(const force_mpc *s, const real *error, real rest, real drift, real added, real *low,
                       real *high) {
  real share = limit_of(s) / mpc_limit;
  for (int i = 0; i < KNOTS; i++) {
    low[i] = -share - rest / mpc_limit - added / mpc_limit;
    high[i] = share - rest / mpc_limit - added / mpc_limit;
  }
#if FORCE_MPC_SLEWS
  for (int i = KNOTS; i < LIMITS; i++) {
    real start = i == KNOTS ? (s->command - added - rest) / mpc_slew : 0;
    low[i] = start - 1;
    high[i] = start + 1;
  }
#endif
#if SIGNALS
  for (int k = 0; k < SIGNALS * SAMPLES; k++) {
    real base = mpc_static[k / SAMPLES] * (rest + drift) - mpc_centre[k / SAMPLES] + dot(mpc_free[k], error, PLANT + 1);
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
  (void)error, (void)drift;
}

/* Put the solution into `plan` if it can be used; return whether it can. */
static int solve(force_mpc *s, real *plan, const real *error, const real *delta, real rest, real drift, real added) {
  real q[VARIABLES], low[ROWS], high[ROWS], theta[VARIABLES];
  for (int i = 0; i < VARIABLES; i++) q[i] = i < KNOTS ? dot(mpc_F[i], error, PLANT + 1) : mpc_penalty;
#if KNOWN
  for (int i = 0; i < KNOTS; i++) q[i] += dot(mpc_R[i], delta, KNOWN);
#endif
  (void)delta;
  limit_rows(s, error, rest, drift, added, low, high);
  force_mpc_ending ending = force_mpc_minimise(&s->program, q, low, high, theta);
  s->iterations = s->program.iterations;
  if (ending == FORCE_MPC_INFEASIBLE) return 0;
  for (int i = 0; i < VARIABLES; i++)
    if (!finite_number(theta[i])) {
      memset(s->program.side, 0, sizeof s->program.side); /* the next step starts afresh */
      return 0;
    }
  for (int i = 0; i < ROWS; i++) {
    real value = row(theta, i);
    if (value < low[i] - mpc_violation || value > high[i] + mpc_violation) return 0;
  }
  for (int i = 0; i < KNOTS; i++) plan[i] = mpc_limit * theta[i] + rest;
  return 1;
}

#if FORCE_MPC_GATE
/* Whether a measurement is believed: in range, and no further from the last than the plant moves since. */
static int believed(force_mpc *s, real measurement) {
  real moved = measurement > s->measurement ? measurement - s->measurement : s->measurement - measurement;
  if (s->refused > FORCE_MPC_MAX_HELD) return 0;
  if (!(measurement >= mpc_low && measurement <= mpc_high) ||
      (s->known && !(moved <= mpc_step * (real)(s->refused + 1)))) {
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

real force_mpc_step(force_mpc *s, real reference, real measurement) {
  return force_mpc_step_ahead(s, &reference, 1, measurement);
}

real force_mpc_step_ahead(force_mpc *s, const real *references, int count, real measurement) {
  real ahead[STATES], error[PLANT + 1], target[PREVIEW + 1], delta[KNOWN + 1], plan[KNOTS];
  real least, most;
  real innovation = measurement - mpc_offset - dot(mpc_C, s->z, STATES);
  int used = is_number(measurement), lost = !used;
#if FORCE_MPC_GATE
  used = believed(s, measurement);
  lost = 0;
#endif
#if FORCE_MPC_TERMS
  lost = lost || s->unread;
#endif
  s->held = lost ? s->held + 1 : 0;
  s->status = used ? FORCE_MPC_OK : FORCE_MPC_HELD;
  if (used)
    for (int i = 0; i < STATES; i++) s->z[i] += mpc_gain[i] * innovation;
  s->estimate = dot(mpc_C, s->z, STATES);

  memcpy(ahead, s->z, sizeof ahead);
  for (int i = 0; i < DELAY; i++) advance(ahead, s->past[i], s->past[i + 1]);
  real drift = ahead[STATES - 1];
#if FORCE_MPC_HEAT
  s->limit = cool_command(s->rise_winding, s->rise_case);
  if (!(s->limit < (double)mpc_limit)) s->limit = (double)mpc_limit;
#endif
  real last = s->reference, rest = 0, weight = 0, added = 0;
#if FORCE_MPC_TERMS
  weight = s->weight;
  added = s->added;
#endif
#if FORCE_MPC_GATE
  if (s->refused > FORCE_MPC_MAX_HELD) added = 0;
#endif
  admissible_rest(-limit_of(s) - added, limit_of(s) - added, drift, &least, &most);
#if FORCE_MPC_PREFILTER
  real shaped[FORCE_MPC_PREFILTER];
  memcpy(shaped, s->shaped, sizeof shaped);
#endif
  for (int i = 0; i <= PREVIEW; i++) {
    if (i < count && is_number(references[i])) last = references[i];
    if (i == 0) s->reference = last;
    real asked = last + weight;
#if FORCE_MPC_PREFILTER
    asked = shape(shaped, FORCE_MPC_PREFILTER, mpc_prefilter_num, mpc_prefilter_den, asked);
    if (i == 0) memcpy(s->shaped, shaped, sizeof shaped);
#endif
    rest = clip(asked / mpc_static_gain - drift, least, most);
    target[i] = mpc_static_gain * (rest + drift);
  }
  s->target = target[PREVIEW];
  delta[KNOWN] = 0;
  for (int j = 0; j < KNOWN; j++) {
    const real *at = target + DELAY + j;
    delta[j] = at[0] - target[PREVIEW] + mpc_lag * (at[1] - at[0]);
  }
  for (int i = 0; i < PLANT; i++) error[i] = ahead[i] - mpc_rest[i] * (rest + drift);
  error[PLANT] = s->past[DELAY] - rest; /* the last that was planned */

  for (int i = 0; i < KNOTS; i++) plan[i] = dot(mpc_shift[i], s->plan, KNOTS);
  s->solved = solve(s, plan, error, delta, rest, drift, added);
  if (!s->solved && s->age >= FORCE_MPC_HORIZON)
    for (int i = 0; i < KNOTS; i++) plan[i] = rest; /* else the last plan goes on */
  s->age = s->solved ? 0 : s->age < FORCE_MPC_HORIZON ? s->age + 1 : FORCE_MPC_HORIZON;
#if FORCE_MPC_GATE
  if (s->refused > FORCE_MPC_MAX_HELD) {
    s->status = FORCE_MPC_FAULT;
    s->solved = 0;
    s->age = FORCE_MPC_HORIZON;
    memset(s->program.side, 0, sizeof s->program.side);
    rest = s->command > mpc_ramp ? s->command - mpc_ramp : s->command < -mpc_ramp ? s->command + mpc_ramp : 0;
    for (int i = 0; i < KNOTS; i++) plan[i] = rest;
  }
#endif
  memcpy(s->plan, plan, sizeof s->plan);
  real command = plan[0] + added;
#if FORCE_MPC_SLEWS
  command = clip(command, s->command - mpc_slew, s->command + mpc_slew);
#endif
  s->command = clip(command, -limit_of(s), limit_of(s));
#if FORCE_MPC_HEAT
  warm(&s->rise_winding, &s->rise_case, (double)s->command);
#endif
  s->past[DELAY + 1] = s->command - added;
  advance(s->z, s->past[0], s->past[1]);
  memmove(s->past, s->past + 1, (DELAY + 1) * sizeof *s->past);
  return s->command;
}
