/* Built with these constants in front (see seaopt/simulation/compiled.py):
     NX states, NU inputs, NY outputs; NJP and NCP: room for the columns of Z and of v, in whole vectors, so that one kernel
     serves all unknowns that fit in it;
     NI linear only: forcing terms (inputs in force, and the constant); NQ not linear only: parameters with derivatives;
     LINEAR, STEPPED, JOINT, CORRECT 0 or 1;
     MEASURED 0 where there are no measured outputs: simulations alone, which make no derivatives;
     DELAYED of a linear plant how many inputs in force are besides u_a; of another 0, or with a free delay 1, or 2 where the
     delay moves the inputs themselves, which are then joined by lines. */
#include <math.h>

#define MAX_SECTIONS 8

/* The C library's tanh is several times slower, and its exp is a call that empties all vector registers. With
   e^2|x| = 2^k (1 + 2 r / D) and D of fdlibm's exp, |r| <= ln 2 / 2, one division is left; nothing cancels at 0. */
static inline double seaopt_tanh(double x) {
    const double size = fabs(x) > 20.0 ? 40.0 : 2.0 * fabs(x), shifted = size * 0x1.71547652b82fep0 + 0x1.8p52;
    const double k = shifted - 0x1.8p52, r = (size - k * 0x1.62e42feep-1) - k * 0x1.a39ef35793c76p-33, s = r * r;
    const double d = 2.0 - r + s * ((1.66666666666666019037e-01 + s * -2.77777777770155933842e-03)
        + s * s * ((6.61375632143793436117e-05 + s * -1.65339022054652515390e-06) + s * s * 4.13813679705723846039e-08));
    union { double value; unsigned long long bits; } whole = {shifted}, scale;
    scale.bits = (whole.bits + 1023) << 52; /* 2^k */
    const double up = scale.value * (2.0 * r);
    return copysign((up + (scale.value - 1.0) * d) / (up + (scale.value + 1.0) * d), x);
}
#define tanh seaopt_tanh
