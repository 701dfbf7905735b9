"""Objects as they are told from outside: what counts, where it is now, and what a flood or garbage on the topic does."""

import math
import time
from functools import partial

import msgspec
import pytest

from controller.inbox import MAX_PAYLOAD_BYTES, ObjectInbox
from controller.objects import MAX_AGE_NS, MOST_OBJECTS, nearest, report_of
from gateway.telemetry import KEY_PREFIX, ObjectsSample, Publisher, Source, WorldObject
from tests.support.processes import free_base_port, wait_until

MS = 1_000_000
T_NS = 5_000 * MS


def thing(name="van", x_m=50.0, y_m=0.0, **changes):
    return WorldObject(**({"name": name, "x_m": x_m, "y_m": y_m, "yaw_rad": 0.0, "length_m": 4.5, "width_m": 1.8} | changes))


def report(*things, t_ns=T_NS):
    return report_of(ObjectsSample(t_ns=t_ns, seq=0, objects=list(things)))


def test_an_object_is_where_it_has_driven_to_since_it_was_seen():
    (van,) = nearest(report(thing(vx_mps=-10.0, vy_mps=2.0, yaw_rad=0.3)), T_NS + 200 * MS, 0.0, 0.0)
    assert (van.x_m, van.y_m) == pytest.approx((48.0, 0.4))
    assert (van.name, van.yaw_rad, van.length_m, van.width_m, van.vx_mps, van.vy_mps) == ("van", 0.3, 4.5, 1.8, -10.0, 2.0)


@pytest.mark.parametrize("age_ns", [MAX_AGE_NS + 1, -MAX_AGE_NS - 1, 10**18, -(10**18)])
def test_a_report_for_another_time_counts_for_nothing(age_ns):
    assert nearest(report(thing()), T_NS + age_ns, 0.0, 0.0) == ()


def test_a_report_counts_until_it_is_too_old():
    assert len(nearest(report(thing()), T_NS + MAX_AGE_NS, 0.0, 0.0)) == 1
    assert nearest(None, T_NS, 0.0, 0.0) == ()
    assert nearest(report(), T_NS, 0.0, 0.0) == ()


@pytest.mark.parametrize(
    "bad",
    [{"x_m": 1e9}, {"length_m": 0.0}, {"width_m": -1.0}, {"length_m": 1e4}, {"vx_mps": 1e5}, {"yaw_rad": math.nan}, {"y_m": math.inf}],
)
def test_what_cannot_be_an_object_is_counted_and_left_out(bad):
    told = report(thing("good"), thing("bad", **bad))
    assert [one.name for one in told.objects] == ["good"]
    assert told.rejected == 1


def test_of_many_the_nearest_to_the_car_are_taken():
    told = report(*(thing(f"{k}", x_m=10.0 * k) for k in range(500)))
    names = [one.name for one in nearest(told, T_NS, 2500.0, 0.0)]
    assert len(names) == MOST_OBJECTS
    assert names[0] == "250"
    assert {int(name) for name in names[1:3]} == {249, 251}
    assert max(abs(int(name) - 250) for name in names) == MOST_OBJECTS // 2


def test_a_name_stands_for_one_object():
    told = report(thing("a", x_m=1.0), thing("a", x_m=2.0))
    assert [one.x_m for one in told.objects] == [2.0]
    assert told.rejected == 1


def test_what_is_far_away_is_none_of_the_cars_business():
    told = report(thing("near", x_m=0.0, vx_mps=1.0), thing("far", x_m=1e6, vx_mps=100.0))
    assert len(told.objects) == 2
    assert [one.name for one in nearest(told, T_NS + MAX_AGE_NS, 0.0, 0.0)] == ["near"]
    assert nearest(told, T_NS, math.nan, 0.0) == ()


@pytest.fixture
def base_port():
    return free_base_port()


def sample(*things, seq=0):
    return ObjectsSample(t_ns=time.monotonic_ns(), seq=seq, objects=list(things))


def test_reports_reach_the_inbox_and_garbage_does_not_stop_them(base_port):
    with Publisher(Source.WORLD, base_port) as world, ObjectInbox(base_port) as inbox:

        def raw(payload):
            world._session.put(f"{KEY_PREFIX}/objects", payload)

        def is_rejected(payload, before):
            raw(payload)  # again and again, since of what comes together only the newest is looked at
            return inbox.rejected > before

        def has_come(name):
            def look():
                world.post(sample(thing(name)))
                return inbox.report is not None and inbox.report.objects[0].name == name

            return look

        wait_until(has_come("first"), 10, "a report")
        for payload in (b"", b"\xff", b"{}", b"[" * 100_000, msgspec.json.encode({"t_ns": 1, "seq": 1, "objects": [{"name": "x"}]})):
            wait_until(partial(is_rejected, payload, inbox.rejected), 10, f"the rejection of {payload[:20]!r}")
        for k in range(200):
            raw(msgspec.json.encode(sample(*(thing(f"{n}") for n in range(1000)), seq=k)))
        wait_until(has_come("last"), 10, "a report after the flood")
        crowd = msgspec.json.encode(sample(*(thing(f"{n}") for n in range(3000))))
        assert len(crowd) > MAX_PAYLOAD_BYTES
        wait_until(partial(is_rejected, crowd, inbox.rejected), 10, "the rejection of a crowd")
        assert inbox.report.objects[0].name == "last"


def test_a_report_of_long_ago_is_rejected_when_it_comes(base_port):
    with Publisher(Source.WORLD, base_port) as world, ObjectInbox(base_port) as inbox:

        def is_rejected():
            world.post(ObjectsSample(t_ns=1, seq=0, objects=[thing()]))
            return inbox.rejected > 0

        wait_until(is_rejected, 10, "the rejection")
        assert inbox.report is None


def test_the_log_tells_when_objects_come_and_go(base_port, caplog):
    def told():
        return [record.getMessage() for record in caplog.records]

    with caplog.at_level("INFO", "xilgate.controller"), ObjectInbox(base_port):
        with Publisher(Source.WORLD, base_port) as world:

            def is_told():
                world.post(sample(thing()))
                return told() == ["objects are reported"]

            wait_until(is_told, 10, "the report")
        wait_until(lambda: len(told()) == 2, 10, "the silence")
    assert "no longer" in told()[1]
