/* A ball-screw actuator between two fixed links under an exported law, with faults that a bench may have. Its equations
 * are written out here, and share nothing with seaopt:
 *   M q'' = kF i - b q' - f_c tanh(q'/v_s) - k q - s,  F = k q,  s = k2 (q - q2) + c2 (q' - q2'),  m2 q2'' = s
 * with i the command that is in force: of tick j from (j + late) T + delay on. With v_s = 0 the motor sticks: its friction
 * is within f_c while q' is zero (theta method of Moreau and Jean; without a second part). */
#include <math.h>
#ifdef PLAN /* predictive control */
#include "force_mpc.h"
#define LAW force_mpc
#define START(law) force_mpc_reset(law)
#if FORCE_MPC_TERMS
#define STEP(law, r, y, place) (force_mpc_terms(law, r, &(place)), force_mpc_step(law, r, y))
#else
#define STEP(law, r, y, place) force_mpc_step(law, r, y)
#endif
#else
#include "force_law.h"
#define LAW force_law_law
#define START(law) force_law_init(law)
#if defined(PLACED) || defined(READS) /* scheduled, or with a term that reads the motor's position */
#define STEP(law, r, y, place) force_law_step(law, r, y, place)
#else
#define STEP(law, r, y, place) force_law_step(law, r, y)
#endif
#endif

typedef struct {
    double mass, damping, stiffness, per_ampere, coulomb, smoothing; /* M, b, k, kF, f_c, v_s */
    double mass2, stiffness2, damping2;                              /* zero mass2: no such part */
    double delay_s, late, law_gain, reading_sign, drive_sign, sensor_range, current_step, force_step, every, drive_limit;
    double drive_drift; /* A/s, that the drive adds to what is commanded */
} machine;

static void rate(const machine *m, const double *x, double i, double *d)
{
    double s = m->mass2 > 0 ? m->stiffness2 * (x[0] - x[2]) + m->damping2 * (x[1] - x[3]) : 0.0;
    double rub = m->coulomb != 0 ? m->coulomb * tanh(x[1] / m->smoothing) : 0.0; /* tanh is half of a run */
    d[0] = x[1];
    d[1] = (m->per_ampere * i - m->damping * x[1] - rub - m->stiffness * x[0] - s) / m->mass;
    d[2] = x[3];
    d[3] = m->mass2 > 0 ? s / m->mass2 : 0.0;
}

#define THETA 0.55 /* weight of a step's end: at one half what sticks would not come to rest */

static void stick(const machine *m, double *x, double i, double h)
{
    double reach = THETA * h, inertia = m->mass + reach * (m->damping + reach * m->stiffness);
    double push = m->mass * x[1] + reach * (m->per_ampere * i - m->stiffness * x[0]), left = fabs(push) - reach * m->coulomb;
    double mean = left > 0 ? copysign(left, push) / inertia : 0.0;
    x[0] += h * mean;
    x[1] = (mean - (1.0 - THETA) * x[1]) / THETA;
}

static void advance(const machine *m, double *x, double i, double h)
{
    double k1[4], k2[4], k3[4], k4[4], y[4];
    int j;
    rate(m, x, i, k1);
    for (j = 0; j < 4; j++) y[j] = x[j] + 0.5 * h * k1[j];
    rate(m, y, i, k2);
    for (j = 0; j < 4; j++) y[j] = x[j] + 0.5 * h * k2[j];
    rate(m, y, i, k3);
    for (j = 0; j < 4; j++) y[j] = x[j] + h * k3[j];
    rate(m, y, i, k4);
    for (j = 0; j < 4; j++) x[j] += h / 6.0 * (k1[j] + 2.0 * k2[j] + 2.0 * k3[j] + k4[j]);
}

/* Run n ticks of `period` seconds; `force` is what the sensor showed, `current` what the firmware sent, `place` where a
 * schedule's variable was said to be, or where the motor was read. */
void run(const machine *m, long n, long steps, double period, const double *reference, const double *noise,
         double *place, double *force, double *current)
{
    static LAW law;
    double x[4] = {0, 0, 0, 0}, u = 0.0;
    long k, j, every = (long)m->every;
    START(&law);
    for (k = 0; k < n; k++) {
        double reading = m->stiffness * x[0] + noise[k];
        if (m->force_step > 0) reading = m->force_step * floor(reading / m->force_step + 0.5);
        if (reading > m->sensor_range) reading = m->sensor_range;
        if (reading < -m->sensor_range) reading = -m->sensor_range;
#ifdef READS
        place[k] = x[0];
#endif
        if (k % every == 0) {
            u = m->law_gain * STEP(&law, reference[k], m->reading_sign * reading, place[k]);
            if (m->current_step > 0) u = m->current_step * floor(u / m->current_step + 0.5);
        }
        force[k] = reading;
        current[k] = u;
        for (j = 0; j < steps; j++) {
            double t = (double)k + ((double)j + 0.5) / (double)steps - m->late - m->delay_s / period;
            long at = (long)floor(t);
            double given = at >= 0 ? current[at] : 0.0;
            if (given > m->drive_limit) given = m->drive_limit;
            if (given < -m->drive_limit) given = -m->drive_limit;
            given += m->drive_drift * t * period;
            (m->smoothing > 0 ? advance : stick)(m, x, m->drive_sign * given, period / (double)steps);
        }
    }
}
