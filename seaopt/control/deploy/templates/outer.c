/* The reference that renders the impedance; the last one where either is no number. */
static real outer_reference(real *state, int *known, real *last, real reference, real position)
{
    const real travelled = OUTER_RATE * position;
    const real before = (*known != 0) ? *state : -travelled;
    const real speed = before + travelled;
    const real asked = (OUTER_STIFFNESS * (reference - position)) - (OUTER_DAMPING * speed);

    if (is_number(reference) && is_number(position)) {
        *state = (OUTER_POLE * speed) - travelled;
        *known = 1;
        *last = asked;
    }
    return *last;
}
