"""Commands, options, exit codes: 0 all requirements met, 1 one is not, 2 bad input, 70 a defect, 130 Ctrl-C."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from seaopt.cli.terminal import Amount, add_remedy, end, leave_pipe, list_notes, prepare_streams
from seaopt.errors import ControlError, InternalError, SeaoptError
from seaopt.formatting import printable

if TYPE_CHECKING:
    from seaopt.cli.session import Session

INTERRUPTED = 130  # exit codes, as a shell's
DEFECT = 70  # exit code: EX_SOFTWARE of sysexits.h


ORDER = (  # of the commands in the help: as they are used
    "demo", "new", "inspect", "run", "fit", "tune", "certify", "report", "export", "validate", "fleet", "simulate",
    "frf", "bringup", "accept", "schema",
)  # fmt: skip


class _OrderedCommands(TyperGroup):
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
            leave_pipe()
        except KeyboardInterrupt as stop:
            sys.stderr.write("\nseaopt: interrupted" + (f"; {stop}" if stop.args else "") + "\n")
        raise SystemExit(INTERRUPTED)


app = typer.Typer(
    name="seaopt",
    cls=_OrderedCommands,
    help="Series elastic actuators: from raw bench logs to a certified force controller.",
    pretty_exceptions_enable=False,
)

ProblemFile = Annotated[Path, typer.Argument(metavar="PROBLEM", help="Problem file (TOML).", show_default=False)]
Folder = Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the results.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result's JSON and nothing else.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print the verdict only, or the files written.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Print all figures, notes and failures.")]
Workers = Annotated[
    int | None, typer.Option(metavar="N", min=1, help="Processes for certificates and sweeps; one if left out.")
]
Like = Annotated[
    str | None, typer.Option(metavar="EXPERIMENT", help="Read the log as this experiment's; the first if left out.")
]
ClockColumn = Annotated[str | None, typer.Option(metavar="COLUMN", help="The clock's column.")]
Taring = Annotated[str | None, typer.Option(metavar="STD:LIMIT", help="C that tares the force at rest.")]
OUT = Path("out")


def _print_version(wanted: bool) -> bool:
    if wanted:
        from seaopt import __version__

        typer.echo(f"seaopt {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def _add_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, metavar=" ", help="Print the version.")
    ] = False,
) -> None:
    """Series elastic actuators: from raw bench logs to a certified force controller. Start with `seaopt demo`, or with
    `seaopt new LOG` on a log of your own.
    """


def _choose_amount(quiet: bool, verbose: bool) -> Amount:
    return "quiet" if quiet else "verbose" if verbose else "usual"


def _exit_unless(met: bool) -> None:
    if not met:
        raise typer.Exit(1)


def _run_stage(session: Session, stage: str, json: bool, quiet: bool, verbose: bool) -> None:
    """Run a stage, print its result, and leave with the exit code of its verdict."""
    session.run(stage)
    session.show(json, [stage], _choose_amount(quiet, verbose))
    _exit_unless(session.met([stage]))


@app.command()
def demo(output: Folder = OUT / "demo", json: Json = False, quiet: Quiet = False, verbose: Verbose = False) -> None:
    """Run the THOR problem on virtual logs: fit, tune, certify, report."""
    from seaopt.problem import demo_path

    run(demo_path(), output, json, quiet, verbose)


@app.command()
def run(
    problem: ProblemFile,
    output: Folder = OUT,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    workers: Workers = None,
) -> None:
    """Fit, tune, certify and report."""
    from seaopt.cli.session import Session

    session = Session(problem, output, workers=workers)
    stages, done, amount = session.plan_stages(), list[str](), _choose_amount(quiet, verbose)
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
            session.show(json, done, amount)
        raise
    session.explain_stages(stages)
    session.show(json, stages, amount)
    _exit_unless(session.met(stages))


@app.command()
def frf(
    problem: ProblemFile,
    output: Folder = OUT,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    stretch: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", min=0.0, help="Length of each averaged window, 1/(resolution in Hz)."),
    ] = None,
) -> None:
    """Estimate frequency responses (H1, coherence, second-order fit); write frf.json and its figure."""
    from seaopt.cli.session import Session

    _run_stage(Session(problem, output, stretch_s=stretch, design=False), "frf", json, quiet, verbose)


@app.command()
def inspect(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A raw log, of any format.", show_default=False)],
    time: ClockColumn = None,
    channel: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=COLUMN", help="A channel; all numeric columns if left out. Repeatable."),
    ] = None,
    unit: Annotated[
        list[str] | None, typer.Option(metavar="NAME=UNIT", help="Unit of a channel, or of time. Repeatable.")
    ] = None,
    driven_by: Annotated[
        list[str] | None, typer.Option("--input", metavar="NAME", help="A channel that drives the others. Repeatable.")
    ] = None,
    align: Annotated[
        str | None,
        typer.Option(metavar="RULE", help="How to bring channels with another clock to this one: hold or linear."),
    ] = None,
    counter: Annotated[
        str | None,
        typer.Option(metavar="COLUMN=SAMPLES", help="A column that counts samples, and the samples per count."),
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
    """Check a log for faults, and report which frequencies it excites."""
    from seaopt.cli.inspect import inspect_log

    if listed:
        from seaopt.logs import contents

        typer.echo(printable(repr(contents(log))))
        return
    met = inspect_log(
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
    )
    _exit_unless(met)


@app.command()
def new(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG", help="Raw logs, of any format.", show_default=False)],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FILE", help="The problem file; beside the log if left out."),
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="Ask nothing; take the best guesses and mark them as guesses.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    time: ClockColumn = None,
    channel: Annotated[
        list[str] | None,
        typer.Option(metavar="ROLE=COLUMN", help="A column's role, such as I, tau_s, theta_m, F1. Repeatable."),
    ] = None,
    unit: Annotated[
        list[str] | None, typer.Option(metavar="ROLE=UNIT", help="Unit of such a column, or of time. Repeatable.")
    ] = None,
    json: Json = False,
) -> None:
    """Create a problem file from logs: inspect their columns, and ask for what cannot be inferred."""
    from seaopt.cli.new import write_problem

    write_problem(logs, output, yes=yes, force=force, json=json, time=time, channels=channel or (), units=unit or ())


@app.command()
def tune(
    problem: ProblemFile,
    output: Folder = OUT,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    sweep: Annotated[
        str | None,
        typer.Option(
            metavar="LOW:HIGH:STEP", help="Tune at each of these bandwidths (Hz) instead; write frontier.json."
        ),
    ] = None,
    free_law: Annotated[
        bool, typer.Option("--free-law", help="With --sweep: also find the best that any linear law could do.")
    ] = False,
    workers: Workers = None,
) -> None:
    """Tune the controller on the fit in DIR; write controller.json."""
    from seaopt.cli.frontier import parse_bandwidths
    from seaopt.cli.session import Session

    if free_law and sweep is None:
        raise ControlError("--free-law: needs a sweep; give --sweep LOW:HIGH:STEP too")
    bandwidths = () if sweep is None else parse_bandwidths(sweep)
    session = Session(problem, output, bandwidths_hz=bandwidths, free_law=free_law, workers=workers)
    _run_stage(session, "tune" if sweep is None else "sweep", json, quiet, verbose)


@app.command()
def validate(
    problem: ProblemFile,
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A log that was not fitted.", show_default=False)],
    output: Folder = OUT,
    like: Like = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Score the fit in DIR on another log, and compare its values with those that the log has alone."""
    from seaopt.cli.session import Session

    session = Session(problem, output, design=False)
    _exit_unless(session.validate(log, like, json, _choose_amount(quiet, verbose)))


def _add_stage(stage: str, text: str) -> None:
    """Add the command of a stage that has no options of its own."""

    @app.command(stage, help=text)
    def _(
        problem: ProblemFile, output: Folder = OUT, json: Json = False, quiet: Quiet = False, verbose: Verbose = False
    ) -> None:
        from seaopt.cli.session import Session

        _run_stage(Session(problem, output, design=stage == "report"), stage, json, quiet, verbose)


@app.command()
def fit(
    problem: ProblemFile,
    output: Folder = OUT,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    explain: Annotated[
        bool,
        typer.Option(
            "--explain", help="Add what the model lacks, where that is found, and fit again; write explained.toml."
        ),
    ] = False,
    no_causes: Annotated[
        bool, typer.Option("--no-causes", help="Do not look for what the model may lack, as the key causes = false.")
    ] = False,
) -> None:
    """Fit the parameters to the logs; write fit.json."""
    from seaopt.cli.session import Session

    session = Session(problem, output, design=False, explain=explain, causes=not no_causes)
    _run_stage(session, "fit", json, quiet, verbose)


_add_stage("report", "Write report.html and figures from the results in DIR.")
_add_stage(
    "simulate", "Simulate every experiment with the file's values; write a CSV file of each, and of each virtual log."
)


@app.command()
def certify(
    problem: ProblemFile,
    output: Folder = OUT,
    controller: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A law of your own (JSON or TOML) instead; it becomes controller.json."),
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
    _run_stage(session, "certify", json, quiet, verbose)


@app.command()
def export(
    results: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with controller.json.", show_default=False)],
    c: Annotated[Path, typer.Option("--c", "-o", metavar="OUT", help="Folder for the C code and the gains.")],
    precision: Annotated[str, typer.Option(metavar="double|float", help="Number type of the C code.")] = "double",
    name: Annotated[str, typer.Option(help="Prefix of every name in the C code.")] = "force_law",
    current_limit: Annotated[
        float | None, typer.Option(metavar="AMPERES", help="In place of the specification's current_limit_A.")
    ] = None,
    command_limit: Annotated[
        float | None, typer.Option(metavar="VALUE", help="The same for another command, in its unit: V, or a duty.")
    ] = None,
    tracking_time: Annotated[float | None, typer.Option(metavar="SECONDS", help="Of the anti-windup.")] = None,
    derate: Annotated[
        bool | None, typer.Option(help='Lower the limit as the winding warms up; the plant needs the part "thermal".')
    ] = None,
    derate_margin: Annotated[
        float | None, typer.Option(metavar="KELVIN", help="Derate, and keep this far below T_max.")
    ] = None,
    gate: Annotated[
        str | None, typer.Option(metavar="LOW:HIGH", help="Reject readings outside this range, or that jump.")
    ] = None,
    gate_max_step: Annotated[
        float | None,
        typer.Option(metavar="VALUE", help="Largest change per sample; that of the problem file if left out."),
    ] = None,
    gate_max_held: Annotated[
        int | None, typer.Option(metavar="N", help="Rejected readings in a row before a fault; 5 if left out.")
    ] = None,
    gate_ramp: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="Time from the limit to zero at a fault; 0.1 if left out.")
    ] = None,
    no_gate: Annotated[bool, typer.Option("--no-gate", help="Leave out the problem file's gate.")] = False,
    log_rows: Annotated[int | None, typer.Option(metavar="N", help="C that logs each tick in a ring.")] = None,
    tare: Taring = None,
    allow_infeasible: Annotated[
        bool, typer.Option("--allow-infeasible", help="Write a controller that misses its limits too; exit with 1.")
    ] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Write the controller in DIR as C99, and its gains as a C header and a MATLAB script."""
    from seaopt.cli.export import export_controller, parse_tare

    met = export_controller(
        results,
        c,
        json,
        derate_margin,
        amount=_choose_amount(quiet, verbose),
        gate={
            "range_N": gate,
            "max_step_N": gate_max_step,
            "max_held": gate_max_held,
            "ramp_s": gate_ramp,
            "leave_out": no_gate,
        },
        precision=precision,
        name=name,
        current_limit_A=current_limit,
        command_limit=command_limit,
        tracking_time_s=tracking_time,
        derate=derate,
        log_rows=log_rows,
        tare=parse_tare(tare),
        allow_infeasible=allow_infeasible,
    )
    _exit_unless(met)


@app.command()
def fleet(
    problem: ProblemFile,
    logs: Annotated[
        list[str] | None,
        typer.Argument(metavar="LOGS", help="Files, 'patterns/**/*.csv', addresses (s3://...).", show_default=False),
    ] = None,
    output: Folder = OUT,
    manifest: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A CSV file with the logs in its column log, and their identity in others."),
    ] = None,
    identity: Annotated[
        str | None,
        typer.Option(metavar="PATTERN", help="End of the paths: '{robot}/{actuator}_{run}.csv' makes three columns."),
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A Dask cluster: tcp://HOST:PORT or tls://HOST:PORT.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Local processes; one per core if left out.")
    ] = None,
    like: Like = None,
    time_limit: Annotated[float, typer.Option(metavar="SECONDS", min=0.1, help="Time limit per log.")] = 600.0,
    time: Annotated[
        str | None,
        typer.Option(metavar="COLUMNS", help="Identity columns that give the time: date, run, ... if left out."),
    ] = None,
    actuator: Annotated[
        str | None,
        typer.Option(metavar="COLUMNS", help="Identity columns that name an actuator; the others if left out."),
    ] = None,
    since: Annotated[
        str | None, typer.Option(metavar="TIME", help="Leave earlier logs out of drift, as after a repair.")
    ] = None,
    false_alarms: Annotated[
        float, typer.Option(metavar="P", help="Probability that a healthy actuator raises an alarm within 100 runs.")
    ] = 0.01,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Fit many logs, each by itself; write tables and a page. The same command resumes after a stop."""
    from seaopt.cli.fleet import run_fleet

    met = run_fleet(
        problem,
        logs or [],
        output,
        manifest=manifest,
        identity=identity,
        scheduler=scheduler,
        workers=workers,
        like=like,
        time_limit_s=time_limit,
        drift={
            "time": time and time.split(","),
            "actuator": actuator and actuator.split(","),
            "since": since,
            "false_alarms": false_alarms,
        },
        json=json,
        amount=_choose_amount(quiet, verbose),
    )
    _exit_unless(met)


@app.command()
def bringup(
    problem: ProblemFile,
    output: Folder = OUT,
    share: Annotated[
        float, typer.Option(metavar="SHARE", help="Of each limit, what the reference's excitation may take.")
    ] = 0.5,
    bias: Annotated[float, typer.Option(metavar="VALUE", help="Mean of the reference, in its SI unit.")] = 0.0,
    limit: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="Largest magnitude of an output: force, travel. Repeatable."),
    ] = None,
    tare: Taring = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Plan the first time on the machine: stages of the law in DIR, references, what to log and to expect."""
    from seaopt.cli.machine import plan_bring_up

    met = plan_bring_up(
        problem,
        output,
        share=share,
        bias=bias,
        limits=limit or (),
        tare=tare,
        json=json,
        amount=_choose_amount(quiet, verbose),
    )
    _exit_unless(met)


@app.command()
def accept(
    problem: ProblemFile,
    logs: Annotated[
        list[Path], typer.Argument(metavar="LOG", help="Logs taken under the exported law.", show_default=False)
    ],
    output: Folder = OUT,
    reference: Annotated[
        str | None, typer.Option(metavar="COLUMN", help="Column of the law's reference; reference or ref if left out.")
    ] = None,
    stage: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="A stage of seaopt bringup, whose law ran; the full law if left out."),
    ] = None,
    at: Annotated[
        float | None,
        typer.Option(metavar="VALUE", help="Where a schedule's variable stood, in its SI unit, if no column has it."),
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Judge logs taken under the law in DIR: is it this law, and does the machine do what was certified."""
    from seaopt.cli.machine import accept_logs

    met = accept_logs(
        problem, logs, output, reference=reference, stage=stage, at=at, json=json, amount=_choose_amount(quiet, verbose)
    )
    _exit_unless(met)


@app.command()
def schema(
    document: Annotated[
        str,
        typer.Argument(
            metavar="problem|fit|controller|schedule|robustness", help="The kind of file.", show_default=False
        ),
    ],
) -> None:
    """Print the JSON Schema of a kind of file, for editors."""
    from seaopt.cli.schemas import json_schema
    from seaopt.files import to_json

    sys.stdout.write(to_json(json_schema(document)))


def main() -> None:
    """Run the command line; a SeaoptError is one line on stderr, with the place in a text, and exit code 2. An
    InternalError has another exit code, that of a defect, and the request to report it with.
    """
    prepare_streams()
    try:
        try:
            app(standalone_mode=True)
        finally:
            sys.stdout.flush()
    except SeaoptError as error:
        end(add_remedy(error, ORDER), list_notes(error))
    except InternalError as error:
        end(str(error), list_notes(error), DEFECT)
    except BrokenPipeError:
        leave_pipe()
    except MemoryError:
        end("does not fit in memory; take a shorter log, fewer columns, or fewer samples")
    except OSError as error:  # files are written with errors of our own: this is stdout
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes it once more
        end(f"stdout: cannot be written ({error.strerror or error}); free its disk, or write elsewhere")
