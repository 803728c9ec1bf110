/* A series elastic actuator as it is, for benchmarks/truth: it shares nothing with seaopt.

   A motor (coordinate q, speed v) drives a spring through a transmission of ratio R; the spring's other end (coordinate
   phi, speed w) is held, hangs a pendulum, or is held by a stand that gives. Moreau's time stepping: speeds lie half a
   step before positions; elastic forces at the positions, viscous ones at the mean of the speeds before and after
   (explicit ones made inertias 5e-5 low, twice their standard deviation), dry friction set-valued at the end of a step,
   so that what sticks has no speed at all.

   q, v in rad and rad/s of a rotor, or m and m/s of a nut; forces at the motor in N m or N accordingly. */

#include <math.h>

#define PARAMETERS(X) \
    X(inertia)         /* of the motor, and of what a screw carries */ \
    X(carried)         /* the part of it that sits between the two load cells: force_2 = spring + carried * vd */ \
    X(ratio)           /* q over the deflection it makes at the spring */ \
    X(stiffness)       /* of the spring, at its small deflections */ \
    X(spring_damping)  \
    X(viscous)         /* damping of the motor, turning in the positive direction */ \
    X(viscous_back)    /* and in the negative one */ \
    X(coulomb)         /* dry friction at the motor, positive direction */ \
    X(coulomb_back)    \
    X(breakaway)       /* Stribeck: share of dry friction that is added at rest */ \
    X(stribeck_speed)  \
    X(drift)           /* share of all friction that has gone at the end of the log */ \
    X(load_driving)    /* dry friction per unit of transmitted force, where the motor drives the spring */ \
    X(load_driven)     /* and where the spring drives the motor */ \
    X(force_per_ampere) \
    X(droop)           /* share of it that is missing at current_top */ \
    X(current_top)     \
    X(cogging)         /* amplitude of a torque that depends on q */ \
    X(cogging_periods) /* per unit of q */ \
    X(hardening)       /* cubic stiffness */ \
    X(play)            /* half of it, at the spring */ \
    X(hysteresis)      /* stiffness of a second spring, which gives way ... */ \
    X(give_way)        /* ... at this deflection */ \
    X(bristle)         /* stiffness of LuGre's bristles at the motor; 0: Coulomb's law */ \
    X(bristle_damping) \
    X(link_inertia)    /* 0: the link is held */ \
    X(link_damping)    \
    X(link_weight)     /* m g L of a pendulum, or the stiffness of a stand that gives, times ... */ \
    X(link_is_stand)   /* 0: m g L sin(phi); 1: a linear stiffness */ \
    X(delay)           /* s, from the logged command to the current */ \
    X(current_loop)    /* corner of the current loop, Hz; 0: none */ \
    X(sag)             /* share of the force per ampere that is lost per unit of speed */

#define FIELD(name) double name;
#define NAME(name) #name,
typedef struct { PARAMETERS(FIELD) } Parameters;
const char *parameter_names[] = { PARAMETERS(NAME) 0 };

static double clip(double value, double bound) { return fmax(-bound, fmin(bound, value)); }

/* Friction's level at a speed, share by share, before it is applied with the sign of the motion. */
static double friction_level(const Parameters *p, double v, double spring, double speed_of_spring, double cold) {
    double coulomb = v >= 0.0 ? p->coulomb : p->coulomb_back;
    double fall = p->breakaway * exp(-(v / p->stribeck_speed) * (v / p->stribeck_speed));
    double load = spring * speed_of_spring > 0.0 ? p->load_driving : p->load_driven;
    return cold * coulomb * (1.0 + fall) + load * fabs(spring) / p->ratio;
}

/* Simulate n samples, dt apart, of a commanded current; `out` has n rows of q, phi, spring force, force_2. At each
   sample `tick`, where it is not null, may read its row and set the current from then on: what closes a loop. */
void simulate(const double *parameters, const double *current, int n, double dt, int substeps, double *out,
              void (*tick)(int)) {
    const Parameters *p = (const Parameters *)parameters;
    const double h = dt / substeps;
    const double lag = p->current_loop > 0.0 ? 1.0 - exp(-6.283185307179586 * p->current_loop * h) : 1.0;
    double q = 0.0, v = 0.0, phi = 0.0, w = 0.0, slip = 0.0, bristle = 0.0, ampere = 0.0, acceleration = 0.0;
    for (int i = 0; i < n; i++) {
        for (int s = 0; s < substeps; s++) {
            const double deflection = q / p->ratio - phi, rate = v / p->ratio - w;
            const double stretch = deflection - clip(deflection, p->play);
            const double touching = p->play == 0.0 || stretch != 0.0 ? 1.0 : 0.0;
            slip = clip(slip + h * rate, p->give_way);
            const double spring = p->stiffness * stretch + p->hardening * stretch * stretch * stretch
                                + touching * p->spring_damping * rate + p->hysteresis * slip;
            if (s == 0) {
                double *row = out + 4 * i;
                row[0] = q; row[1] = phi; row[2] = spring; row[3] = spring + p->carried * acceleration;
                if (tick) tick(i);
            }
            const double t = i * dt + s * h;
            const int held = (int)floor((t - p->delay) / dt + 1e-9);
            ampere += lag * ((held < 0 ? 0.0 : current[held]) - ampere);
            const double share = ampere / p->current_top;
            const double force = p->force_per_ampere * (1.0 - p->droop * share * share) * (1.0 - p->sag * fabs(v)) * ampere;
            const double cold = 1.0 - p->drift * t / (n * dt);
            const double viscous = cold * (v >= 0.0 ? p->viscous : p->viscous_back);
            const double level = friction_level(p, v, spring, rate, cold);
            const double push = force - spring / p->ratio - p->cogging * sin(6.283185307179586 * p->cogging_periods * q);
            const double loss = 0.5 * h * viscous / p->inertia;
            double next = (1.0 - loss) * v + h * push / p->inertia;
            if (p->bristle > 0.0) {
                const double bend = v - p->bristle * fabs(v) / level * bristle;
                next -= h * (p->bristle * bristle + p->bristle_damping * bend) / p->inertia;
                bristle += h * bend;
            } else {
                next -= clip(next, h * level / p->inertia);
            }
            next /= 1.0 + loss;
            acceleration = (next - v) / h;
            v = next;
            q += h * v;
            if (p->link_inertia > 0.0) {
                const double back = p->link_weight * (p->link_is_stand > 0.0 ? phi : sin(phi));
                const double lost = 0.5 * h * p->link_damping / p->link_inertia;
                w = ((1.0 - lost) * w + h * (spring - back) / p->link_inertia) / (1.0 + lost);
                phi += h * w;
            }
        }
    }
}
