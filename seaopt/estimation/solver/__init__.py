"""The solver: least squares, first guess and step size."""
