/* What passes do to the columns v of a residual whatever made them: Gram matrices, influences. None of it
   depends on a plant but for sizes, which are arguments: sums.c is compiled once, and a pass gets the table below. */
typedef double vec __attribute__((vector_size(32), may_alias)); /* four derivatives at once; no processor needs to know it */
typedef double loose __attribute__((vector_size(32), may_alias, aligned(8))); /* four doubles at any address */

#define EXPORTED __attribute__((visibility("default")))

typedef struct {
    long lags, parts, outputs, columns; /* parts: vectors of estimates */
    long forms;                         /* 2: the double sum and its part t = s; 1: the double sum alone */
    const long *places;                 /* columns: of v, those that have an influence */
    const double *into;                 /* outputs x columns x 4 parts: takes them to their influence on so many estimates */
    const double *correlation;          /* (1 + lags) x outputs x outputs: R(k), R(0) halved */
    double *ring;                       /* 2 (1 + lags) x outputs x 4 parts: influences of the last samples, zero at first */
    double *form;                       /* forms x 4 parts x 4 parts, added to: half the double sum of a(t)' R(t - s) a(s), and
                                           of it what t = s gives */
} influences;

typedef struct {
    /* Upper triangle, in whole vectors, of sum += weight v v' over samples; width x width. */
    void (*add_products)(const double *v, const double *weight, long samples, double *sum, long width);
    /* gram += sum, both triangles; columns x columns. */
    void (*add_gram)(const double *sum, long width, double *gram, long columns);
    /* The influences of a sample, and where it counts its part of the double sum over the samples before. */
    void (*add_influence)(const influences *a, double *const *v, const int *present, long slot, int counts);
} column_sums;
