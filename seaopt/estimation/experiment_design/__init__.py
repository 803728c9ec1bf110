"""What to measure: excitations that tell most of the free parameters within limits."""
