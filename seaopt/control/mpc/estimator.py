r"""A Kalman filter of an identified plant: forces, spring rate and motion of the links from what is measured.

The plant is linearised at rest and sampled through a zero-order hold; white noise w and random walk d of its inputs
(see `noise`) are states beside its own, so that :math:`z = [x, w, d]` and

.. math::
    z_{k+1} = A z_k + B u_{k-n} + B' u_{k-n-1} + v_k, \quad y_k = C z_k + D \bar u_k + e_k, \qquad
    \hat z_{k|k} = \hat z_k + L \epsilon_k, \quad \hat z_{k+1} = A \hat z_{k|k} + B u_{k-n} + B' u_{k-n-1}

with n whole samples of delay, B' what the command before adds where a part of a sample is left besides (the drive's
delay, a condition of the parameters: `seaopt.control.loops.sampled_plant`), :math:`\bar u_k` the input in force as y is
read, innovations :math:`\epsilon_k = y_k - C \hat z_k - D \bar u_k` and the steady-state gain
:math:`L = P C^T S^{-1}`, :math:`S = C P C^T + R`, where P solves the discrete algebraic Riccati equation. If plant and
noise are right the innovations are white with covariance S: `run` tests that on a log (Ljung and Box, Biometrika 65,
1978).

Every matrix is public: a step is two products of small matrices, as easily written in C.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.control.loops.sampled_plant import find_delay, read_conditions, whole_samples
from seaopt.control.mpc.noise import NoiseModel
from seaopt.errors import ControlError, suggestion
from seaopt.estimation import Fit
from seaopt.estimation.problem.correlation import autocorrelation, ljung_box
from seaopt.formatting import format_count, format_table, html_text
from seaopt.logs import Log
from seaopt.parameters import ParameterSet
from seaopt.plants import CompletedParameters, Plant, state_space
from seaopt.plants.friction import find_dry_friction
from seaopt.plants.plant import deflection_row
from seaopt.records import record
from seaopt.signals import MatrixMN, VectorM
from seaopt.simulation.discretisation import expm_with_derivatives
from seaopt.simulation.simulate import input_samples

State = Float[np.ndarray, " n"]
Matrix = Float[np.ndarray, "n n"]
Outputs = Float[np.ndarray, " ny"]
Inputs = Float[np.ndarray, " nu"]
InputRows = Float[np.ndarray, "m nu"]
WHITENESS_LAGS = 20
RATE_TOLERANCE = 1e-6  # of the log's period against the estimator's


@record(eq=False)
class EstimatorState:
    """The filter's state after a sample.

    Parameters
    ----------
    predicted : array, shape (n,)
        z of the next sample, before it is measured.
    corrected : array, shape (n,)
        z of this sample, with its measurement.
    applied : array, shape (nu,)
        What was in force at the plant's inputs as this sample was read.
    past : array, shape (delay_samples + 1, nu)
        The inputs before this sample's, oldest first.
    innovation : array, shape (ny,)
        Measured less predicted, in the outputs' units; NaN where nothing was measured.
    """

    predicted: State
    corrected: State
    applied: Inputs
    past: Float[np.ndarray, "delay nu"]
    innovation: Outputs


@record(eq=False)
class EstimatorRun:
    """A filter's pass over a log.

    Parameters
    ----------
    time : array, shape (m,)
        Seconds.
    values : mapping of name to array, shape (m,)
        Estimates with each sample's measurement, the names being those of `Estimator.names`.
    std : mapping of name to float
        Their standard deviations, once the filter has settled.
    innovations : mapping of output to array, shape (m,)
    whiteness_p : mapping of output to float
        Ljung-Box p-values over 20 lags, the settling left out; small means coloured.
    settled : int
        First sample that the test counts.
    """

    time: VectorM
    values: Mapping[str, VectorM]
    std: Mapping[str, float]
    innovations: Mapping[str, VectorM]
    whiteness_p: Mapping[str, float]
    settled: int

    def __getitem__(self, name: str) -> VectorM:
        """Return one estimate over the log."""
        if name not in self.values:
            raise ControlError(f'no estimate "{name}"; {suggestion(name, self.values)}')
        return self.values[name]


@record(eq=False)
class Estimator:
    """A steady-state Kalman filter; `estimator` makes one.

    Parameters
    ----------
    plant : Plant
    outputs : tuple of str
        Measured, in the order of y.
    sample_time_s : float
    delay_samples : int
        Whole samples from an input to the plant, those of the drive's delay among them.
    noise : NoiseModel
    A, B, C, D : arrays
        The sampled plant with its disturbances, shapes (n, n), (n, nu), (ny, n), (ny, nu).
    late : array, shape (n, nu)
        B', which the input before has in a sample; zero where the delay is of whole samples.
    gain : array, shape (n, ny)
        L, from innovation to correction.
    covariance : array, shape (n, n)
        Of the error of the corrected z.
    innovation_covariance : array, shape (ny, ny)
        S.
    offset : array, shape (ny,)
        Of the sensors.
    names, units : tuple of str
        What is estimated: every output and state of the plant, the deflection and rate of its spring, and each
        disturbance, as ``I_drift``.
    G, H : arrays, shapes (nz, n), (nz, nu)
        The estimates are G z + H u.
    """

    plant: Plant
    outputs: tuple[str, ...]
    sample_time_s: float
    delay_samples: int
    noise: NoiseModel
    A: Matrix
    B: Float[np.ndarray, "n nu"]
    C: Float[np.ndarray, "ny n"]
    D: Float[np.ndarray, "ny nu"]
    late: Float[np.ndarray, "n nu"]
    gain: Float[np.ndarray, "n ny"]
    covariance: Matrix
    innovation_covariance: Float[np.ndarray, "ny ny"]
    offset: Outputs
    names: tuple[str, ...]
    units: tuple[str, ...]
    G: Float[np.ndarray, "nz n"]
    H: Float[np.ndarray, "nz nu"]

    @property
    def std(self) -> dict[str, float]:
        """Standard deviation of each estimate once the filter has settled, with the parameters taken as exact."""
        variance = np.einsum("ij,jk,ik->i", self.G, self.covariance, self.G)
        return dict(zip(self.names, np.sqrt(np.maximum(variance, 0.0)).tolist(), strict=True))

    @property
    def start(self) -> EstimatorState:
        """The plant at rest at zero, with no delayed input."""
        n, nu = self.B.shape
        return EstimatorState(
            predicted=np.zeros(n),
            corrected=np.zeros(n),
            applied=np.zeros(nu),
            past=np.zeros((self.delay_samples + 1, nu)),
            innovation=np.full(len(self.outputs), np.nan),
        )

    def list_acting(self, past: InputRows) -> Inputs:
        """Return the input in force as a sample is read, of those before it and its own."""
        return past[0 if np.any(self.late) else 1]

    def advance(self, z: State, older: Any, newer: Any) -> State:
        """Return z a sample later, in which one input stops acting and the next one begins to."""
        return self.A @ z + self.B @ newer + self.late @ older

    def correct(self, state: EstimatorState, y: Outputs, applied: Inputs) -> tuple[State, Outputs]:
        """Return z with this sample's measurement, and the innovation; one that is not finite corrects nothing."""
        innovation = y - self.offset - self.C @ state.predicted - self.D @ applied
        return state.predicted + self.gain @ np.where(np.isfinite(innovation), innovation, 0.0), innovation

    def step(self, state: EstimatorState, u: Inputs, y: Outputs) -> EstimatorState:
        """Process one sample: the inputs u commanded at it, and the outputs y measured at it (NaN: not measured)."""
        line = np.vstack([state.past, u])
        return self.go_on(line, *self.correct(state, y, self.list_acting(line)))

    def go_on(self, line: InputRows, corrected: State, innovation: Outputs) -> EstimatorState:
        """Return the state after a sample: the inputs before it and its own, and what `correct` gave."""
        return EstimatorState(
            predicted=self.advance(corrected, line[0], line[1]),
            corrected=corrected,
            applied=self.list_acting(line),
            past=line[1:],
            innovation=innovation,
        )

    def values(self, state: EstimatorState) -> dict[str, float]:
        """Return the estimates of the last sample by name, in `units`."""
        estimates = self.G @ state.corrected + self.H @ state.applied
        return dict(zip(self.names, estimates.tolist(), strict=True))

    def run(self, log: Log) -> EstimatorRun:
        """Filter a log from rest; channels carry the plant's names. Raises ControlError: the log's rate is not the
        filter's, or it has gaps or missing samples. Raises LogError: an input or a measured output is not in the log.
        """
        u, y = self._samples(log)
        settled = min(self._count_settling(), len(log) // 2)
        queue = np.vstack([np.zeros((self.delay_samples + 1, u.shape[1])), u])
        older, delayed = queue[: len(log)], queue[1 : len(log) + 1]
        acting = older if np.any(self.late) else delayed
        closed = self.A @ (np.eye(len(self.A)) - self.gain @ self.C)
        read = y - self.offset - acting @ self.D.T
        drive = delayed @ self.B.T + older @ self.late.T + read @ (self.A @ self.gain).T
        predicted = np.vstack([np.zeros(len(closed)), run_recursion(closed, drive)[:-1]])
        innovations = read - predicted @ self.C.T
        estimates = (predicted + innovations @ self.gain.T) @ self.G.T + acting @ self.H.T
        return EstimatorRun(
            time=log.time,
            values=dict(zip(self.names, estimates.T.copy(), strict=True)),
            std=self.std,
            innovations=dict(zip(self.outputs, innovations.T.copy(), strict=True)),
            whiteness_p={
                name: ljung_box(autocorrelation(channel, WHITENESS_LAGS)[1:], channel.size)
                for name, channel in zip(self.outputs, innovations[settled:].T, strict=True)
            },
            settled=settled,
        )

    def _count_settling(self) -> int:
        """Samples until an error at the start has shrunk a thousandfold."""
        radius = float(np.max(np.abs(np.linalg.eigvals(self.A @ (np.eye(len(self.A)) - self.gain @ self.C)))))
        return int(np.ceil(np.log(1e-3) / np.log(min(max(radius, 1e-3), 1.0 - 1e-12))))

    def _samples(self, log: Log) -> tuple[InputRows, Float[np.ndarray, "m ny"]]:
        if abs(log.period / self.sample_time_s - 1.0) > RATE_TOLERANCE:
            raise ControlError(
                f"{log.source} is sampled every {log.period:.6g} s, the estimator every {self.sample_time_s:.6g} s; "
                "make one with the log's sample_time_s"
            )
        if len(log.segments) > 1:
            raise ControlError(f"{log.source} has gaps; run each segment by itself (log.between)")
        y = np.column_stack([log[name] for name in self.outputs])
        for name, channel in zip(self.outputs, y.T, strict=True):
            if not np.all(np.isfinite(channel)):
                row = int(np.argmin(np.isfinite(channel)))
                raise ControlError(
                    f"{log.source}: output {name} is missing at t = {log.time[row]:g} s; cut there (log.between), or "
                    "take it in sample by sample with `step`"
                )
        return np.column_stack(input_samples(self.plant, log)), y

    def __repr__(self) -> str:
        rows = [(name, f"± {std:.3g} {unit}") for (name, std), unit in zip(self.std.items(), self.units, strict=True)]
        delay = f", delay of {format_count(self.delay_samples, 'sample')}" if self.delay_samples else ""
        head = f"Estimator of {self.plant.name} from {', '.join(self.outputs)} at {1 / self.sample_time_s:g} Hz{delay}"
        return "\n  ".join([head, *format_table(rows)])

    _repr_html_ = html_text


def estimator(
    plant: Plant,
    params: ParameterSet | Fit,
    noise: NoiseModel,
    *,
    outputs: tuple[str, ...] = ("F1",),
    sample_time_s: float = 1e-3,
    delay_samples: int = 0,
) -> Estimator:
    """Return the steady-state Kalman filter of a plant.

    Parameters
    ----------
    plant : Plant
        Linearised at rest at zero; its dry friction must be zero, for dry friction has no linearisation there.
    params : ParameterSet or Fit
        Its parameters; `drive_delay_s` among them is the drive's delay, exact in fractions of a sample.
    noise : NoiseModel
        Of the measured outputs and of the inputs.
    outputs : tuple of str
        What is measured.
    sample_time_s : float
        Seconds.
    delay_samples : int
        Whole samples from a commanded input to the drive.

    Raises
    ------
    ControlError
        A name is unknown, a number is out of range, only the sensors are noisy, or a motion that does not die
        out by itself is measured by no sensor.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.control import NoiseModel, estimator
    >>> noise = NoiseModel(sensor_std={"F1": 2.0}, input_noise={"I": 0.01})
    >>> kalman = estimator(so.plants.high_impedance(), so.plants.thor(), noise, sample_time_s=1 / 400)
    >>> kalman.std["F1"] < 2.0, kalman.units[kalman.names.index("spring_rate")]
    (True, 'm/s')
    """
    parameters = params.parameters if isinstance(params, Fit) else params
    values = plant.complete(parameters)
    chosen = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    _check(plant, values, noise, chosen, sample_time_s, delay_samples)
    a, b, c, d = state_space(plant, values)
    nx, nu = b.shape
    block = np.zeros((nx + nu, nx + nu))
    block[:nx, :nx], block[:nx, nx:] = a, b
    waits, rest_s = whole_samples(float(find_delay(plant, read_conditions(plant, parameters))), sample_time_s)
    whole, part = (
        expm_with_derivatives(block * seconds, np.zeros((0, nx + nu, nx + nu)))[0]
        for seconds in (sample_time_s, sample_time_s - rest_s)
    )
    inputs = list(plant.inputs)
    kinds = (noise.input_noise, 0.0, 1.0 / sample_time_s), (noise.input_drift, 1.0, sample_time_s)
    disturbances = [  # input, pole (of white noise 0, of a walk 1), variance over one sample
        (inputs.index(name), pole, density**2 * per)
        for levels, pole, per in kinds
        for name, density in levels.items()
        if density > 0.0
    ]
    columns, poles, variances = (list(each) for each in zip(*disturbances, strict=True))
    below = np.zeros((len(disturbances), nx + nu))
    A = np.block([[whole[:nx, :nx], whole[:nx, nx:][:, columns]], [below[:, :nx], np.diag(poles)]])
    total, B = (np.vstack([each[:nx, nx:], below[:, nx:]]) for each in (whole, part))  # B acts once it has arrived
    Q = np.diag([0.0] * nx + variances)
    rows = [list(plant.outputs).index(name) for name in chosen]
    C, D = np.hstack([c, d[:, columns]])[rows], d[rows]
    R = np.diag([noise.sensor_std[name] ** 2 for name in chosen])
    P = _solve_riccati(plant, chosen, A, C, Q, R)
    S = C @ P @ C.T + R
    gain = np.linalg.solve(S, C @ P).T
    keep = np.eye(len(A)) - gain @ C
    names, units, G, H = _list_estimates(plant, values, (a, b, c, d), disturbances)
    return Estimator(
        plant=plant,
        outputs=chosen,
        sample_time_s=sample_time_s,
        delay_samples=delay_samples + waits,
        noise=noise,
        A=A,
        B=B,
        C=C,
        D=D,
        late=total - B,
        gain=gain,
        covariance=keep @ P @ keep.T + gain @ R @ gain.T,
        innovation_covariance=S,
        offset=np.array([noise.offset.get(name, 0.0) for name in chosen]),
        names=names,
        units=units,
        G=G,
        H=H,
    )


def _check(
    plant: Plant,
    params: CompletedParameters,
    noise: NoiseModel,
    outputs: tuple[str, ...],
    sample_time_s: float,
    delay: int,
) -> None:
    for name in outputs:
        if name not in plant.outputs:
            raise ControlError(f'output "{name}" is not one of {plant.name}; {suggestion(name, plant.outputs)}')
    if not outputs or len(set(outputs)) < len(outputs):
        raise ControlError(f"outputs = {outputs}; name each measured output once")
    if not 0.0 < sample_time_s < np.inf:
        raise ControlError(f"sample_time_s = {sample_time_s!r} is not a time; give seconds above zero")
    if isinstance(delay, bool) or not isinstance(delay, int) or delay < 0:
        raise ControlError(f"delay_samples = {delay!r} is not a whole number of samples; give 0, 1, ...")
    for name, effort in find_dry_friction(plant, params).items():
        raise ControlError(
            f"friction {name} takes an effort of {effort:g}: dry friction at rest has no linear model; set it to zero "
            "and let input_noise or input_drift stand for it"
        )
    if not isinstance(noise, NoiseModel):
        raise ControlError(f"noise is a {type(noise).__name__}; give a NoiseModel")
    noise.check(plant, outputs)
    if not any([*noise.input_noise.values(), *noise.input_drift.values()]):
        raise ControlError("noise: nothing but the sensors is noisy; give input_noise or input_drift above zero")


def _solve_riccati(
    plant: Plant,
    outputs: tuple[str, ...],
    A: Matrix,
    C: Float[np.ndarray, "ny n"],
    Q: Matrix,
    R: Float[np.ndarray, "ny ny"],
) -> Matrix:
    """Return the covariance of the prediction in steady state."""
    from scipy.linalg import solve_discrete_are  # deferred: scipy is slow to load

    poles, modes = np.linalg.eig(A)
    read = C / np.sqrt(np.diag(R))[:, None]
    seen, size = np.linalg.norm(read @ modes, axis=0), np.linalg.norm(np.abs(read) @ np.abs(modes), axis=0) + 1e-300
    for k in np.flatnonzero((np.abs(poles) > 1.0 - 1e-9) & (seen <= 1e-9 * size)):
        states = [*plant.states, *["a disturbance"] * len(A)]
        name = states[int(np.argmax(np.abs(modes[:, k])))]
        raise ControlError(
            f"{name} of {plant.name} does not die out and {', '.join(outputs)} cannot see it; measure another output"
        )
    try:
        return np.asarray(solve_discrete_are(A.T, C.T, Q, R))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ControlError(
            f"no steady filter of {plant.name} from {', '.join(outputs)} ({error}); "
            "measure more outputs, or give noise to every input"
        ) from error


def run_recursion(a: Matrix, v: MatrixMN) -> MatrixMN:
    """Return x with x[k] = a x[k-1] + v[k], x[-1] = 0, by doubling the reach until a's power has died out."""
    x, power, reach = v, a, 1
    while reach < len(v) and np.max(np.abs(power)) > 1e-18:
        x = np.vstack([x[:reach], x[reach:] + x[:-reach] @ power.T])
        power, reach = power @ power, 2 * reach
    return x


def _list_estimates(
    plant: Plant,
    params: CompletedParameters,
    matrices: tuple[Any, Any, Any, Any],
    disturbances: Sequence[tuple[int, float, float]],
) -> tuple[tuple[str, ...], tuple[str, ...], Float[np.ndarray, "nz n"], Float[np.ndarray, "nz nu"]]:
    """Return names, units, G and H of everything that is estimated."""
    a, b, c, d = matrices
    nx, nu = b.shape
    none = np.zeros(nu)
    rows = {name: (c[i], d[i], unit) for i, (name, unit) in enumerate(plant.outputs.items())}
    for row, (name, unit) in zip(np.eye(nx), plant.states.items(), strict=True):
        rows.setdefault(name, (row, none, unit))
    if plant.spring is not None:
        row, unit = deflection_row(plant, params), plant.spring.unit
        rows |= {"spring_deflection": (row, none, unit), "spring_rate": (row @ a, row @ b, f"{unit}/s")}
    columns = [column for column, _, _ in disturbances]
    wide = {name: (np.concatenate([x, u[columns]]), u, unit) for name, (x, u, unit) in rows.items()}
    for row, (column, pole, _) in zip(np.eye(nx + len(columns))[nx:], disturbances, strict=True):
        if pole == 1.0:
            name, unit = list(plant.inputs.items())[column]
            wide[f"{name}_drift"] = (row, none, unit)
    G, H, units = zip(*wide.values(), strict=True)
    return tuple(wide), units, np.array(G), np.array(H)
