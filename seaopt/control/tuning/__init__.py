"""Tuning: the optimisation problem, starts, convex-concave steps, interior point, and the frontier of bandwidths."""
