"""The solver: least squares, shooting, first guess and step size."""
