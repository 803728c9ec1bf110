"""Simulated logs in the files, columns, units and clocks of the measured ones in ../shared/data, for a plain clone.

Each writer makes one folder of that tree. The plants have the parameters that the measured logs gave, so that a test
of reading or fitting holds for both. Where a test needs the truth it is a constant here.
"""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path

import numpy as np
import scipy.io
from scipy.integrate import odeint, solve_ivp

# Two-mass drive with a soft coupling, all over the motor's inertia: seen at small twist 53.8 and 76.2 Hz.
DRIVE = {"J_l": 1.006, "k": 1.15e5, "c": 1.0, "d_l": 24.0, "K": 210.0, "k_3": -2e5, "c_2": 1200.0}
PENDULUM = {"I_p": 0.19, "mgL": 3.7, "d": 1e-3, "tau_c": 0.18, "v_s": 0.1}
LINK = {"K": 43.0, "d": 19.0, "f_c": 22.0, "v_s": 0.05, "mu": 0.85, "k": (2 * np.pi * 2.94) ** 2, "c": 0.3}
SERVO = {"kt": 0.158, "R": 0.666, "J": 0.00205, "f_c": 0.005, "d": 0.016, "q_0": -0.03, "c_m": 0.5, "c_g": 0.1}
COUNTS_PER_RAD, FULL_DUTY = 4096 / (2 * np.pi) / 256, 885.0
RECORDED = ("28m10", "28m17", "28m24", "28m32", "29m14", "29m21", "29m29", "29m37")  # of the measured servo's files


def write_twomass(folder: Path, periods: int = 20, seed: int = 0, **changed: float) -> None:
    """A multisine of 11 to 250 Hz at 2.5 kHz: time in us, the load's angle with its sign flipped, a MATLAB object."""
    p = DRIVE | changed
    rng = np.random.default_rng(seed)
    n = 2500
    lines = np.arange(11, 251)
    t = np.arange(n) / n
    phases = -np.pi * np.arange(lines.size) * np.arange(1, lines.size + 1) / lines.size  # Schroeder: a low crest
    current = np.cos(2 * np.pi * np.outer(t, lines) + phases).sum(axis=1)
    current *= 9.6 / current.std()

    def motion(x, time):
        at = time * n
        row, part = int(at), at % 1.0
        drive = (1 - part) * current[row % n] + part * current[(row + 1) % n]
        twist, rate = x[0] - x[2], x[1] - x[3]
        torque = p["k"] * twist + p["c"] * rate + p["k_3"] * twist**3 + p["c_2"] * twist**2 * rate
        return x[1], p["K"] * drive - torque, x[3], (torque - p["d_l"] * x[3]) / p["J_l"]

    # Two periods from rest; the last one repeats, but for the drift of the free angle.
    x = odeint(motion, np.zeros(4), np.arange(2 * n + 1) / n, rtol=1e-6, atol=1e-8, hmax=2 / n)
    start = 0 if periods < 2 else n
    lap = np.concatenate([x[:n], *(x[start:-1] + k * (x[-1] - x[start]) * [1, 0, 1, 0] for k in range(periods - 1))])
    motor, load = lap[:, 0] - 7.456, lap[:, 2] - 0.6057
    noise = 5e-6 * rng.normal(size=(2, lap.shape[0]))
    folder.mkdir(parents=True)
    path = folder / "MultisineTypeA.mat"
    columns = {
        "time": np.arange(lap.shape[0], dtype=np.int32) * 400,
        "iq_adx": np.tile(current, periods), "theta_mx": motor + noise[0], "theta_my": -(load + noise[1]),
        "msr": np.arange(2, lap.shape[0] + 2).astype(np.uint16),
        "omega_max": lap[:, 1], "omega_may": -lap[:, 3],
    }  # fmt: skip
    scipy.io.savemat(path, {name: values[:, None] for name, values in columns.items()} | {"fs": np.uint16(2500)},
                     do_compression=True)  # fmt: skip
    with path.open("ab") as stream:
        stream.write(matlab_object("BA", "tf"))


def matlab_object(name: str, kind: str) -> bytes:
    """Return a MATLAB object as MATLAB 5 files hold it: flags, name, "MCOS", class, and a reference to its store."""

    def element(code: int, content: bytes) -> bytes:
        return struct.pack("<II", code, len(content)) + content + bytes(-len(content) % 8)

    store = element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 6, 1)) + element(1, b"")
    store += element(6, struct.pack("<6I", 0xDD000000, 2, 1, 1, 1, 2))
    texts = b"".join(element(1, text.encode()) for text in (name, "MCOS", kind))
    return element(14, element(6, struct.pack("<II", 17, 0)) + texts + element(14, store))


def write_ak80(folder: Path, seed: int = 0) -> None:
    """A swing-up in bare columns at 500 Hz: the clock jitters, angle, speed and torque are quantised."""
    p = PENDULUM
    time = np.cumsum(np.concatenate([[0.0], 2e-3 + np.random.default_rng(seed).exponential(1e-6, 2999)]))
    grid = np.linspace(0, 6.1, 6101)

    def torque(t, x):  # pumps energy in, and shakes
        shake = sum(np.sin(2 * np.pi * f * t + f**2) for f in (0.9, 1.4, 2.3, 3.1, 4.7, 6.1, 7.9, 9.7))
        return 0.19 * x[1] + 0.2 * np.tanh(x[1] / 0.3) + 0.25 * shake

    def motion(t, x):
        friction = p["d"] * x[1] + p["tau_c"] * np.tanh(x[1] / p["v_s"])
        return x[1], (torque(t, x) - p["mgL"] * np.sin(x[0]) - friction) / p["I_p"]

    run = solve_ivp(motion, (0, 6.1), [0.0, 0.0], method="LSODA", t_eval=grid, rtol=1e-9, atol=1e-10)
    theta, omega, tau = (np.interp(time, grid, values) for values in (*run.y, torque(grid, run.y)))
    columns = [
        time,
        *(np.round(values / step) * step for values, step in
          ((theta, 0.00291447), (omega, 0.021978), (tau, 0.00879121))),
    ]  # fmt: skip
    folder.mkdir(parents=True)
    np.savetxt(folder / "data_measured.csv", np.stack(columns, axis=1), delimiter=",", comments="",
               header="time,position,velocity,torque")  # fmt: skip


def write_flexlink(folder: Path) -> None:
    """A hub with a rigid rod on a spring, at 500 Hz: three MAT files that share a clock, angles in encoder degrees."""
    p = LINK
    time = 0.002 * np.arange(1, 2501)

    def reference(t):
        return np.deg2rad(30) * np.sign(np.sin(2 * np.pi * 0.4 * (t - 0.3))) * (t > 0.3)

    def voltage(t, x):
        return np.clip(10 * (reference(t) - x[0]) - 0.4 * x[1], -6.2, 6.2)

    def motion(t, x):
        spring = p["k"] * x[2] + p["c"] * x[3]
        friction = p["d"] * x[1] + p["f_c"] * np.tanh(x[1] / p["v_s"])
        hub = p["K"] * voltage(t, x) - friction + p["mu"] * spring
        return x[1], hub, x[3], -spring - hub

    run = solve_ivp(motion, (0, 5.0), [0.0] * 4, method="LSODA", t_eval=time, rtol=1e-8, atol=1e-9, max_step=0.002)
    volts = np.array([voltage(t, x) for t, x in zip(time, run.y.T, strict=True)])
    count = 360 / 4096
    theta, alpha = (np.round(np.rad2deg(run.y[row]) / step) * step for row, step in ((0, count), (2, count / 8)))
    folder.mkdir(parents=True)
    for name, columns in {
        "vm": (time, volts), "theta": (time, np.rad2deg(reference(time)), theta), "alpha": (time, alpha),
    }.items():  # fmt: skip
        scipy.io.savemat(folder / f"data_{name}.mat", {f"data_{name}": np.stack(columns, axis=1)})


def write_xl330(folder: Path, duration_s: float = 2.4) -> None:
    """A servo that swings a weight, two gains by four trajectories: JSON with a header, a jittered clock, the load
    wrapped into 16 bits, and the torque off where the weight is dropped."""
    rng = np.random.default_rng(0)
    goals = {
        "sin_sin": lambda t: np.sin(3 * t) * 1.2 + 0.5 * np.sin(7.5 * t),
        "lift_and_drop": lambda t: -1.57 * np.minimum(t, 1.0) ** 2 * (3 - 2 * np.minimum(t, 1.0)),
        "up_and_down": lambda t: 0.785 * (1 - np.cos(2.2 * t)),
        "sin_time_square": lambda t: np.sin(1.4 * t**2),
    }
    folder.mkdir(parents=True)
    for number, (kp, (name, goal)) in enumerate((kp, pair) for kp in (100, 400) for pair in goals.items()):
        time = 0.0035 + np.cumsum(rng.uniform(0.0051, 0.0060, int(duration_s / 0.0052)))
        time = time[time < duration_s]
        on = (time < 1.2) | (name != "lift_and_drop")
        q, w = swing(time, goal, kp, 1.2 if name == "lift_and_drop" else np.inf)
        duty = np.where(on, np.clip(COUNTS_PER_RAD * kp * (goal(time) - q), -FULL_DUTY, FULL_DUTY), 0.0)
        duty += on * rng.integers(0, 4, time.size)
        step = 2 * np.pi / 4096
        rows = zip(time, step * np.round(q / step), w, np.round(duty).astype(int) % 65536, goal(time), on, strict=True)
        entries = [
            {"position": float(a), "speed": float(b), "load": int(c), "input_volts": 7.3, "temp": 28,
             "timestamp": float(t), "goal_position": float(d), "torque_enable": bool(e)} for t, a, b, c, d, e in rows
        ]  # fmt: skip
        header = {"mass": 0.49, "length": 0.1, "kp": kp, "vin": 7.4, "motor": "xl330", "trajectory": name}
        (folder / f"2026-01-15_10h{RECORDED[number]}.json").write_text(json.dumps(header | {"entries": entries}))


def swing(time, goal, kp, off_s):
    """Return the angle and the speed of the servo at the instants given; nothing drives it after `off_s`."""
    p, weight = SERVO, 0.49 * 9.81 * 0.1
    inertia = p["J"] + 0.49 * 0.1**2

    def motion(x, t):
        duty = min(max(COUNTS_PER_RAD / FULL_DUTY * kp * (goal(t) - x[0]), -1.0), 1.0)
        motor = p["kt"] / p["R"] * (7.4 * duty - p["kt"] * x[1]) * (t < off_s)
        gravity = weight * np.sin(x[0] - p["q_0"])
        load = np.sqrt((p["c_m"] * motor + p["c_g"] * gravity) ** 2 + 1e-6)
        friction = (p["f_c"] + load) * np.tanh(x[1] / 0.002) + p["d"] * x[1]
        return x[1], (motor - gravity - friction) / inertia

    return odeint(motion, [0.0, 0.0], time, rtol=1e-8, atol=1e-9, hmax=0.01, tcrit=[off_s] if off_s < 9 else None).T


def write_formats(folder: Path) -> None:
    """The scope's text and MAT files, and ROS 1 and ROS 2 recordings."""
    write_acqtools(folder / "acqtools")
    write_ros1(folder / "ros1")
    write_ros2(folder / "ros2")


def write_acqtools(folder: Path) -> None:
    """27 rows at 25 kHz with a counter that rises every second row: whole, cut at its start, and with a lost row."""
    folder.mkdir(parents=True)
    counts = {
        "Wex1_noError": 1 + np.arange(27) // 2,
        "Wmsr1_ini": 2 + np.arange(1, 28) // 2,
        "Wmsr2_loss": np.delete(2 + np.arange(1, 29) // 2, 14),
    }
    names = ("msr", "pos_t", "vel_ta", "servo_ad", "disp_m1", "disp_s1", "disp_m2", "disp_s2")
    header = ",".join(["Time[usec]", *(f"CH{k}({name})" for k, name in enumerate(names, start=1))])
    rng = np.random.default_rng(0)
    for name, count in counts.items():
        values = np.column_stack([count, -1e-5 * np.arange(27), rng.normal(size=(27, 6))])
        rows = (f"{40 * k}," + ",".join(f"{value:.6e}".replace("e+", "e+0").replace("e-", "e-0") for value in row) + " "
                for k, row in enumerate(values))  # fmt: skip
        (folder / f"{name}.csv").write_text("\n".join([header, *rows]) + "\n\n")
    ref = (1000 * np.sin(np.arange(800000) / 50)).astype(np.int16)
    vib = rng.normal(size=400000)
    scipy.io.savemat(folder / "Dms3_oo1.mat", {"ref": ref[:, None], "vib": vib[:, None]}, do_compression=True)


POSE = "float32 x\nfloat32 y\nfloat32 theta\nfloat32 linear_velocity\nfloat32 angular_velocity\n"
COUNTS = {"/turtle1/pose": 1344, "/turtle1/cmd_vel": 357, "/tf": 400, "/turtle1/color_sensor": 6546}  # 8647 in all


def write_ros1(folder: Path) -> None:
    """One recording plain and packed, one with chunks out of order, one without messages, and two that are no bags."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    folder.mkdir(parents=True)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(POSE, "turtlesim/msg/Pose"))
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage"))
    topics = turtle_topics(store.types)
    rows = []
    for topic, (kind, delay, message) in topics.items():
        times = delay + np.arange(COUNTS[topic]) * (20.0 - delay) / COUNTS[topic]
        rows += [(int(1e9 * t), topic, bytes(store.serialize_ros1(message(t), kind))) for t in times.tolist()]
    rows.sort(key=lambda row: row[0])
    for name, packing in {"example": None, "example-lz4": "LZ4", "example-bz2": "BZ2"}.items():
        writer = Writer(folder / f"{name}.bag")
        if packing:
            writer.set_compression(Writer.CompressionFormat[packing])
        with writer:
            connections = {
                topic: writer.add_connection(topic, kind, typestore=store) for topic, (kind, *_) in topics.items()
            }
            for stamp, topic, raw in rows:
                writer.write(connections[topic], 1_396_293_887_844_783_943 + stamp, raw)
    with Writer(folder / "example-unsorted-chunks.bag") as writer:
        connection = writer.add_connection("foo", "std_msgs/msg/UInt8", typestore=store)
        for stamp in (3, 1, 2):
            raw = store.serialize_ros1(store.types["std_msgs/msg/UInt8"](data=stamp), "std_msgs/msg/UInt8")
            writer.write(connection, stamp * 1_000_000_000, raw)
            writer.write_chunk(writer.chunks[-1])
    with Writer(folder / "no-messages.bag"):
        pass
    (folder / "empty-file.bag").write_bytes(b"")
    (folder / "asci-file.txt").write_text("this is not a bag\n")


def turtle_topics(types) -> dict:
    """Return type, first instant and message at an instant of each topic: a turtle that turns in a circle."""
    twist, vector = types["geometry_msgs/msg/Twist"], types["geometry_msgs/msg/Vector3"]
    stamp, header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]

    def pose(t):
        one = np.float32(1)
        return types["turtlesim/msg/Pose"](x=np.float32(np.cos(t)), y=np.float32(np.sin(t)), theta=np.float32(t),
                                           linear_velocity=one, angular_velocity=one)  # fmt: skip

    def command(t):
        return twist(linear=vector(x=np.sin(t), y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=t))

    def transform(t):
        turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=np.sin(t / 2), w=np.cos(t / 2))
        body = types["geometry_msgs/msg/Transform"](translation=vector(x=t, y=0.0, z=0.0), rotation=turn)
        head = header(seq=0, stamp=stamp(sec=int(t), nanosec=0), frame_id="world")
        stamped = types["geometry_msgs/msg/TransformStamped"](header=head, child_frame_id="turtle", transform=body)
        return types["tf2_msgs/msg/TFMessage"](transforms=[stamped])

    return {
        "/turtle1/pose": ("turtlesim/msg/Pose", 0.0, pose),
        "/turtle1/cmd_vel": ("geometry_msgs/msg/Twist", 1.0, command),
        "/tf": ("tf2_msgs/msg/TFMessage", 0.0, transform),
        "/turtle1/color_sensor": ("std_msgs/msg/UInt8", 0.0, lambda t: types["std_msgs/msg/UInt8"](data=int(t))),
    }


BASIC = [
    "bool",
    "byte",
    "char",
    "float32",
    "float64",
    *(f"{sign}int{bits}" for bits in (8, 16, 32, 64) for sign in ("", "u")),
]
BASIC_TYPES = "".join(f"{kind} {kind}_value\n" for kind in BASIC)
ARRAYS = (
    "".join(f"{kind}[3] {kind}_values\n" for kind in [*BASIC, "string"])
    + "BasicTypes[3] basic_types_values\nConstants[3] constants_values\nint32 alignment_check\n"
    + "=" * 80 + f"\nMSG: test_msgs/BasicTypes\n{BASIC_TYPES}"
    + "=" * 80 + "\nMSG: test_msgs/Constants\nbool BOOL_CONST=true\n"
)  # fmt: skip


def write_ros2(folder: Path) -> None:
    """Recordings as SQLite and MCAP: numbers of every type and arrays of them, text, and none at all."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    folder.mkdir(parents=True)
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(ARRAYS, "test_msgs/msg/Arrays"))
    types = store.types

    def basic(k):
        values = {f"{kind}_value": kind == "bool" if kind == "bool" else k + 1 for kind in BASIC}
        return types["test_msgs/msg/BasicTypes"](**values | {"float32_value": k + 0.25, "float64_value": k - 0.125})

    def arrays(k):
        kinds = {"bool": bool, "byte": np.uint8, "char": np.uint8}
        values = {f"{kind}_values": np.array([k, 1, k % 2], dtype=kinds.get(kind) or kind) for kind in BASIC}
        constants = [types["test_msgs/msg/Constants"]() for _ in range(3)]
        return types["test_msgs/msg/Arrays"](
            **values, string_values=["", "a" * k, "odd"], basic_types_values=[basic(k + i) for i in range(3)],
            constants_values=constants, alignment_check=k,
        )  # fmt: skip

    def text(k):
        return types["std_msgs/msg/String"](data=f"Hello World: {k}")

    def number(k):
        return types["std_msgs/msg/Int32"](data=k)

    log = ("std_msgs/msg/Int32", number)
    array_topic = ("test_msgs/msg/Arrays", arrays, 4)
    recordings = {
        "cdr_test_0": {"/test_topic": ("test_msgs/msg/BasicTypes", basic, 3), "/array_topic": array_topic},
        "talker": {"/rosout": (*log, 10), "/topic": ("std_msgs/msg/String", text, 10)},
        "topics_and_services": {"/parameter_events": (*log, 7), "/events": (*log, 6), "/rosout": (*log, 0)},
        "empty_bag_0": {"/rosout": (*log, 0), "/parameter_events": (*log, 0)},
        "test_bag_for_seek_0": {"topic1": (*log, 5)},
    }  # fmt: skip
    for name, topics in recordings.items():
        for plugin, suffix in ((StoragePlugin.SQLITE3, "db3"), (StoragePlugin.MCAP, "mcap")):
            bag = folder / name
            with Writer(bag, version=9, storage_plugin=plugin) as writer:
                for topic, (kind, message, count) in topics.items():
                    connection = writer.add_connection(topic, kind, typestore=store)
                    for k in range(count):
                        writer.write(connection, 1_000_000_000 + k * 100_000_000, store.serialize_cdr(message(k), kind))
            shutil.move(bag / f"{name}.{suffix}", folder / f"{name}.{suffix}")
            shutil.rmtree(bag)
