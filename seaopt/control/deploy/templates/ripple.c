/* Sine and cosine of a quarter of the angle, doubled twice; each harmonic is the one before, turned by the first. */
static real ripple_at(real position)
{
    const real turns = limited(REVOLUTIONS * position, MOST_TURNS);
    real whole = (real)(long)(turns + (real)0.5);
    real angle;
    real squared;
    real sine = (real)0;
    real cosine = (real)0;
    real real_part = (real)1;
    real imaginary = (real)0;
    real sum = (real)0;
    int i;

    if (whole > (turns + (real)0.5)) {
        whole -= (real)1;
    }
    angle = QUARTER * (turns - whole);
    squared = angle * angle;
    for (i = 0; i < (int)(sizeof SINE / sizeof SINE[0]); i++) {
        sine = (sine * squared) + SINE[i];
    }
    for (i = 0; i < (int)(sizeof COSINE / sizeof COSINE[0]); i++) {
        cosine = (cosine * squared) + COSINE[i];
    }
    sine *= angle;
    for (i = 0; i < 2; i++) {
        const real doubled = ((real)2 * sine) * cosine;

        cosine = (real)1 - (((real)2 * sine) * sine);
        sine = doubled;
    }
    for (i = 0; i < (int)(sizeof RIPPLE_COS / sizeof RIPPLE_COS[0]); i++) {
        const real turned = (real_part * cosine) - (imaginary * sine);

        imaginary = (real_part * sine) + (imaginary * cosine);
        real_part = turned;
        sum += (RIPPLE_COS[i] * real_part) + (RIPPLE_SIN[i] * imaginary);
    }
    return sum;
}
