/* The pass of bench_fit.py written by hand: the stand's two states, three parameters, two outputs, all sizes known.

   m: F (2x4), dF (3 of 2x4), H (2x4), dH (3 of 2x4) over [x, u, 1]; g: two 8x8 Gram matrices of
   [residual, 3 parameters, 2 initial states, offset, gain]. Denormal numbers are taken as zero, as in the other. */
#if defined(__SSE2__)
#include <xmmintrin.h>
#endif

void hand_pass(long n, const double *u, const double *y1, const double *y2, const double *m, double *g) {
    const double *F = m, *dF = m + 8, *H = m + 32, *dH = m + 40;
    const double *y[2] = {y1, y2};
#if defined(__SSE2__)
    const unsigned int before = _mm_getcsr();
    _mm_setcsr(before | 0x8040);
#endif
    double x[2] = {0, 0}, s[5][2] = {{0, 0}, {0, 0}, {0, 0}, {1, 0}, {0, 1}}, sum[2][8][8] = {{{0}}};
    for (long k = 0; k < n; k++) {
        for (int o = 0; o < 2; o++) {
            double v[8];
            const double value = H[4 * o] * x[0] + H[4 * o + 1] * x[1] + H[4 * o + 2] * u[k] + H[4 * o + 3];
            v[0] = value - y[o][k];
            for (int j = 0; j < 5; j++) {
                v[1 + j] = H[4 * o] * s[j][0] + H[4 * o + 1] * s[j][1];
                if (j < 3) {
                    const double *d = dH + 8 * j + 4 * o;
                    v[1 + j] += d[0] * x[0] + d[1] * x[1] + d[2] * u[k] + d[3];
                }
            }
            v[6] = 1.0;
            v[7] = value;
            for (int r = 0; r < 8; r++)
                for (int c = r; c < 8; c++) sum[o][r][c] += v[r] * v[c];
        }
        for (int j = 0; j < 5; j++) {
            double a = F[0] * s[j][0] + F[1] * s[j][1], b = F[4] * s[j][0] + F[5] * s[j][1];
            if (j < 3) {
                const double *d = dF + 8 * j;
                a += d[0] * x[0] + d[1] * x[1] + d[2] * u[k] + d[3];
                b += d[4] * x[0] + d[5] * x[1] + d[6] * u[k] + d[7];
            }
            s[j][0] = a;
            s[j][1] = b;
        }
        const double a = F[0] * x[0] + F[1] * x[1] + F[2] * u[k] + F[3];
        x[1] = F[4] * x[0] + F[5] * x[1] + F[6] * u[k] + F[7];
        x[0] = a;
    }
#if defined(__SSE2__)
    _mm_setcsr(before);
#endif
    for (int o = 0; o < 2; o++)
        for (int r = 0; r < 8; r++)
            for (int c = 0; c < 8; c++) g[64 * o + 8 * r + c] = r <= c ? sum[o][r][c] : sum[o][c][r];
}
