"""What bandwidths can be had, and at what cost: sweeps of the tuner, and a bound that no linear law beats."""
