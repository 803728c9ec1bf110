/* With H = L L' and y = L'x the program asks for the point nearest to y0 = -L^-1 q between the ends of rows, which are
 * scaled so that their normals have length 1. On the rows held y is the nearest point, with multipliers `dual`:
 *     y = y0 + N'dual,   N N'dual = ends - N y0,   N = R Q,
 * N the normals held, signed to point inwards. Rows with negative multipliers are let go, then the row that is broken
 * most is taken in, until none is broken. */
#include "active_set.h"

#include <math.h>
#include <string.h>

#include "arithmetic.h"

#define VARIABLES FORCE_MPC_VARIABLES
#define ROWS FORCE_MPC_ROWS

/* The signed end of row i at which it is held. */
static real end_of(const force_mpc_program *s, int i, const real *low, const real *high) {
  return mpc_scale[i] * (s->side[i] > 0 ? -high[i] : low[i]);
}

/* d := Q n, n the inward normal of a row that is to be held on a side. */
static void project(const force_mpc_program *s, int row, int side, real *d) {
  for (int i = 0; i < VARIABLES; i++) d[i] = (real)-side * dot(s->Q[i], mpc_normals[row], VARIABLES);
}

/* Hold one more row, whose normal is d in Q: a reflection of the free directions puts what is left of d into one. */
static void take_in(force_mpc_program *s, int row, int side, const real *d, real dual) {
  int k = s->count;
  real length = (real)sqrt((double)dot(d + k, d + k, VARIABLES - k)), mirror[VARIABLES], image[VARIABLES];
  real first = d[k] > 0 ? -length : length, square = 2 * length * (length + (d[k] > 0 ? d[k] : -d[k]));
  memcpy(mirror + k, d + k, (size_t)(VARIABLES - k) * sizeof *d);
  mirror[k] -= first;
  memset(image, 0, sizeof image);
  for (int i = k; i < VARIABLES; i++)
    for (int j = 0; j < VARIABLES; j++) image[j] += mirror[i] * s->Q[i][j];
  for (int i = k; i < VARIABLES; i++)
    for (int j = 0; j < VARIABLES; j++) s->Q[i][j] -= 2 / square * mirror[i] * image[j];
  memcpy(s->R[k], d, (size_t)k * sizeof *d);
  s->R[k][k] = first;
  s->held[k] = row;
  s->dual[k] = dual;
  s->side[row] = (signed char)side;
  s->count++;
}

/* Let the j-th row held go: those after it move up, and rotations of two directions make R a triangle again. */
static void let_go(force_mpc_program *s, int j) {
  s->side[s->held[j]] = 0;
  s->count--;
  for (int i = j; i < s->count; i++) {
    s->held[i] = s->held[i + 1];
    s->dual[i] = s->dual[i + 1];
    memcpy(s->R[i], s->R[i + 1], sizeof s->R[i]);
  }
  for (int i = j; i < s->count; i++) {
    real a = s->R[i][i], b = s->R[i][i + 1], length = (real)sqrt((double)(a * a + b * b));
    a /= length;
    b /= length;
    for (int k = i; k < s->count; k++) {
      real one = s->R[k][i], other = s->R[k][i + 1];
      s->R[k][i] = a * one + b * other;
      s->R[k][i + 1] = a * other - b * one;
    }
    for (int k = 0; k < VARIABLES; k++) {
      real one = s->Q[i][k], other = s->Q[i + 1][k];
      s->Q[i][k] = a * one + b * other;
      s->Q[i + 1][k] = a * other - b * one;
    }
  }
}

/* x := R'^-1 x */
static void solve_transposed(const force_mpc_program *s, real *x) {
  for (int i = s->count - 1; i >= 0; i--) {
    for (int j = i + 1; j < s->count; j++) x[i] -= s->R[j][i] * x[j];
    x[i] /= s->R[i][i];
  }
}

/* Multipliers and nearest point of the rows held. */
static void settle(force_mpc_program *s, const real *y0, const real *low, const real *high, real *y) {
  memcpy(y, y0, VARIABLES * sizeof *y);
  for (int i = 0; i < s->count; i++) {
    int row = s->held[i];
    real along = (real)-s->side[row] * dot(mpc_normals[row], y0, VARIABLES);
    s->dual[i] = (end_of(s, row, low, high) - along - dot(s->R[i], s->dual, i)) / s->R[i][i];
    for (int j = 0; j < VARIABLES; j++) y[j] += s->dual[i] * s->Q[i][j];
  }
  solve_transposed(s, s->dual);
}

/* Hold the rows of the last program, without those whose multipliers are negative. */
static void start(force_mpc_program *s, const real *y0, const real *low, const real *high, real *y) {
  real d[VARIABLES];
  memset(s->Q, 0, sizeof s->Q);
  for (int i = 0; i < VARIABLES; i++) s->Q[i][i] = 1;
  s->count = s->iterations = 0;
  for (int i = 0; i < ROWS; i++) {
    if (!s->side[i]) continue;
    project(s, i, s->side[i], d);
    take_in(s, i, s->side[i], d, 0);
  }
  for (;;) {
    int worst = 0;
    settle(s, y0, low, high, y);
    for (int j = 1; j < s->count; j++)
      if (s->dual[j] < s->dual[worst]) worst = j;
    if (!s->count || !(s->dual[worst] < 0)) return;
    let_go(s, worst);
  }
}

/* The row that is broken most, by `*broken`, and its side; -1 where none is by more than the tolerance. */
static int find_broken(const force_mpc_program *s, const real *y, const real *low, const real *high, real tolerance,
                       int *side, real *broken) {
  int row = -1;
  *broken = tolerance;
  for (int i = 0; i < ROWS; i++) {
    if (s->side[i]) continue;
    real value = dot(mpc_normals[i], y, VARIABLES);
    real over = value - mpc_scale[i] * high[i], under = mpc_scale[i] * low[i] - value;
    if (over > *broken || under > *broken) {
      row = i;
      *side = over > under ? 1 : -1;
      *broken = over > under ? over : under;
    }
  }
  return row;
}

/* Hold a row that is broken, once the rows that are in its way are let go. */
static force_mpc_ending mend(force_mpc_program *s, int row, int side, real broken) {
  real d[VARIABLES], share[VARIABLES], taken = 0;
  while (s->iterations < FORCE_MPC_MAX_ITERATIONS) {
    int k = s->count, blocking = -1;
    real partial = 0;
    s->iterations++;
    project(s, row, side, d);
    memcpy(share, d, sizeof share);
    solve_transposed(s, share);
    for (int j = 0; j < k; j++)
      if (share[j] > 0 && (blocking < 0 || s->dual[j] < partial * share[j])) {
        blocking = j;
        partial = s->dual[j] / share[j];
      }
    real rest = dot(d + k, d + k, VARIABLES - k);
    int moves = rest > mpc_dependent;
    if (!moves && blocking < 0) return FORCE_MPC_INFEASIBLE;
    int full = moves && (blocking < 0 || broken <= partial * rest);
    real step = full ? broken / rest : partial;
    for (int j = 0; j < k; j++) s->dual[j] -= step * share[j];
    taken += step;
    if (full) {
      take_in(s, row, side, d, taken);
      return FORCE_MPC_SOLVED;
    }
    if (moves) broken -= step * rest;
    let_go(s, blocking);
  }
  return FORCE_MPC_UNFINISHED;
}

force_mpc_ending force_mpc_minimise(force_mpc_program *s, const real *q, const real *low, const real *high, real *x) {
  real y0[VARIABLES], y[VARIABLES], broken, most = 0;
  force_mpc_ending ending = FORCE_MPC_SOLVED;
  int row, side = 0;
  for (int i = 0; i < VARIABLES; i++) y0[i] = -dot(mpc_inverse[i], q, i + 1);
  for (int i = 0; i < ROWS; i++) {
    real value = dot(mpc_normals[i], y0, VARIABLES);
    if (value > most || -value > most) most = value > 0 ? value : -value;
  }
  start(s, y0, low, high, y);
  while (ending == FORCE_MPC_SOLVED &&
         (row = find_broken(s, y, low, high, mpc_tolerance * (1 + most), &side, &broken)) >= 0) {
    ending = mend(s, row, side, broken);
    settle(s, y0, low, high, y);
  }
  for (int i = 0; i < VARIABLES; i++) {
    x[i] = 0;
    for (int j = i; j < VARIABLES; j++) x[i] += mpc_inverse[j][i] * y[j];
  }
  return ending;
}
