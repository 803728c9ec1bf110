"""Faults in the data of a log, and which parameters the data can identify."""
