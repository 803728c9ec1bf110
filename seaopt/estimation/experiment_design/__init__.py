"""Design of experiments: excitations that identify the free parameters best within limits."""
