"""Measured frequency responses as plants: discs over frequency, and the loops around them."""
