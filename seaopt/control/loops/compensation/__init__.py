"""What is added to a law because its plant is known, as it runs, and whether the loop stays stable with it."""
