/* The quadratic program of force_mpc by the dual active-set method (Goldfarb and Idnani, 1983). */
#ifndef FORCE_MPC_ACTIVE_SET_H
#define FORCE_MPC_ACTIVE_SET_H

#include "force_mpc_data.h"

#define FORCE_MPC_VARIABLES (FORCE_MPC_KNOTS + FORCE_MPC_SIGNALS)

typedef struct {
  signed char side[FORCE_MPC_ROWS];  /* 1: the row is held at its high end, -1: at its low one, 0: at none */
  int held[FORCE_MPC_VARIABLES];     /* rows, of which there are `count` */
  int count;
  int iterations;                    /* rows taken in or let go after the start */
  force_mpc_real dual[FORCE_MPC_VARIABLES];
  force_mpc_real Q[FORCE_MPC_VARIABLES][FORCE_MPC_VARIABLES]; /* orthogonal */
  force_mpc_real R[FORCE_MPC_VARIABLES][FORCE_MPC_VARIABLES]; /* lower triangle: normals of held rows are R Q */
} force_mpc_program;

typedef enum { FORCE_MPC_SOLVED, FORCE_MPC_UNFINISHED, FORCE_MPC_INFEASIBLE } force_mpc_ending;

/* Minimise x'Hx/2 + q'x with rows between low and high, from rows held as `side` has them, and leave it for the next.
 * After FORCE_MPC_MAX_ITERATIONS changes x is the best for the rows held so far. */
force_mpc_ending force_mpc_minimise(force_mpc_program *s, const force_mpc_real *q, const force_mpc_real *low,
                                    const force_mpc_real *high, force_mpc_real *x);

#endif
