"""Frequency responses of logs: H1 estimates, second-order forms, and the survey of a whole log."""

from seaopt.frequency.measured import MeasuredResponse, measure_response
from seaopt.frequency.response import FrequencyResponse, h1
from seaopt.frequency.second_order import DriveEstimate, SecondOrder, Uncertain, second_order
from seaopt.frequency.survey import Pair, Peak, Survey, survey

__all__ = [
    "DriveEstimate", "FrequencyResponse", "MeasuredResponse", "Pair", "Peak", "SecondOrder", "Survey", "Uncertain",
    "h1", "measure_response", "second_order", "survey",
]  # fmt: skip
