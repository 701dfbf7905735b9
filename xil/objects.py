"""`xilgate object`: put an object on the road from outside, while a run goes on whose scenario has none."""

import math
import threading
import time
from dataclasses import dataclass

from dbc.errors import UserMistake
from gateway.telemetry import ObjectsSample, Publisher, Source, TelemetryError, WorldObject, port_of
from xil.scenario_objects import SIZES_M

PERIOD_S = 0.04
"""Time between two samples [s]; the controller takes an object for gone after 0.5 s without."""


@dataclass(frozen=True)
class OutsideObject:
    """A box on the ground that stands or drives straight on.

    Args:
        x_m, y_m: its centre at the start, in the local frame.
        heading_deg: counter-clockwise from x.
        kind: gives the size that is not given itself.

    Raises:
        UserMistake: unknown kind, or a number that no thing on a road has; one line that says what is allowed.
    """

    name: str
    x_m: float
    y_m: float
    heading_deg: float = 0.0
    speed_kmh: float = 0.0
    kind: str = "car"
    length_m: float | None = None
    width_m: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in SIZES_M:
            raise UserMistake(f"--kind {self.kind}: allowed: {', '.join(SIZES_M)}")
        for option, value, low, high in (
            ("--x-m", self.x_m, -1e6, 1e6),
            ("--y-m", self.y_m, -1e6, 1e6),
            ("--heading-deg", self.heading_deg, -360.0, 360.0),
            ("--speed-kmh", self.speed_kmh, 0.0, 250.0),
            ("--length-m", self.size_m[0], 0.1, 50.0),
            ("--width-m", self.size_m[1], 0.1, 50.0),
        ):
            if not low <= value <= high:
                raise UserMistake(f"{option} {value:g}: allowed: {low:g} to {high:g}")

    @property
    def size_m(self) -> tuple[float, float]:
        """Length and width."""
        length_m, width_m = SIZES_M[self.kind]
        return length_m if self.length_m is None else self.length_m, width_m if self.width_m is None else self.width_m

    def at(self, elapsed_s: float) -> WorldObject:
        """Where it is after a time."""
        yaw_rad, (length_m, width_m) = math.radians(self.heading_deg), self.size_m
        vx_mps, vy_mps = (self.speed_kmh / 3.6 * part(yaw_rad) for part in (math.cos, math.sin))
        return WorldObject(
            name=self.name, x_m=self.x_m + vx_mps * elapsed_s, y_m=self.y_m + vy_mps * elapsed_s,
            yaw_rad=math.remainder(yaw_rad, 2.0 * math.pi), length_m=length_m, width_m=width_m, vx_mps=vx_mps, vy_mps=vy_mps,
        )  # fmt: skip


def publish(thing: OutsideObject, base_port: int, duration_s: float, stop: threading.Event) -> None:
    """Report an object until a time is over or somebody stops it.

    Raises:
        TelemetryError: somebody else plays the world already.
    """
    try:
        publisher = Publisher(Source.WORLD, base_port)
    except TelemetryError as error:
        port = port_of(Source.WORLD, base_port)
        raise TelemetryError(
            f"telemetry port {port} of the world is taken: by a run whose scenario has objects, or by another `xilgate object`"
        ) from error
    with publisher:
        start_ns, seq = time.monotonic_ns(), 0
        while not stop.is_set() and (elapsed_s := ((now_ns := time.monotonic_ns()) - start_ns) * 1e-9) <= duration_s:
            publisher.post(ObjectsSample(t_ns=now_ns, seq=seq, objects=[thing.at(elapsed_s)]))
            seq += 1
            stop.wait(PERIOD_S)
