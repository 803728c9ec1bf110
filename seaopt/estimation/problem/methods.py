"""How a plant is compared with a log: the methods of `fit`, as objects with their own options."""

from __future__ import annotations

from seaopt.errors import EstimationError
from seaopt.records import record


@record
class OutputError:
    """Single shooting: the plant is simulated over each segment from its initial state.

    Parameters
    ----------
    max_iterations : int
        Of least squares.
    search : bool
        Look for a start: from the logs' frequency responses, over two decades around the given values, and, where that
        ends badly, by predicting sample by sample with an observer that holds the simulation to the log. The given
        values are kept where they explain the logs better.
    seed : int
        Of that search.

    """

    max_iterations: int = 120
    search: bool = True
    seed: int = 0


@record
class MultipleShooting:
    """Each segment is cut into shots that start from states of their own; the shots are joined while the fit goes on.

    For plants that are unstable, or start far off: a simulation that starts anew every so often cannot run away. At the
    end the shots join to rounding: the result is that of `OutputError` wherever both find it. Where the plant runs away
    in one go the shots keep initial states of their own, which the message says: the intervals are then wider.

    Parameters
    ----------
    segments : int
        Shots a log segment; a segment shorter than the longest may have fewer. Each shot needs a sample more than the
        plant has states, and at least four.
    max_iterations : int
        Of least squares, each time the joints are made stiffer.
    search : bool
        Start from the logs' frequency responses where they explain the logs better than the given values.
    seed : int
        Of that search.

    """

    segments: int = 50
    max_iterations: int = 120
    search: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        if self.segments < 1:
            raise EstimationError(f"MultipleShooting(segments={self.segments}): give at least 1")


@record
class PredictionError:
    """The residual is the error of the prediction one sample ahead, by a steady-state Kalman filter.

    For plants that noise drives, not only sensors: process noise (one strength a state) over the measurement noise is
    estimated with the parameters, and the filter's gain follows from it and from the plant. The measurement noise is
    taken from the outputs' third differences; together they are scaled by the size of the prediction errors. A band is
    refused: the filter is itself a model of the noise.

    Parameters
    ----------
    max_iterations : int
        Of least squares.
    search : bool
        Start from the logs' frequency responses where they explain the logs better than the given values.
    seed : int
        Of that search.

    """

    max_iterations: int = 240
    search: bool = True
    seed: int = 0


Method = OutputError | MultipleShooting | PredictionError
