"""Frequency responses of logs."""

from seaopt.frequency.response import FrequencyResponse, h1

__all__ = ["FrequencyResponse", "h1"]
