"""What leaves for the machine: a controller as C99, its gains as a C header and a MATLAB script."""
