/* Constrained force control, written by seaopt: one step a sample, no allocation.
 * Compile the .c files of this folder (example.c is a program around it) and of src, with
 *     cc -std=c99 -O2 -Iinc/public -Iinc/private -I.
 * The solver's workspace is static: one controller a program. */
#ifndef FORCE_MPC_H
#define FORCE_MPC_H

#include "force_mpc_data.h"

typedef struct {
  OSQPFloat z[FORCE_MPC_STATES];  /* predicted state, last its disturbance, in the command's unit */
  OSQPFloat past[FORCE_MPC_DELAY + 1]; /* commands on their way, oldest first; the last entry is scratch */
  OSQPFloat command;              /* the last, a FORCE_MPC_COMMAND in FORCE_MPC_COMMAND_UNIT */
  OSQPFloat reference;            /* the last that was finite, in FORCE_MPC_UNIT as what is measured */
  OSQPFloat estimate;             /* of what is measured */
  OSQPFloat plan[FORCE_MPC_KNOTS];
  OSQPFloat dual[FORCE_MPC_ROWS];
  int solved;                     /* 0: the command is that of the last plan, or after a horizon without one, of rest */
  int age;                        /* samples since a program was solved */
  int iterations;                 /* of the last program; FORCE_MPC_MAX_ITERATIONS at most, whatever the input */
  int status;                     /* FORCE_MPC_OK, _HELD or _FAULT */
  unsigned long refused;          /* measurements in a row that were not believed */
  OSQPFloat measurement;          /* the last that was */
  int known;                      /* whether there was one */
} force_mpc;

/* The measurement was used; it was predicted instead; a fault: the command goes to zero until a reset. The last is
 * reported with a plausibility gate alone (FORCE_MPC_GATE). */
enum { FORCE_MPC_OK, FORCE_MPC_HELD, FORCE_MPC_FAULT };

/* At rest at zero; with a plausibility gate the first measurement is believed if it is in range. */
void force_mpc_reset(force_mpc *s);

/* What to command (FORCE_MPC_COMMAND, in FORCE_MPC_COMMAND_UNIT) for a reference and a measurement, both in
 * FORCE_MPC_UNIT; it is within limits whatever the input.
 * A measurement that is not finite is predicted; a reference that is not finite leaves the last one. */
OSQPFloat force_mpc_step(force_mpc *s, OSQPFloat reference, OSQPFloat measurement);

/* The same with references known ahead: `count` of them, of this sample and of those that follow, the last of which is
 * held. More than 1 + FORCE_MPC_PREVIEW are not read. */
OSQPFloat force_mpc_step_ahead(force_mpc *s, const OSQPFloat *references, int count, OSQPFloat measurement);

#endif
