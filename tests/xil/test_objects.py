"""Objects from outside: what they publish, that the controller can use it, and what is refused."""

import math
import signal

import pytest

from controller.objects import report_of
from dbc.errors import UserMistake
from gateway.telemetry import ObjectsSample, Publisher, Source, Subscriber, decode
from tests.support.processes import end, free_base_port, start_xilgate, wait_until, xilgate
from xil.objects import OutsideObject


def test_an_object_drives_straight_on():
    seen = OutsideObject("car", 10.0, -2.0, heading_deg=90.0, speed_kmh=36.0).at(3.0)
    assert (seen.x_m, seen.y_m, seen.yaw_rad) == pytest.approx((10.0, 28.0, math.pi / 2))
    assert (seen.vx_mps, seen.vy_mps) == pytest.approx((0.0, 10.0), abs=1e-12)
    assert (seen.length_m, seen.width_m) == (4.0, 1.712)
    assert report_of(ObjectsSample(t_ns=0, seq=0, objects=[seen])).rejected == 0


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"kind": "ufo"}, "--kind ufo: allowed: car, adult, child, cyclist"),
        ({"speed_kmh": -1.0}, "--speed-kmh -1: allowed: 0 to 250"),
        ({"x_m": math.nan}, "--x-m nan: allowed: -1e+06 to 1e+06"),
        ({"width_m": 0.0}, "--width-m 0: allowed: 0.1 to 50"),
    ],
)
def test_numbers_of_no_object_are_refused(fields, named):
    with pytest.raises(UserMistake) as caught:
        OutsideObject(**({"name": "thing", "x_m": 0.0, "y_m": 0.0} | fields))
    assert str(caught.value) == named


def test_an_object_is_published_until_it_is_stopped():
    base_port, seen = free_base_port(), []
    with Subscriber(lambda topic, payload: seen.append(decode(topic, payload)), ["objects"], base_port):
        process = start_xilgate("object", "wall", "--x-m", "30", "--y-m", "1.5", "--kind", "adult", "--telemetry-port", str(base_port))
        try:
            wait_until(lambda: len(seen) > 5, 30.0, "no object was published")
            process.send_signal(signal.SIGINT)
            output, _ = process.communicate(timeout=20)
        finally:
            end(process)
    assert (process.returncode, output) == (0, "wall is on the road for 600 s; an interrupt takes it away\n")
    assert {thing.name for sample in seen for thing in sample.objects} == {"wall"}
    (thing,) = seen[-1].objects
    assert (thing.x_m, thing.y_m, thing.width_m) == (30.0, 1.5, 0.5)
    assert [sample.seq for sample in seen] == list(range(seen[0].seq, seen[-1].seq + 1))


def test_an_object_goes_when_its_time_is_over():
    place = ("--x-m", "0", "--y-m", "0", "--telemetry-port", str(free_base_port()))
    assert xilgate("object", "thing", *place, "--seconds", "0.2").returncode == 0


def test_where_somebody_plays_the_world_already_it_is_refused_in_one_line():
    base_port = free_base_port()
    with Publisher(Source.WORLD, base_port):
        finished = xilgate("object", "wall", "--x-m", "30", "--y-m", "0", "--telemetry-port", str(base_port))
    assert finished.returncode == 3
    assert finished.stderr == (
        f"xilgate: telemetry port {base_port + 4} of the world is taken: "
        "by a run whose scenario has objects, or by another `xilgate object`\n"
    )
