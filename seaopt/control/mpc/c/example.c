/* Lines in: 1 + FORCE_MPC_PREVIEW references, of this sample and those that follow, and the measurement.
 * Lines out: command, solved, iterations, the step's time (s) and status. */
#include <stdio.h>
#include <time.h>

#include "force_mpc.h"

static int read_line(force_mpc_real *values, int count) {
  for (int i = 0; i < count; i++) {
    double value;
    if (scanf("%lf", &value) != 1) return 0;
    values[i] = (force_mpc_real)value;
  }
  return 1;
}

int main(void) {
  static force_mpc controller;
  force_mpc_real line[FORCE_MPC_PREVIEW + 2];
  force_mpc_reset(&controller);
  while (read_line(line, FORCE_MPC_PREVIEW + 2)) {
    clock_t began = clock();
    double command =
        (double)force_mpc_step_ahead(&controller, line, FORCE_MPC_PREVIEW + 1, line[FORCE_MPC_PREVIEW + 1]);
    double took = (double)(clock() - began) / CLOCKS_PER_SEC;
    printf("%.17g %d %d %.9f %d\n", command, controller.solved, controller.iterations, took, controller.status);
  }
  return 0;
}
