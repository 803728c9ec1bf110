/* What the spring carries where the link is, by Clenshaw's recurrence; constant beyond its range. */
static real weight_at(real position)
{
    const real place = limited(GRAVITY_SCALE * (position - GRAVITY_MIDDLE), (real)1);
    real one = (real)0;
    real two = (real)0;
    int i;

    for (i = (int)(sizeof GRAVITY / sizeof GRAVITY[0]) - 1; i > 0; i--) {
        const real next = ((((real)2 * place) * one) - two) + GRAVITY[i];

        two = one;
        one = next;
    }
    return ((place * one) - two) + GRAVITY[0];
}
