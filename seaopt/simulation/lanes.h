/* A number of each of so many stretches of a log, which a thread simulates side by side. */
#define LANES 4
typedef vec lanes;
#define NJ (1 + NQ + (DELAYED > 0) + NX) /* a state and its derivatives */

#ifdef TANH_PLACES
/* seaopt_tanh of each, see tanh.h: what the table says is gathered. */
static inline lanes seaopt_tanh_lanes(lanes x) {
    typedef long long bits __attribute__((vector_size(32), may_alias));
    const lanes end = {TANH_END, TANH_END, TANH_END, TANH_END};
    const bits sign = (bits)x & (bits){1LL << 63, 1LL << 63, 1LL << 63, 1LL << 63};
    lanes size = (lanes)((bits)x ^ sign);
    const bits beyond = (bits)(size > end);
    size = (lanes)((beyond & (bits)end) | (~beyond & (bits)size));
    const lanes shifted = size * TANH_PLACES + 0x1.8p52, r = size - (shifted - 0x1.8p52) / TANH_PLACES, s = r * r;
    const bits place = (bits)shifted & 1023;
    const double *a = tanh_table[place[0]], *b = tanh_table[place[1]], *c = tanh_table[place[2]], *d = tanh_table[place[3]];
#define TANH_TERM(k) ((lanes){a[k], b[k], c[k], d[k]})
    const lanes low = (TANH_TERM(0) + TANH_TERM(1) * r) + s * (TANH_TERM(2) + TANH_TERM(3) * r);
    const lanes high = (TANH_TERM(4) + TANH_TERM(5) * r) + s * (TANH_TERM(6) + TANH_TERM(7) * r);
    return (lanes)((bits)(low + (s * s) * high) | sign);
}
#endif
