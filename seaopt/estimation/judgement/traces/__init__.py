"""What single causes leave in a residual, looked up in it before anything is refitted."""
