"""Plants that the data cannot rule out: draws, batches of figures, severity, the worst case from below."""
