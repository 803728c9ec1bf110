"""Terms that a running law adds because its plant is known, and whether the loop stays stable with them."""
