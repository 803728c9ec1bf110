"""Sampled closed loops simulated: plant, sensors, delay, current limit and law, compiled where there is a compiler."""
