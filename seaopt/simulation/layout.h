/* Sizes of the arrays of a pass. Built with these constants in front (see seaopt/simulation/compiled.py):
     NX states, NU inputs, NY outputs, ND drift terms per output,
     NP derivatives that are shared: parameters (NQ), then a free delay, then what only the correction gain depends on;
     NI linear only: forcing terms (inputs in force, and the constant); LINEAR, STEPPED, CORRECT 0 or 1;
     MEASURED 0 where there are no measured outputs: simulations alone, which make no derivatives;
     DELAYED of a linear plant how many inputs in force are besides u_a; of another 0, or with a free delay 1, or 2 where the
     delay moves the inputs themselves, which are then joined by lines. */
#include <math.h>

#define PADDED(n) (((n) + 3) / 4 * 4)
#define OWN (2 + ND)
#define NS (1 + NP + NX)                     /* residual or state, shared, initial state */
#define NJ (NS + (CORRECT ? NY * OWN : 0))   /* columns of Z */
#define NC (NS + (CORRECT ? NY : 1) * OWN)   /* columns of v */
#define NJP PADDED(NJ)
#define NCP PADDED(NC)
#define MAX_SECTIONS 8

/* The C library's tanh is several times slower than its exp. Below 1/32 the series, whose next term is 1e-17. */
static inline double seaopt_tanh(double x) {
    const double size = fabs(x), s = x * x;
    if (size < 0.03125) return x * (1.0 + s * (-1.0 / 3 + s * (2.0 / 15 + s * (-17.0 / 315 + s * (62.0 / 2835)))));
    const double e = exp(-2.0 * size);
    return copysign((1.0 - e) / (1.0 + e), x);
}
#define tanh seaopt_tanh

