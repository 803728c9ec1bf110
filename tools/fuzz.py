"""Fuzz the readers of logs, and of plants written in problem files, with atheris: only a SeaoptError may escape.

python tools/fuzz.py csv|json|mat|plant [--seconds 60] [--corpus FOLDER]; an input that breaks this is left in out/fuzz.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

SUFFIX = {"csv": ".csv", "json": ".json", "mat": ".mat", "plant": ".toml"}
INSTRUMENTED = {"plant": ["seaopt.plants", "seaopt.problem"]}  # else "seaopt.logs"
MEMORY = Path("/dev/shm")  # noqa: S108  (files that live for one try)


def main() -> int:
    """Run one target."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target", choices=sorted(SUFFIX))
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--corpus", type=Path)
    given = parser.parse_args()
    try:
        import atheris
    except ImportError:
        print("fuzzing needs atheris: pip install 'seaopt[fuzz]'; it has wheels for CPython on Linux", file=sys.stderr)  # noqa: T201
        return 2
    folder = Path(tempfile.mkdtemp(dir=MEMORY if MEMORY.is_dir() else None))
    file = folder / f"log{SUFFIX[given.target]}"
    with atheris.instrument_imports(include=INSTRUMENTED.get(given.target, ["seaopt.logs"])):
        one_input = make_plant_reader(file) if given.target == "plant" else make_log_reader(given.target, file)
    corpus = given.corpus or folder / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(seeds(given.target)):
        (corpus / f"seed{number}").write_bytes(seed)
    found = Path("out/fuzz")
    found.mkdir(parents=True, exist_ok=True)
    limits = [f"-max_total_time={given.seconds}", "-timeout=20", "-rss_limit_mb=3000", "-max_len=8192"]
    atheris.Setup([sys.argv[0], *limits, f"-artifact_prefix={found}/{given.target}-", str(corpus)], one_input)
    atheris.Fuzz()
    return 0


def make_log_reader(target: str, file: Path) -> Callable[[bytes], None]:
    """Return what reads an input as a log in every way."""
    from seaopt.errors import SeaoptError
    from seaopt.logs import Column, contents, read_table

    for name in ("json", "mat", "simulink", "text", "text_layout"):  # otherwise imported later, and not instrumented
        import_module(f"seaopt.logs.formats.{name}")

    def one_input(data: bytes) -> None:
        magic = b"MATLAB 5.0 MAT-file" if target == "mat" else b""
        file.write_bytes(magic + data[len(magic) :])
        with contextlib.suppress(SeaoptError):
            read_table(file, digest=False)
        with contextlib.suppress(SeaoptError):
            for item in contents(file).fields[:4]:
                with contextlib.suppress(SeaoptError):
                    read_table(file, time=Column(column=item.name, unit="s"), channels={}, digest=False)

    return one_input


def make_plant_reader(file: Path) -> Callable[[bytes], None]:
    """Return what reads an input as one equation, and as a problem file."""
    import casadi as ca

    from seaopt.errors import SeaoptError
    from seaopt.plants.equations.expressions import parse
    from seaopt.problem import read_problem

    symbols = {name: ca.SX.sym(name) for name in ("theta", "omega", "tau", "mgL", "I_p", "tau_f", "d")}

    def one_input(data: bytes) -> None:
        file.write_bytes(data)
        with contextlib.suppress(SeaoptError):
            parse(data.decode("utf-8", "replace"), symbols, "f.omega")
        with contextlib.suppress(SeaoptError):
            read_problem(file)

    return one_input


def seeds(target: str) -> list[bytes]:
    """Return small valid files to start from."""
    if target == "plant":
        whole = (Path(__file__).resolve().parents[1] / "problems" / "pendulum.toml").read_bytes()
        equation = b"(tau - mgL*sin(theta) - if_else(omega > 0, d, -d)^2*omega - max(tau_f, 1e-3)) / I_p"
        return [whole, whole[: whole.index(b"[[experiment]]")], equation]
    import numpy as np

    rows = [{"time": 0.1 * i, "F": i * 2.5, "v": [i, 2], "imu": {"x": i}} for i in range(4)]
    if target == "json":
        whole = {"mass": 0.49, "entries": rows}
        return [json.dumps(whole).encode(), "\n".join(map(json.dumps, rows)).encode(), b'{"time": [0, 1], "F": [1, 2]}']
    if target == "csv":
        lines = ["time [s],F [N],n", *(f"{row['time']},{row['F']},a" for row in rows)]
        text = "\n".join(lines)
        comma = text.replace(",", ";").replace(".", ",")
        return [
            text.encode(),
            comma.encode("utf-16"),
            b"# scope\nt;I\nms;mA\n0;1\n1;2\n",
            b"t [s]  F [N]\n 0  1\n 1  2\n",
        ]
    import scipy.io

    out: list[bytes] = []
    for packed in (False, True):
        stream = io.BytesIO()
        content = {"time": np.arange(4.0), "run": {"F": np.ones((4, 2)), "t": "ab"}, "c": np.array([[1, "a"]], object)}
        scipy.io.savemat(stream, content, do_compression=packed)
        out.append(stream.getvalue())
    # "Structure with time" and a timeseries saved as a struct, and what has no numbers or no clock of its length.
    t = np.arange(4.0)
    signals = {"values": np.ones((4, 2)), "label": "F1", "dimensions": 2}
    scopes = {"out": {"time": t, "signals": signals}, "ts": {"Time": t, "Data": t}, "odd": {"Time": t, "Data": t[:2]}}
    stream = io.BytesIO()
    scipy.io.savemat(stream, scopes | {"z": 1j * t, "s": np.eye(4, dtype=np.int8) > 0, "e": np.empty((0, 3))})
    return [*out, stream.getvalue()]


if __name__ == "__main__":
    sys.exit(main())
