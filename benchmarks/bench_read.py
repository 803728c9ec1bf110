"""Reading against the library alone, side by side: wall time, processor time, and peak memory above the imports.

python benchmarks/bench_read.py [--rows 10000000] [--repeats 3]. Each measurement is a process of its own; of the
repeats, which take turns, the least counts.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

COLUMNS = ("time [s]", "I [A]", "F1 [N]", "F2 [N]")
CHANNELS = {"I": "I [A]", "F1": "F1 [N]", "F2": "F2 [N]"}
WINDOW = (100.0, 110.0)


def polars_csv(path):
    import polars as pl

    frame = pl.read_csv(path, schema_overrides=dict.fromkeys(COLUMNS, pl.Float64))
    return [frame[name].to_numpy() for name in COLUMNS]


def table_csv(path):
    return _read_table()(path, time="time [s]", channels=CHANNELS)


def log_csv(path):
    import seaopt.logs

    return seaopt.logs.read_log(path, time="time [s]", channels=CHANNELS)


def whole(path):
    return _read_table()(path, time="time [s]", digest=False)


def column_and_window(path):
    return _read_table()(path, time="time [s]", channels={"F1": "F1 [N]"}, window_s=WINDOW, digest=False)


def topic(path):
    return _read_table()(path, time="/a", digest=False)


def topic_and_window(path):
    return _read_table()(path, time="/a", window_s=WINDOW, digest=False)


def _read_table():
    import seaopt.logs

    return seaopt.logs.read_table


def measured(name, path):
    """Run one function and print what it took."""
    import polars  # noqa: F401  (the baseline has the imports)

    import seaopt.logs
    from seaopt.units import si_unit

    si_unit("A"), seaopt.logs
    base, wall, work, read = _peak(), time.perf_counter(), time.process_time(), _bytes_read()
    kept = globals()[name](path)
    done = (time.perf_counter() - wall, time.process_time() - work, _peak() - base, _bytes_read() - read)
    del kept
    print(json.dumps(done))


def _peak():
    # Not ru_maxrss, which a process inherits from the one that started it.
    return int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) * 1024


def _bytes_read():
    text = Path("/proc/self/io").read_text()
    return int(text.split("rchar: ")[1].split()[0])


def compared(names, path, repeats):
    """Return the least of each figure over the repeats, the functions taking turns."""
    found = {name: [] for name in names}
    for _ in range(repeats):
        for name in names:
            ran = subprocess.run([sys.executable, __file__, "--one", name, str(path)], check=True, capture_output=True)
            found[name].append(json.loads(ran.stdout))
    return {name: np.min(rows, axis=0) for name, rows in found.items()}


def make(folder, rows):
    """Write the files: 1 kHz, four columns; and a recording of two topics."""
    import h5py
    import polars as pl

    rng = np.random.default_rng(0)
    data = {"time [s]": np.arange(rows) / 1000}
    data |= {name: np.round(100 * rng.normal(size=rows), 4) for name in COLUMNS[1:]}
    frame = pl.DataFrame(data)
    frame.write_csv(folder / "log.csv")
    frame.write_parquet(folder / "log.parquet", row_group_size=100_000)
    with h5py.File(folder / "log.h5", "w") as file:
        for name, values in data.items():
            file.create_dataset(name, data=values, chunks=(10_000,), compression="gzip", compression_opts=1)
            file[name].attrs["units"] = name.split("[")[1].strip("]")
    _mcap(folder / "log.mcap", min(rows, 300_000))


def _mcap(path, rows):
    from mcap.writer import Writer

    definition = b"float64 x\nfloat64[8] rest"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1 << 18)
        writer.start()
        schema = writer.register_schema("bench/msg/Row", "ros2msg", definition)
        channels = [writer.register_channel(name, "cdr", schema) for name in ("/a", "/b")]
        body = np.zeros(9)
        for row in range(rows):
            body[0] = row
            for channel in channels:
                at = row * 1_000_000
                writer.add_message(channel, at, b"\x00\x01\x00\x00" + body.tobytes(), at)
        writer.finish()


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=10_000_000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--csv-only", action="store_true")
    parser.add_argument("--one", nargs=2)
    given = parser.parse_args()
    if given.one:
        measured(*given.one)
        return
    arrays = given.rows * len(COLUMNS) * 8
    print(f"{given.rows} rows x {len(COLUMNS)} channels, {arrays / 2**20:.0f} MiB, load {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make(folder, given.rows)
        runs = (
            ("log.csv", ("polars_csv", "table_csv", "log_csv")),
            ("log.parquet", ("whole", "column_and_window")),
            ("log.h5", ("whole", "column_and_window")),
            ("log.mcap", ("topic", "topic_and_window")),
        )
        for file, names in runs[: 1 if given.csv_only else None]:
            size = (folder / file).stat().st_size
            print(f"{file}, {size / 2**20:.0f} MiB")
            found = compared(names, folder / file, given.repeats)
            first = found[names[0]]
            for name, (wall, work, peak, read) in found.items():
                print(
                    f"  {name:18} {wall:7.3f} s ({wall / first[0]:.2f}x), processor {work:7.3f} s "
                    f"({work / first[1]:.2f}x), peak {peak / 2**20:6.0f} MiB, read {read / 2**20:6.1f} MiB"
                )


if __name__ == "__main__":
    main()
