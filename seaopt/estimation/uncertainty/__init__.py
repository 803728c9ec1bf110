"""Uncertainty beyond the covariance: profile likelihoods, bootstrap, leverage."""
