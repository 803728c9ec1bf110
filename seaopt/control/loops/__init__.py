"""Closed loops in frequency: sampled plants, responses, peaks, crossings, margins, and the impedance at a port."""
