"""Predictive force control within current limits, and the state estimator (Kalman filter) that it runs on."""
