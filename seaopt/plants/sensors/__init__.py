"""Sensors that compute their reading: torque from deflection, speed by difference."""
