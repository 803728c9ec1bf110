/* Built with piece.h and what that needs in front: a plant in `steps` steps, and in twice as many with the largest |y|. */
__attribute__((visibility("default")))
void seaopt_hold(double t, double lasting, long steps, const double *x, const double *u, const double *p, double *coarse,
                 double *fine, double *peak) {
    memcpy(coarse, x, NX * sizeof *x);
    memcpy(fine, x, NX * sizeof *x);
    memset(peak, 0, NY * sizeof *peak);
    piece(p, t, lasting, u, steps, coarse, 0);
    piece(p, t, lasting, u, 2 * steps, fine, peak);
}
