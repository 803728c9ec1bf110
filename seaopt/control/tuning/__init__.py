"""Tuning: the optimisation problem, starts, convex-concave steps and interior point."""
