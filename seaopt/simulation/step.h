/* What a pass asks of a plant that is not linear: see step.c. */
#define ALL (NJP / 4) /* vectors of a row of Z */
#define DERIVED(wide) (MEASURED && (wide) == ALL) /* whether derivatives are made, but for what shares a vector with x */

typedef double hot_columns[NX][NJP] __attribute__((aligned(32)));

/* The input at the start and the end of a step, and how fast the delay moves it. */
typedef struct { double u0[NU], u1[NU], du0[NU], du1[NU]; } line;

typedef struct plant_steps {
    /* Take a step of the state, without its derivatives and with them; c follows the settings of a pass's model. */
    void (*step[2])(double (*z)[NJP], double t, const line *in, const double *c, double h, double dh);
    /* The same of the outputs; the state is left as it is. */
    void (*output[2])(double (*z)[NJP], double t, const double *u, const double *du, const double *c, double (*y)[NJP]);
    unsigned long room; /* bytes of stack for CasADi's functions */
} plant_steps;
