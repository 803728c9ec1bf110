"""Impedance at the link: stiffness and damping rendered around the force loop, and what they may be."""
