"""Sampled linear systems with named signals, and what they make when they are connected."""
