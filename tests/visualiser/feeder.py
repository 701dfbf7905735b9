"""A car that drives the double lane change of ISO 3888-1 over and over, as telemetry and nothing else.

Run it to work on the page without a vehicle: `python -m tests.visualiser.feeder`, and `xilgate view` beside it.
"""

import math
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from gateway.telemetry import (
    DEFAULT_BASE_PORT,
    TOPICS,
    CommandSample,
    FaultSample,
    Lane,
    ObjectsSample,
    ParameterChange,
    ParametersSample,
    PlanSample,
    ProfileSample,
    Publisher,
    Sample,
    SceneSample,
    Source,
    StateSample,
    StatusSample,
    WorldObject,
    WorldSample,
    topic_of,
)

SPEED_MPS = 80.0 / 3.6
START_M, END_M = -60.0, 190.0
HORIZON_STEPS = 30
PERIOD_S = 0.04
LANES = [
    Lane(name="gate 1", start_m=0.0, end_m=15.0, right_m=-2.255 / 2, left_m=2.255 / 2),
    Lane(name="gate 2", start_m=45.0, end_m=70.0, right_m=3.5 - 2.438 / 2, left_m=3.5 + 2.438 / 2),
    Lane(name="gate 3", start_m=95.0, end_m=125.0, right_m=-2.62 / 2, left_m=2.62 / 2),
]
ROAD_LEFT_M, ROAD_RIGHT_M = 7.0, -3.5


def _blend(share: float) -> tuple[float, float, float]:
    u = min(max(share, 0.0), 1.0)
    return u**3 * (10 - 15 * u + 6 * u * u), 30 * u**2 * (1 - u) ** 2, 60 * u * (1 - u) * (1 - 2 * u)


def path(x_m: float) -> tuple[float, float, float]:
    """Lateral position [m], heading [rad] and curvature [1/m] of the reference at x."""
    y_m = slope = bend = 0.0
    for start_m, length_m, offset_m in ((15.0, 30.0, 3.5), (70.0, 25.0, -3.5)):
        rise, steeper, curved = _blend((x_m - start_m) / length_m)
        y_m += offset_m * rise
        slope += offset_m * steeper / length_m
        bend += offset_m * curved / length_m**2
    return y_m, math.atan(slope), bend


def mode_at(t_s: float) -> str:
    return "STANDBY" if t_s < 0.4 else "READY" if t_s < 0.8 else "ENGAGED"


def samples_at(t_s: float, t_ns: int, seq: int) -> list[Sample]:
    """Every topic at a time after the start of the drive [s]; only `t_ns` and `seq` are of the sender."""
    x_m = START_M + SPEED_MPS * t_s
    reference_m, yaw_rad, curvature = path(x_m)
    error_m = 0.06 * math.sin(x_m / 7.0)
    y_m = reference_m + error_m
    sr_rad = 14.7 * 2.9 * curvature + 0.02 * math.sin(t_s * 9)
    ar, br = (0.0, 0.12) if abs(curvature) > 0.02 else (0.14 + 0.02 * math.sin(t_s * 3), 0.0)
    stamp = {"t_ns": t_ns, "seq": seq}
    motion = {"x_m": x_m, "y_m": y_m, "yaw_rad": yaw_rad, "vx_mps": SPEED_MPS - 0.3 * abs(yaw_rad), "vy_mps": 0.0}
    robots = {"sr_angle_rad": sr_rad, "ar_position_norm": ar, "br_position_norm": br}
    yaw_rate_radps = SPEED_MPS * curvature
    ahead_m = [x_m + SPEED_MPS * PERIOD_S * k for k in range(HORIZON_STEPS + 1)]
    courses = [path(x) for x in ahead_m]
    drawn_m = [START_M + k for k in range(int(END_M - START_M) + 1)]
    return [
        StateSample(
            **stamp, **motion, **robots, mode=mode_at(t_s), is_valid=True, yaw_rate_radps=yaw_rate_radps, ax_mps2=0.0,
            sr_command_rad=sr_rad * 1.08, ar_command_norm=ar, br_command_norm=br,
        ),
        StatusSample(
            **stamp, mode=mode_at(t_s), reason="the operator has engaged" if t_s >= 0.8 else "waiting for the operator",
            blockers=[] if t_s >= 0.4 else ["robots not ready", "no command yet"], command_age_ms=12.0, frames_received=int(t_s * 800),
            frames_rejected={}, commands_rejected={}, ticks=int(t_s * 100), ticks_late=2, step_cpu_ms=0.14,
        ),
        CommandSample(
            **stamp, state_seq=seq, status="OK", solver="casadi-c", steer_rad=sr_rad / 14.7, drive_norm=ar - br,
            solve_time_ms=5.2 + 9 * abs(yaw_rad) * 6 + 0.8 * math.sin(t_s * 31), step_time_ms=7.0, sqp_iterations=3,
            qp_iterations=5, work=7.0, primal_residual=1e-9, dual_residual=1e-6, lateral_error_m=error_m,
            speed_error_mps=-0.3 * abs(yaw_rad), disturbance_mps2=0.12, parameters_version=2, objects=1, objects_rejected=0,
        ),
        ProfileSample(**stamp, solver="casadi-c", cycles=5, time_us={"qp": 640.0, "hessian": 702.4}, calls={"qp": 1.6, "hessian": 1.6}),
        ParametersSample(
            **stamp, version=2, accepted_ns=t_ns, who="ann@desk", reverts=[],
            changes=[ParameterChange(name="planner.safe_time_s", old=1.2, new=1.8)],
        ),
        FaultSample(**stamp, name="gust", what="gust push_n=2500", event="begins", hits=0),
        ObjectsSample(**stamp, objects=[WorldObject(name="van", x_m=150.0, y_m=5.4, yaw_rad=0.0, length_m=4.8, width_m=1.9)]),
        PlanSample(
            **stamp, x_m=ahead_m, y_m=[c[0] + error_m * math.exp(-0.2 * k) for k, c in enumerate(courses)],
            yaw_rad=[c[1] for c in courses], vx_mps=[SPEED_MPS] * len(courses),
            reference_x_m=ahead_m, reference_y_m=[c[0] for c in courses],
            left_x_m=ahead_m, left_y_m=[ROAD_LEFT_M - 0.9] * len(courses), right_x_m=ahead_m, right_y_m=[ROAD_RIGHT_M + 0.9] * len(courses),
        ),
        WorldSample(
            **stamp, **motion, **robots, yaw_rate_radps=yaw_rate_radps, ax_mps2=0.0, ay_mps2=SPEED_MPS * yaw_rate_radps,
            robots_engaged=True,
        ),
        SceneSample(
            **stamp, scenario="iso3888-1", stage="hil", car_length_m=4.358, car_width_m=1.823, car_front_m=2.01, steering_ratio=14.7,
            reference_x_m=drawn_m, reference_y_m=[path(x)[0] for x in drawn_m],
            left_x_m=drawn_m, left_y_m=[ROAD_LEFT_M] * len(drawn_m), right_x_m=drawn_m, right_y_m=[ROAD_RIGHT_M] * len(drawn_m),
            lanes=LANES,
        ),
    ]


_EVERY_TICKS = {
    "state": 2, "status": 10, "command": 4, "plan": 4, "profile": 20, "parameters": 50, "world": 1, "faults": 50, "scene": 50, "objects": 4,
}  # fmt: skip


class Feeder:
    """Publishes the drive from a thread, round and round, at the rates of the real processes, on the ports from `base_port` on."""

    def __init__(self, base_port: int) -> None:
        self._base_port = base_port
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        drive_s = (END_M - START_M) / SPEED_MPS - HORIZON_STEPS * PERIOD_S
        start_ns = time.monotonic_ns()
        with ExitStack() as stack:
            owners = {source: stack.enter_context(Publisher(source, self._base_port)) for source in Source}
            tick = 0
            while not self._stop.wait(0.01):
                now_ns = time.monotonic_ns()
                for sample in samples_at((now_ns - start_ns) * 1e-9 % drive_s, now_ns, tick):
                    topic = topic_of(sample)
                    if tick % _EVERY_TICKS[topic] == 0:
                        owners[TOPICS[topic][0]].post(sample)
                tick += 1

    def close(self) -> None:
        self._stop.set()
        self._thread.join()

    def __enter__(self) -> "Feeder":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def running(target: threading.Thread, stop: threading.Event) -> Iterator[None]:
    target.start()
    try:
        yield
    finally:
        stop.set()
        target.join(timeout=10.0)
        assert not target.is_alive()


if __name__ == "__main__":
    with Feeder(DEFAULT_BASE_PORT):
        threading.Event().wait()
