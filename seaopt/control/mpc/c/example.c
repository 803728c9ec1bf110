/* Lines of reference and measurement in; command, solved, iterations, the step's time (s) and status out. */
#include <stdio.h>
#include <time.h>

#include "force_mpc.h"

int main(void) {
  static force_mpc controller;
  double reference, measurement;
  force_mpc_reset(&controller);
  while (scanf("%lf %lf", &reference, &measurement) == 2) {
    clock_t began = clock();
    double command = (double)force_mpc_step(&controller, (OSQPFloat)reference, (OSQPFloat)measurement);
    double took = (double)(clock() - began) / CLOCKS_PER_SEC;
    printf("%.17g %d %d %.9f %d\n", command, controller.solved, controller.iterations, took, controller.status);
  }
  return 0;
}
