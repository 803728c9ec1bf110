/* Built with these constants in front (see seaopt/simulation/compiled.py):
     NX states, NU inputs, NY outputs; NJP and NCP: room for the columns of Z and of v, in whole vectors, so that one library
     serves all unknowns that fit in it; NCP of passes, and lanes;
     MEASURED 0 where there are no measured outputs: simulations alone, which make no derivatives;
     DELAYED of a linear plant how many inputs in force are besides u_a; of another 0, or with a free delay 1, or 2 where the
     delay moves the inputs themselves, which are then joined by lines, or moves where steps begin on a reading's curve;
   of passes and lanes LINEAR, CORRECT 0 or 1; of linear ones NI: forcing terms (inputs in force, and the constant); of others READ: inputs,
     the last ones, that are readings, of the log's own time, and joined by curves;
   of steps and lanes NQ: parameters with derivatives; STEPPED, JOINT 0 or 1; NNZ_FX, NNZ_FP, NNZ_HX, NNZ_HP: nonzero derivatives. */
#include <math.h>
#include <string.h>

#define MAX_SECTIONS 8

#define INLINE static inline __attribute__((always_inline)) /* so that `wide` is a constant */
