"""The fit: its covariance, identifiability, findings and summary, and the verb that makes it."""
