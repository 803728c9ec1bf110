"""The motor as it warms up, and the guard that keeps it cool."""
