"""The least-squares problem: experiments, unknowns, residuals, losses, methods and normal equations."""
