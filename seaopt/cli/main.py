"""Commands, options, exit codes: 0 all requirements met, 1 one is not, 2 bad input, 70 a defect, 130 Ctrl-C."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperGroup

from seaopt.cli.terminal import Amount, prepare_streams
from seaopt.errors import ControlError, FileError, InternalError, LogError, SeaoptError, UnitError
from seaopt.formatting import printable

INTERRUPTED = 130  # exit codes, as a shell's
PIPE_CLOSED = 141
DEFECT = 70  # exit code: EX_SOFTWARE of sysexits.h
# A command, a line of TOML, an option or the word that was meant stands in it.
TYPED = re.compile(r"\bseaopt [a-z]|\w = |(?<!\w)--?[a-z]|did you mean \"")


ORDER = (  # of the commands in the help: as they are used
    "demo", "new", "inspect", "run", "fit", "tune", "certify", "report", "export", "validate", "fleet", "simulate",
    "frf", "schema",
)  # fmt: skip


class _Commands(TyperGroup):
    """The commands, in the order of their use; Ctrl-C is one line on stderr and exit code 130."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Print the help where nothing is asked for, which is no error."""
        if not args and not ctx.resilient_parsing:
            typer.echo(ctx.get_help())
            ctx.exit(0)
        return super().parse_args(ctx, args)

    def list_commands(self, ctx: Any) -> list[str]:
        names = super().list_commands(ctx)
        return sorted(names, key=lambda name: ORDER.index(name) if name in ORDER else len(ORDER))

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except BrokenPipeError:  # Typer would leave with 1, which says that something is not met
            _leave_pipe()
        except KeyboardInterrupt as stop:
            sys.stderr.write("\nseaopt: interrupted" + (f"; {stop}" if stop.args else "") + "\n")
        raise SystemExit(INTERRUPTED)


app = typer.Typer(
    name="seaopt",
    cls=_Commands,
    help="Series elastic actuators: from raw bench logs to a certified force controller.",
    pretty_exceptions_enable=False,
)

ProblemFile = Annotated[Path, typer.Argument(metavar="PROBLEM", help="Problem file (TOML).", show_default=False)]
Folder = Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the results.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result's JSON and nothing else.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print the verdict only, or the files written.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Print all figures, notes and failures.")]

Workers = Annotated[
    int | None,
    typer.Option(
        "--workers", metavar="N", min=1, help="Processes for certificates and sweeps; none but this, if left out."
    ),
]


def _version(wanted: bool) -> bool:
    if wanted:
        from seaopt import __version__

        typer.echo(f"seaopt {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def _add_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, metavar=" ", help="Print the version.")
    ] = False,
) -> None:
    """Series elastic actuators: from raw bench logs to a certified force controller.

    Begin with `seaopt demo`, or on a log of your own with `seaopt new LOG`.
    """


def _choose_amount(quiet: bool, verbose: bool) -> Amount:
    return "quiet" if quiet else "verbose" if verbose else "usual"


def _finish(session: Any, json: bool, stages: list[str], quiet: bool = False, verbose: bool = False) -> None:
    """Print what was asked for on stdout and leave with the exit code of the verdict."""
    session.show(json, stages, _choose_amount(quiet, verbose))
    if not session.met(stages):
        raise typer.Exit(1)


@app.command()
def demo(output: Folder = Path("out/demo"), json: Json = False, quiet: Quiet = False, verbose: Verbose = False) -> None:
    """Run the THOR problem on virtual logs: fit, tune, certify, report."""
    from seaopt.problem import demo_path

    run(demo_path(), output, json, quiet, verbose)


@app.command()
def run(
    problem: ProblemFile,
    output: Folder = Path("out"),
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    workers: Workers = None,
) -> None:
    """Fit, tune, certify and report."""
    from seaopt.cli.session import Session

    session = Session(problem, output, workers=workers)
    stages = session.plan_stages()
    done = list[str]()
    try:
        for stage in stages:
            if stage == "tune" and not session.can_design():
                stages = ["fit", "report"]
                session.run("report")
                break
            session.run(stage)
            done.append(stage)
    except Exception:  # minutes of work have a verdict, whatever becomes of the next stage
        if done and not json:
            session.show(json, done, _choose_amount(quiet, verbose))
        raise
    for what in session.explain_left_out(stages):
        session.say(f"left out: {what}")
    for what in session.name_leftovers(stages):
        session.say(f"note: {what}")
    _finish(session, json, stages, quiet, verbose)


@app.command()
def simulate(
    problem: ProblemFile,
    output: Folder = Path("out"),
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Simulate every experiment with the file's values; write one CSV each, and the logs of virtual ones."""
    from seaopt.cli.session import Session

    session = Session(problem, output, design=False)
    session.run("simulate")
    _finish(session, json, ["simulate"], quiet, verbose)


@app.command()
def frf(
    problem: ProblemFile,
    output: Folder = Path("out"),
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    stretch: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", min=0.0, help="Length of a stretch, one over the resolution in Hz."),
    ] = None,
) -> None:
    """Estimate frequency responses (H1, coherence, second-order fit); write frf.json and figure."""
    from seaopt.cli.session import Session

    session = Session(problem, output, stretch_s=stretch, design=False)
    session.run("frf")
    _finish(session, json, ["frf"], quiet, verbose)


@app.command()
def inspect(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A raw log, of any format.", show_default=False)],
    time: Annotated[str | None, typer.Option(metavar="COLUMN", help="The clock's column.")] = None,
    channel: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=COLUMN", help="A channel; every column of numbers if left out. Repeatable."),
    ] = None,
    unit: Annotated[
        list[str] | None, typer.Option(metavar="NAME=UNIT", help="Unit of a channel, or of time. Repeatable.")
    ] = None,
    driven_by: Annotated[
        list[str] | None,
        typer.Option("--input", metavar="NAME", help="A channel that drives the others. Repeatable."),
    ] = None,
    align: Annotated[
        str | None, typer.Option(metavar="RULE", help="How channels of other clocks come to this one: hold or linear.")
    ] = None,
    counter: Annotated[
        str | None,
        typer.Option(metavar="COLUMN=SAMPLES", help="A column that counts samples, and how many a count stands for."),
    ] = None,
    rate_hz: Annotated[
        float | None, typer.Option("--rate-hz", metavar="HZ", help="Sample rate of a log without a clock.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="Write quality.json and the figure there.")
    ] = None,
    listed: Annotated[bool, typer.Option("--list", help="Only list the columns, their units and clocks.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Look for every fault in a log, and say what it excites."""
    from seaopt.cli.inspect import inspect_log

    if listed:
        from seaopt.logs import contents

        typer.echo(printable(repr(contents(log))))
        return
    if not inspect_log(
        log,
        time=time,
        channels=channel or (),
        inputs=driven_by or (),
        units=unit or (),
        align=align,
        counter=counter,
        rate_hz=rate_hz,
        folder=output,
        json=json,
        amount=_choose_amount(quiet, verbose),
    ):
        raise typer.Exit(1)


@app.command()
def new(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG", help="Raw logs, of any format.", show_default=False)],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FILE", help="The problem file; beside the log, if left out."),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Ask nothing; take the best guesses and mark them.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
    json: Json = False,
) -> None:
    """Write a problem file for logs: look at their columns, and ask what they do not say."""
    from seaopt.cli.new import write_problem

    write_problem(logs, output, yes=yes, force=force, json=json)


@app.command()
def tune(
    problem: ProblemFile,
    output: Folder = Path("out"),
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    sweep: Annotated[
        str | None,
        typer.Option(
            metavar="LOW:HIGH:STEP", help="Tune at each bandwidth (Hz) instead; write frontier.json and figure."
        ),
    ] = None,
    free_law: Annotated[
        bool, typer.Option("--free-law", help="With --sweep: also the best that any linear law could do.")
    ] = False,
    workers: Workers = None,
) -> None:
    """Tune the controller with the fit in DIR; write controller.json."""
    from seaopt.cli.frontier import parse_bandwidths
    from seaopt.cli.session import Session

    stage = "tune" if sweep is None else "sweep"
    if free_law and sweep is None:
        raise ControlError("--free-law: is of a sweep; give --sweep LOW:HIGH:STEP too")
    bandwidths = () if sweep is None else parse_bandwidths(sweep)
    session = Session(problem, output, bandwidths_hz=bandwidths, free_law=free_law, workers=workers)
    session.run(stage)
    _finish(session, json, [stage], quiet, verbose)


@app.command()
def validate(
    problem: ProblemFile,
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A log that was not fitted.", show_default=False)],
    output: Folder = Path("out"),
    like: Annotated[
        str | None,
        typer.Option(metavar="EXPERIMENT", help="Whose columns and sensors it has; the first's, if left out."),
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Score the fit in DIR on another log, from its own initial state and offsets."""
    from seaopt.cli.session import Session

    Session(problem, output, design=False).validate(log, like, json, _choose_amount(quiet, verbose))


def _make_command(name: str, text: str) -> Callable[..., None]:
    def command(
        problem: ProblemFile,
        output: Folder = Path("out"),
        json: Json = False,
        quiet: Quiet = False,
        verbose: Verbose = False,
    ) -> None:
        from seaopt.cli.session import Session

        session = Session(problem, output, design=name != "fit")
        session.run(name)
        _finish(session, json, [name], quiet, verbose)

    command.__doc__ = text
    return command


for _stage_name, _help in (
    ("fit", "Fit the parameters to the logs; write fit.json."),
    ("report", "Write report.html and figures from the results in DIR."),
):
    app.command(_stage_name)(_make_command(_stage_name, _help))


@app.command()
def certify(
    problem: ProblemFile,
    output: Folder = Path("out"),
    controller: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A law of your own instead (JSON or TOML); it becomes controller.json."),
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    workers: Workers = None,
) -> None:
    """Certify the controller in DIR; write robustness.json."""
    from seaopt.cli.session import Session

    session = Session(problem, output, workers=workers)
    if controller is not None:
        session.take_law(controller)
    session.run("certify")
    _finish(session, json, ["certify"], quiet, verbose)


@app.command()
def export(
    results: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with controller.json.", show_default=False)],
    c: Annotated[Path, typer.Option("--c", "-o", metavar="OUT", help="Folder for the C code and the gains.")],
    precision: Annotated[str, typer.Option(metavar="double|float", help="Of the C code.")] = "double",
    name: Annotated[str, typer.Option(help="Begins every name in C.")] = "force_law",
    current_limit: Annotated[
        float | None, typer.Option(metavar="AMPERES", help="In place of the specification's current_limit_A.")
    ] = None,
    command_limit: Annotated[
        float | None, typer.Option(metavar="VALUE", help="The same of another command, in its unit: V, or a duty.")
    ] = None,
    tracking_time: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="Of the anti-windup, in place of the default.")
    ] = None,
    derate: Annotated[
        bool, typer.Option("--derate", help='Lower the limit as the winding warms up, by the part "thermal".')
    ] = False,
    derate_margin: Annotated[float | None, typer.Option(metavar="KELVIN", help="The same, so far below T_max.")] = None,
    gate: Annotated[
        str | None,
        typer.Option(metavar="LOW:HIGH", help="Believe readings within this range, that move no further than:"),
    ] = None,
    gate_max_step: Annotated[
        float | None, typer.Option(metavar="VALUE", help="So far in a sample; that of [controller.gate] if left out.")
    ] = None,
    gate_max_held: Annotated[
        int | None, typer.Option(metavar="N", help="Bridge so many others in a row, 5 if left out; then stop.")
    ] = None,
    gate_ramp: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="In which the command goes to zero then; 0.1 if left out.")
    ] = None,
    no_gate: Annotated[
        bool, typer.Option("--no-gate", help="Leave out the gate of [controller.gate], and believe all readings.")
    ] = False,
    allow_infeasible: Annotated[
        bool, typer.Option("--allow-infeasible", help="Write a controller that misses its limits too; exit with 1.")
    ] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Write the controller in DIR as C99, with its gains as a C header and a MATLAB script."""
    from seaopt.cli.export import GateOptions, export_controller

    options = {
        "current_limit_A": current_limit, "command_limit": command_limit, "tracking_time_s": tracking_time,
        "derate": derate, "allow_infeasible": allow_infeasible,
    }  # fmt: skip
    if not export_controller(
        results,
        c,
        json,
        derate_margin,
        amount=_choose_amount(quiet, verbose),
        gate=GateOptions(
            range_N=gate, max_step_N=gate_max_step, max_held=gate_max_held, ramp_s=gate_ramp, leave_out=no_gate
        ),
        precision=precision,
        name=name,
        **options,
    ):
        raise typer.Exit(1)


@app.command()
def fleet(
    problem: ProblemFile,
    logs: Annotated[
        list[str] | None,
        typer.Argument(metavar="LOGS", help="Files, 'patterns/**/*.csv', addresses (s3://...).", show_default=False),
    ] = None,
    output: Folder = Path("out"),
    manifest: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A CSV file with the logs in its column log; the others say whose they are."),
    ] = None,
    identity: Annotated[
        str | None,
        typer.Option(metavar="PATTERN", help="How paths end: '{robot}/{actuator}_{run}.csv' makes three columns."),
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Of a Dask cluster: tcp://HOST:PORT or tls://HOST:PORT.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Processes here; as many as cores, if left out.")
    ] = None,
    like: Annotated[
        str | None,
        typer.Option(metavar="EXPERIMENT", help="Which says how logs are read; the first with one, if left out."),
    ] = None,
    time_limit: Annotated[float, typer.Option(metavar="SECONDS", min=0.1, help="For one log.")] = 600.0,
    time: Annotated[
        str | None,
        typer.Option(
            metavar="COLUMNS", help="Of the identity, that say when; those called date, run, ... if left out."
        ),
    ] = None,
    actuator: Annotated[
        str | None,
        typer.Option(metavar="COLUMNS", help="Of the identity, that name an actuator; the others, if left out."),
    ] = None,
    since: Annotated[
        str | None, typer.Option(metavar="TIME", help="Earlier logs are left out of drift, as after a repair.")
    ] = None,
    false_alarms: Annotated[
        float, typer.Option(metavar="P", help="Probability that a healthy actuator raises an alarm within 100 runs.")
    ] = 0.01,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Fit each of many logs by itself; write tables and a page in DIR, and go on there after a stop."""
    from seaopt.cli.fleet import DriftOptions, run_fleet

    options = DriftOptions(
        time=None if time is None else time.split(","),
        actuator=None if actuator is None else actuator.split(","),
        since=since,
        false_alarms=false_alarms,
    )
    if not run_fleet(
        problem,
        logs or [],
        output,
        manifest=manifest,
        identity=identity,
        scheduler=scheduler,
        workers=workers,
        like=like,
        time_limit_s=time_limit,
        drift=options,
        json=json,
        quiet=quiet,
        verbose=verbose,
    ):
        raise typer.Exit(1)


@app.command()
def schema(
    document: Annotated[
        str,
        typer.Argument(metavar="problem|fit|controller|schedule|robustness", help="Whose schema.", show_default=False),
    ],
) -> None:
    """Print the JSON Schema of a file that seaopt reads, for editors."""
    from seaopt.cli.schemas import json_schema
    from seaopt.files import to_json

    sys.stdout.write(to_json(json_schema(document)))


def main() -> None:
    """Run the command line; a SeaoptError is one line on stderr, with the place in a text, and exit code 2.

    An InternalError has another exit code, that of a defect, and the request to report it with.
    """
    prepare_streams()
    try:
        try:
            app(standalone_mode=True)
        finally:
            sys.stdout.flush()
    except SeaoptError as error:
        _end(_add_remedy(error), _list_notes(error))
    except InternalError as error:
        _end(str(error), _list_notes(error), DEFECT)
    except BrokenPipeError:
        _leave_pipe()
    except MemoryError:
        _end("does not fit in memory; take a shorter log, fewer columns, or fewer samples")
    except OSError as error:  # files are written with errors of our own: this is stdout
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes it once more
        _end(f"stdout: cannot be written ({error.strerror or error}); free its disk, or write elsewhere")


def _leave_pipe() -> NoReturn:
    """Leave without a word, as what reads stdout has; the exit code is that of no verdict."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes it once more
    raise SystemExit(PIPE_CLOSED) from None


def _add_remedy(error: SeaoptError) -> str:
    """Return an error's text, with where to look at its end where it names nothing to type itself."""
    text, command = str(error), next((word for word in sys.argv[1:] if word in ORDER), "")
    if TYPED.search(text):
        return text
    if isinstance(error, LogError) and command != "inspect":
        return f"{text}; to see what is in the log type seaopt inspect LOG"
    if isinstance(error, LogError | FileError | UnitError) or command in ("", "inspect", "new", "export", "schema"):
        return f"{text}; for what may be given type seaopt {f'{command} ' if command else ''}--help"
    return f"{text}; for every key and what it means type seaopt schema problem"


def _list_notes(error: BaseException | None) -> list[str]:
    """Return the notes of an error and of those that it was raised from, line by line."""
    notes: list[str] = []
    while error is not None:
        notes += [line for note in getattr(error, "__notes__", ()) for line in note.splitlines()]
        error = error.__cause__
    return notes


def _end(text: str, notes: Iterable[str] = (), exit_code: int = 2) -> NoReturn:
    """Write one line on stderr, as a terminal may see it, with notes below; leave, with the exit code of bad input."""
    with suppress(OSError):  # the exit code tells it where stderr cannot be written
        for line in (f"seaopt: {' '.join(text.split())}", *notes):
            sys.stderr.write(f"{printable(line)}\n")
    raise SystemExit(exit_code)
