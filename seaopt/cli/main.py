"""Commands, options and exit codes: 0 done and every requirement met, 1 a requirement not met, 2 bad input."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from seaopt.errors import SeaoptError

app = typer.Typer(
    name="seaopt",
    help="Series elastic actuators: from raw bench logs to a certified force controller.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

ProblemFile = Annotated[Path, typer.Argument(metavar="PROBLEM", help="Problem file (TOML).", show_default=False)]
Folder = Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the results.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result's JSON and nothing else.")]


def _version(wanted: bool) -> None:
    if wanted:
        from seaopt import __version__

        typer.echo(f"seaopt {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Series elastic actuators: from raw bench logs to a certified force controller."""


def _finish(session: Any, json: bool, stages: list[str]) -> None:
    """Print what was asked for on stdout and leave with the exit code of the verdict."""
    session.show(json, stages)
    if not session.met(stages):
        raise typer.Exit(1)


@app.command()
def demo(output: Folder = Path("out/demo"), json: Json = False) -> None:
    """Run the THOR problem on virtual logs: fit, tune, certify, report."""
    from seaopt.problem import demo_path

    run(demo_path(), output, json)


@app.command()
def run(problem: ProblemFile, output: Folder = Path("out"), json: Json = False) -> None:
    """Fit, tune, certify and report."""
    from seaopt.cli.session import Session

    session = Session(problem, output)
    stages = session.planned()
    for stage in stages:
        if stage == "tune" and not session.designable():
            stages = ["fit", "report"]
            session.run("report")
            break
        session.run(stage)
    _finish(session, json, stages)


@app.command()
def simulate(problem: ProblemFile, output: Folder = Path("out"), json: Json = False) -> None:
    """Simulate every experiment with the file's values; write one CSV each."""
    from seaopt.cli.session import Session

    session = Session(problem, output)
    session.run("simulate")
    _finish(session, json, ["simulate"])


@app.command()
def frf(
    problem: ProblemFile,
    output: Folder = Path("out"),
    json: Json = False,
    stretch: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", min=0.0, help="Length of a stretch, one over the resolution in Hz."),
    ] = None,
) -> None:
    """Estimate frequency responses (H1, coherence, second-order fit); write frf.json and figure."""
    from seaopt.cli.session import Session

    session = Session(problem, output, stretch_s=stretch)
    session.run("frf")
    _finish(session, json, ["frf"])


@app.command()
def tune(
    problem: ProblemFile,
    output: Folder = Path("out"),
    json: Json = False,
    sweep: Annotated[
        str | None,
        typer.Option(
            metavar="LOW:HIGH:STEP", help="Tune at each bandwidth (Hz) instead; write frontier.json and figure."
        ),
    ] = None,
) -> None:
    """Tune the controller with the fit in DIR; write controller.json."""
    from seaopt.cli.frontier import bandwidths
    from seaopt.cli.session import Session

    stage = "tune" if sweep is None else "sweep"
    session = Session(problem, output, bandwidths_hz=() if sweep is None else bandwidths(sweep))
    session.run(stage)
    _finish(session, json, [stage])


def _stage(name: str, text: str) -> Callable[..., None]:
    def command(problem: ProblemFile, output: Folder = Path("out"), json: Json = False) -> None:
        from seaopt.cli.session import Session

        session = Session(problem, output)
        session.run(name)
        _finish(session, json, [name])

    command.__doc__ = text
    return command


for _name, _text in (
    ("fit", "Fit the parameters to the logs; write fit.json."),
    ("certify", "Certify the controller in DIR; write robustness.json."),
    ("report", "Write report.html and figures from the results in DIR."),
):
    app.command(_name)(_stage(_name, _text))


def main() -> None:
    """Run the command line; a SeaoptError is one line on stderr and exit code 2."""
    try:
        app(standalone_mode=True)
    except SeaoptError as error:
        sys.stderr.write(f"seaopt: {' '.join(str(error).split())}\n")
        raise SystemExit(2) from None
    except BrokenPipeError:
        raise SystemExit(0) from None
