/* tanh for what waits for nothing else: the C library's is several times slower, and quotients of exponentials divide.
   Between places a = k / 32 it is its Taylor polynomial of degree 7 there, whose coefficients follow from t' = 1 - t^2:
   (n + 1) c[n + 1] = [n = 0] - sum c[i] c[n - i]. What is left out is below 1e-16; one place's coefficients are a line of
   cache. From 20 on it is 1 as far as doubles tell. Rows beyond 640 are for the bits of what is not a number. */
#define TANH_PLACES 32.0
#define TANH_END 20.0

static double tanh_table[1024][8] __attribute__((aligned(64)));

__attribute__((constructor)) static void fill_tanh_table(void) {
    for (int k = 0; k <= (int)(TANH_END * TANH_PLACES); k++) {
        double *c = tanh_table[k];
        c[0] = __builtin_tanh(k / TANH_PLACES);
        for (int n = 0; n < 7; n++) {
            double sum = n == 0;
            for (int i = 0; i <= n; i++) sum -= c[i] * c[n - i];
            c[n + 1] = sum / (n + 1);
        }
    }
}

static inline double seaopt_tanh(double x) {
    const double size = fabs(x) > TANH_END ? TANH_END : fabs(x), shifted = size * TANH_PLACES + 0x1.8p52;
    const double r = size - (shifted - 0x1.8p52) / TANH_PLACES, s = r * r; /* divided by a power of two: a product */
    union { double value; unsigned long long bits; } place = {shifted};
    const double *c = tanh_table[place.bits & 1023];
    const double low = (c[0] + c[1] * r) + s * (c[2] + c[3] * r), high = (c[4] + c[5] * r) + s * (c[6] + c[7] * r);
    return copysign(low + (s * s) * high, x);
}
#define tanh seaopt_tanh
