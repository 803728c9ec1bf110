/* What both sources compute with; no part of the interface, so that it puts nothing into the program around them. */
#ifndef FORCE_MPC_ARITHMETIC_H
#define FORCE_MPC_ARITHMETIC_H

#include "force_mpc_data.h"

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && (__FINITE_MATH_ONLY__ > 0)) || defined(_M_FP_FAST)
#error "compile without -ffast-math and -ffinite-math-only: they take out the check for numbers that are not finite"
#endif
#if defined(__clang__) || !defined(__GNUC__)
#pragma STDC FP_CONTRACT OFF
#endif

typedef force_mpc_real real;

static real dot(const real *a, const real *b, int n) {
  real sum = 0;
  for (int i = 0; i < n; i++) sum += a[i] * b[i];
  return sum;
}

#endif
