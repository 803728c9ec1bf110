/* Constrained force control, written by seaopt: one step a sample, no allocation.
 * Compile force_mpc.c and active_set.c with your program (beside an exported law example.c is one), with
 *     cc -std=c99 -O2 -ffp-contract=off force_mpc.c active_set.c program.c -lm
 * (fused products and sums round differently from Python; -ffast-math and -ffinite-math-only are refused, for they take
 * out the check for numbers that are not finite). */
#ifndef FORCE_MPC_H
#define FORCE_MPC_H

#include "active_set.h"

typedef struct {
  force_mpc_real z[FORCE_MPC_STATES];  /* predicted state, last its disturbance, in the command's unit */
  force_mpc_real past[FORCE_MPC_DELAY + 2]; /* commands that still act, oldest first; the last entry is scratch */
  force_mpc_real command;              /* the last, a FORCE_MPC_COMMAND in FORCE_MPC_COMMAND_UNIT */
  force_mpc_real reference;            /* the last that was finite, in FORCE_MPC_UNIT as what is measured */
  force_mpc_real target;               /* the last reference known, or the nearest that the limits can hold */
  force_mpc_real estimate;             /* of what is measured */
  force_mpc_real plan[FORCE_MPC_KNOTS];
  force_mpc_program program;      /* what it held last is where the next begins */
  int solved;                     /* 0: the command is that of the last plan, or after a horizon without one, of rest */
  int age;                        /* samples since a program was solved */
  int iterations;                 /* of the last program; FORCE_MPC_MAX_ITERATIONS at most, whatever the input */
  int status;                     /* FORCE_MPC_OK, _HELD or _FAULT */
  unsigned long held;             /* samples in a row with a reading that is no number; the gate answers in `status` */
  unsigned long refused;          /* measurements in a row that the gate did not believe */
  force_mpc_real measurement;          /* the last that was */
  int known;                      /* whether there was one */
#if FORCE_MPC_OUTER
  force_mpc_real outer_state, outer_last; /* what is taken off the link's next difference, the last reference asked */
  int outer_known;
#endif
#if FORCE_MPC_TERMS
  force_mpc_real weight, added;   /* to the references, to the command */
  force_mpc_real before;          /* what was differenced last */
  int differenced;                /* whether there was one */
  int unread;                     /* whether a reading was no number */
#if FORCE_MPC_LINK
  double linked[FORCE_MPC_LINK_ORDER]; /* what the filters of the link's motion keep */
  int linked_known;
#endif
#endif
#if FORCE_MPC_PREFILTER
  force_mpc_real shaped[FORCE_MPC_PREFILTER]; /* what the low-pass of the reference keeps */
#endif
#if FORCE_MPC_HEAT
  double rise_winding, rise_case; /* K above the ambient, as estimated; a reset takes both for cold */
  double limit;                   /* of the command at this sample: it falls as the winding warms up */
#endif
} force_mpc;

/* The measurement was used; it was predicted instead; a fault: the command goes to zero until a reset. The last is
 * reported with a plausibility gate alone (FORCE_MPC_GATE). */
enum { FORCE_MPC_OK, FORCE_MPC_HELD, FORCE_MPC_FAULT };

/* At rest at zero; with a plausibility gate the first measurement is believed if it is in range. */
void force_mpc_reset(force_mpc *s);

/* What to command (FORCE_MPC_COMMAND, in FORCE_MPC_COMMAND_UNIT) for a reference and a measurement, both in
 * FORCE_MPC_UNIT; it is within limits whatever the input. Put it out FORCE_MPC_COMPUTE_DELAY_SAMPLES samples after the
 * reading (1: at the next sample); it stands until the next. From then on the drive takes its own time, which is counted
 * (FORCE_MPC_DELAYS has both), so do not wait for it.
 * A measurement that is not finite or beyond +-1e15 is predicted; such a reference leaves the last one. */
force_mpc_real force_mpc_step(force_mpc *s, force_mpc_real reference, force_mpc_real measurement);

#if FORCE_MPC_OUTER
/* Once a sample, before force_mpc_step: the reference that renders the impedance, of where the link is to be and where it
 * is, in m or rad, read in the same sample as the measurement. Where either is no number the last one stands. Without
 * stiffness the first does nothing: a force that is asked for besides is added to what this returns. */
force_mpc_real force_mpc_outer(force_mpc *s, force_mpc_real reference, force_mpc_real position);
#endif

#if FORCE_MPC_TERMS
/* Once a sample, before force_mpc_step: what is compensated and fed forward of the link's motion, by the reference (with an outer loop what that returned) and
 * FORCE_MPC_READINGS readings, FORCE_MPC_READ in this order, taken in the same sample as the measurement. The step adds the
 * weight to all of its references and the rest to its command, within limits. Where one is no number all stays as it was. */
void force_mpc_terms(force_mpc *s, force_mpc_real reference, const force_mpc_real *readings);
#endif

/* The same with references known ahead: `count` of them, of this sample and of those that follow, the last of which is
 * held. More than 1 + FORCE_MPC_PREVIEW are not read. */
force_mpc_real force_mpc_step_ahead(force_mpc *s, const force_mpc_real *references, int count, force_mpc_real measurement);

#endif
