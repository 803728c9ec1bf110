/* In front stands sums.h. */
#include <string.h>

#define INLINE static inline __attribute__((always_inline)) /* so that common sizes are constants */

/* Four rows by one or two vectors of columns, summed in registers over the samples. */
#define TILE(WIDE)                                                                                             \
    do {                                                                                                       \
        vec here[4][WIDE];                                                                                     \
        for (int r = 0; r < 4; r++)                                                                            \
            for (int c = 0; c < WIDE; c++) here[r][c] = ((vec *)(sum + (4 * row + r) * width))[column + c];    \
        for (long k = 0; k < samples; k++) {                                                                   \
            const double *one = v + k * width;                                                                 \
            for (int r = 0; r < 4; r++)                                                                        \
                for (int c = 0; c < WIDE; c++) here[r][c] += (weight[k] * one[4 * row + r]) * ((const vec *)one)[column + c]; \
        }                                                                                                      \
        for (int r = 0; r < 4; r++)                                                                            \
            for (int c = 0; c < WIDE; c++) ((vec *)(sum + (4 * row + r) * width))[column + c] = here[r][c];    \
    } while (0)

INLINE void products(const double *v, const double *weight, long samples, double *sum, long width) {
    for (long row = 0; row < width / 4; row++) {
        long column = row;
        for (; column + 1 < width / 4; column += 2) TILE(2);
        if (column < width / 4) TILE(1);
    }
}

static void add_products(const double *v, const double *weight, long samples, double *sum, long width) {
    switch (width) {
        case 8: products(v, weight, samples, sum, 8); break;
        case 12: products(v, weight, samples, sum, 12); break;
        case 16: products(v, weight, samples, sum, 16); break;
        default: products(v, weight, samples, sum, width);
    }
}

static void add_gram(const double *sum, long width, double *gram, long columns) {
    for (long r = 0; r < columns; r++)
        for (long c = 0; c < columns; c++) gram[r * columns + c] += r <= c ? sum[r * width + c] : sum[c * width + r];
}

/* The ring holds each influence twice, so that those of the last lags always stand in a row. */
INLINE void influence(const influences *a, double *const *v, const int *present, long slot, int counts, long ny, int both) {
    const long size = a->lags + 1, parts = a->parts;
    loose *const here = (loose *)a->ring + (slot + size) * ny * parts, *const again = here - size * ny * parts;
    const loose *into = (const loose *)a->into;
    for (long o = 0; o < ny; o++)
        for (long j = 0; j < parts; j++) {
            loose sum = {0.0, 0.0, 0.0, 0.0};
            for (long c = 0; present[o] && c < a->columns; c++) sum += v[o][a->places[c]] * into[(o * a->columns + c) * parts + j];
            here[o * parts + j] = again[o * parts + j] = sum;
        }
    for (long j = 0; j < parts && counts; j++) {
        loose sum[ny][ny], now[ny];
        memset(sum, 0, sizeof sum);
        const double *r = a->correlation;
        for (long lag = 0; lag < size; lag++, r += ny * ny) {
            for (long o = 0; o < ny; o++)
                for (long b = 0; b < ny; b++) sum[o][b] += r[o * ny + b] * here[(b - lag * ny) * parts + j];
            for (long o = 0; lag == 0 && both && o < ny; o++) {
                now[o] = sum[o][0];
                for (long b = 1; b < ny; b++) now[o] += sum[o][b];
            }
        }
        for (long o = 0; o < ny; o++) {
            for (long b = 1; b < ny; b++) sum[o][0] += sum[o][b];
            for (long i = 0; i < 4 * parts; i++) {
                const double one = ((const double *)(here + o * parts))[i];
                ((loose *)a->form)[i * parts + j] += one * sum[o][0];
                if (both) ((loose *)a->form)[(4 * parts + i) * parts + j] += one * now[o];
            }
        }
    }
}

static void add_influence(const influences *a, double *const *v, const int *present, long slot, int counts) {
    if (a->forms == 2) influence(a, v, present, slot, counts, a->outputs, 1);
    else if (a->outputs == 1) influence(a, v, present, slot, counts, 1, 0);
    else if (a->outputs == 2) influence(a, v, present, slot, counts, 2, 0);
    else influence(a, v, present, slot, counts, a->outputs, 0);
}

/* The double sum over columns that are kept: samples x outputs x width, of which those that are counted take part. */
EXPORTED void seaopt_sum_twice(const influences *a, const double *columns, const int *counted, long samples, long width) {
    const double *v[a->outputs];
    for (long k = 0; k < samples; k++) {
        for (long o = 0; o < a->outputs; o++) v[o] = columns + (k * a->outputs + o) * width;
        add_influence(a, (double *const *)v, counted + k * a->outputs, k % (a->lags + 1), 1);
    }
}

EXPORTED const column_sums seaopt_sums = {add_products, add_gram, add_influence};
