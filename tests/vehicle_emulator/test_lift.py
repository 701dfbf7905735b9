"""The car on the road and on the lift: which of the two cars is seen, what moves the virtual one, and when the car may go up or down."""

import json
import math
import threading

import pytest

from dbc.catalogue import load
from dbc.errors import UserMistake
from dbc.vehicle import load_vehicle
from tests.vehicle_emulator.gateway_stub import GatewayStub
from vehicle_emulator.car_bus import CarBus
from vehicle_emulator.emulator import STEP_NS, STEP_S, Emulator, EmulatorSetup, StartPose
from vehicle_emulator.lift import LOWER, RAISE, Car, LiftRefused, lift_operations
from vehicle_emulator.plants.bicycle import BicyclePlant
from vehicle_emulator.plants.interface import Level, PlantInputs, PlantState, Selector, SteeringInputs
from vehicle_emulator.plants.multibody.plant import MultibodyPlant
from vehicle_emulator.service import EmulatorService

VEHICLE = load_vehicle()
BRAKED = PlantInputs(brake_norm=0.3)
POSE = (5.0, 6.0, 0.7)
BENCH_FIELDS = {
    *("steering_wheel_rad", "steering_wheel_rate_radps", "steering_robot_nm"),
    *("wheel_speeds_radps", "wheel_loads_n", "engine_speed_radps", "gear"),
}


class Recorder:
    """A car that can hang; its state is what it was given, and it remembers what it was asked."""

    def __init__(self, state: PlantState, bench: "Recorder | None" = None):
        self.state, self.bench = state, bench
        self.inputs, self.imposed = [], []

    def step(self, dt_s, inputs):
        assert dt_s == STEP_S
        self.inputs.append(inputs)
        return self.state

    def on_the_lift(self):
        return self.bench

    def impose_steering(self, angle_rad, rate_radps):
        self.imposed.append((angle_rad, rate_radps))


def numbered(first: float) -> PlantState:
    """A state of which every field is another number."""
    fields = [first + k for k in range(len(PlantState._fields))]
    return PlantState(*fields)._replace(wheel_speeds_radps=(first,) * 4, wheel_loads_n=(first + 1,) * 4)


AT_REST = PlantState()


def recorders(road: PlantState = AT_REST, bench: PlantState = AT_REST) -> tuple[Recorder, Recorder]:
    hanging = Recorder(bench)
    return Recorder(road, hanging), hanging


def multibody(**options) -> Car:
    return Car(MultibodyPlant(VEHICLE, Level(), POSE), **options)


def run(car: Car, seconds: float, inputs: PlantInputs) -> PlantState:
    for _ in range(round(seconds / STEP_S)):
        state = car.step(STEP_S, inputs)
    return state


def steered(angle_rad: float, **inputs) -> PlantInputs:
    return PlantInputs(SteeringInputs(demand_rad=angle_rad, torque_limit_nm=60.0), **inputs)


def refusal(act, inputs: PlantInputs) -> str:
    with pytest.raises(LiftRefused) as caught:
        act(inputs)
    return str(caught.value)


def test_on_the_road_there_is_one_car():
    road, bench = recorders(numbered(1.0))
    car = Car(road)
    inputs = steered(0.3, accelerator_norm=0.2)
    assert car.step(STEP_S, inputs) is road.state
    assert car.state is road.state
    assert not car.is_lifted
    assert (road.inputs, bench.inputs, road.imposed) == ([inputs], [], [])


def test_on_the_lift_every_field_is_of_the_car_that_has_it():
    road, bench = recorders(numbered(100.0), numbered(1000.0))
    car = Car(road, is_lifted=True)
    assert car.is_lifted
    for state in (car.state, car.step(STEP_S, PlantInputs())):
        seen = {name for name in PlantState._fields if getattr(state, name) == getattr(bench.state, name)}
        assert seen == BENCH_FIELDS
        assert all(getattr(state, name) == getattr(road.state, name) for name in set(PlantState._fields) - BENCH_FIELDS)


def test_the_virtual_car_gets_the_measured_steering_and_the_pedals_but_no_torque_of_robot_or_hands():
    bench_state = PlantState(steering_wheel_rad=0.4, steering_wheel_rate_radps=0.05)
    road, bench = recorders(bench=bench_state)
    car = Car(road, is_lifted=True)
    road.imposed.clear()
    steering = SteeringInputs(demand_rad=1.0, torque_limit_nm=60.0, driver_torque_nm=2.0)
    inputs = PlantInputs(steering, accelerator_norm=0.2, brake_norm=0.1, selector=Selector.REVERSE)
    car.step(STEP_S, inputs)
    assert bench.inputs == [inputs]
    assert road.imposed == [(0.4, 0.05)]
    assert road.inputs == [inputs._replace(steering=SteeringInputs())]


def test_the_virtual_car_drives_where_the_steering_of_the_bench_points():
    car = Car(MultibodyPlant(VEHICLE, Level(), POSE, 10.0), is_lifted=True)
    state = run(car, 1.0, steered(0.5))
    assert state.steering_wheel_rad == pytest.approx(0.5, abs=0.01)
    expected_radps = state.vx_mps * 0.5 / VEHICLE.steering.ratio / 2.648  # a slow car, less what it understeers
    assert expected_radps * 0.7 < state.yaw_rate_radps < expected_radps
    assert math.hypot(state.x_m - POSE[0], state.y_m - POSE[1]) == pytest.approx(10.0, abs=0.5)


def test_pedals_move_both_cars_and_their_wheels_disagree():
    car = multibody(is_lifted=True)
    state = run(car, 2.0, PlantInputs(accelerator_norm=0.2))
    front, rear = state.wheel_speeds_radps[:2], state.wheel_speeds_radps[2:]
    rolling_radps = state.vx_mps / VEHICLE.model.wheel_radius_m
    assert state.vx_mps > 1.0
    assert min(front) > 1.5 * rolling_radps  # they turn no car
    assert rear == pytest.approx((0.0, 0.0), abs=1e-6)
    assert state.wheel_loads_n == (0.0,) * 4
    stopped = run(car, 3.0, PlantInputs(brake_norm=0.5))
    assert stopped.vx_mps == pytest.approx(0.0, abs=1e-3)
    assert stopped.wheel_speeds_radps == pytest.approx((0.0,) * 4, abs=1e-3)


def test_without_the_tyres_the_steering_is_lighter():
    pull = PlantInputs(SteeringInputs(driver_torque_nm=1.5))
    on_the_road, hanging = (run(Car(MultibodyPlant(VEHICLE, Level(), POSE, 15.0), is_lifted=up), 0.5, pull) for up in (False, True))
    assert hanging.steering_wheel_rad > 1.5 * on_the_road.steering_wheel_rad > 0.0


def test_the_bus_tells_the_wheel_speeds_of_the_bench_and_the_motion_of_the_virtual_car():
    catalogue = load()
    emulator = Emulator(EmulatorSetup(VEHICLE, StartPose(speed_mps=20.0), is_lifted=True), catalogue, 0)
    told = {}
    for k in range(1, 501):
        for frame in emulator.step(k * STEP_NS, ()):
            spec = catalogue.by_id[frame.arbitration_id]
            told[spec.name] = catalogue.decode(spec, frame)
    assert told["VelocityLevel"]["VelForward"] == pytest.approx(20.0, abs=0.3)
    wheels = told["CAR_WheelSpeeds"]
    expected = CarBus(catalogue).message("CAR_WheelSpeeds", emulator.car.state, emulator.inputs)
    assert wheels == pytest.approx(expected, abs=1.0)  # it is some milliseconds old
    assert max(wheels.values()) < 30.0 < 20.0 / VEHICLE.model.wheel_radius_m
    assert [wheels["RearLeft"], wheels["RearRight"]] == [0.0, 0.0]


STILL = PlantState(engine_speed_radps=70.0)
REASONS = [
    (STILL._replace(wheel_speeds_radps=(0.0, -0.6, 0.0, 0.0)), PlantInputs(), "a wheel turns at 0.60 rad/s, allowed below 0.5"),
    (STILL._replace(wheel_speeds_radps=(0.0, 0.0, 0.0, 0.5)), PlantInputs(), "a wheel turns at 0.50 rad/s, allowed below 0.5"),
    (STILL._replace(engine_speed_radps=150.0), PlantInputs(), "the engine turns at 150 rad/s, allowed 110"),
    (STILL._replace(steering_wheel_rate_radps=-0.2), PlantInputs(), "the steering turns at 0.20 rad/s, allowed 0.1"),
    (STILL, PlantInputs(SteeringInputs(torque_limit_nm=0.1)), "the steering robot is powered"),
    (STILL, PlantInputs(accelerator_norm=0.04), "the accelerator is at 4 %, allowed 0"),
]


@pytest.mark.parametrize(("state", "inputs", "reason"), REASONS)
def test_a_car_that_is_not_still_is_neither_raised_nor_lowered(state, inputs, reason):
    road, _ = recorders(state)
    grounded, hanging = Car(road), Car(road, is_lifted=True)
    assert refusal(grounded.raise_car, inputs) == f"the car cannot be raised: {reason}"
    assert refusal(hanging.lower_car, inputs) == f"the car cannot be lowered: {reason}"
    assert (grounded.is_lifted, hanging.is_lifted) == (False, True)


@pytest.mark.parametrize(("state", "reason"), [(state, reason) for state, inputs, reason in REASONS if inputs == PlantInputs()])
def test_a_bench_that_is_not_still_is_not_lowered(state, reason):
    road, _ = recorders(STILL, state)
    assert refusal(Car(road, is_lifted=True).lower_car, PlantInputs()) == f"the car cannot be lowered: {reason}"


def test_every_reason_is_named_in_one_line():
    state = PlantState(steering_wheel_rate_radps=1.0, wheel_speeds_radps=(3.0,) * 4, engine_speed_radps=200.0)
    told = refusal(Car(recorders(state)[0]).raise_car, steered(0.0, accelerator_norm=0.5))
    assert told == (
        "the car cannot be raised: a wheel turns at 3.00 rad/s, allowed below 0.5; the engine turns at 200 rad/s, allowed 110; "
        "the steering turns at 1.00 rad/s, allowed 0.1; the steering robot is powered; the accelerator is at 50 %, allowed 0"
    )


def test_a_still_car_goes_up_and_down_and_nothing_jumps():
    car = multibody()
    run(car, 1.5, steered(1.0, brake_norm=0.3))
    before = run(car, 0.5, BRAKED)
    car.raise_car(BRAKED)
    raised = car.state
    assert car.is_lifted
    assert before.steering_wheel_rad > 0.9
    run(car, 0.5, BRAKED)
    hanging = run(car, 0.5, BRAKED)
    car.lower_car(BRAKED)
    lowered = car.state
    assert not car.is_lifted
    for one, other in ((before, raised), (hanging, lowered)):
        assert (other.x_m, other.y_m, other.yaw_rad, other.z_m) == (one.x_m, one.y_m, one.yaw_rad, one.z_m)
        assert other.steering_wheel_rad == pytest.approx(one.steering_wheel_rad, abs=1e-4)
        assert other.engine_speed_radps == pytest.approx(one.engine_speed_radps, abs=5.0)
        assert other.wheel_speeds_radps == pytest.approx((0.0,) * 4, abs=1e-3)
    assert hanging.steering_wheel_rad == pytest.approx(raised.steering_wheel_rad, abs=0.02)
    assert (raised.wheel_loads_n, hanging.wheel_loads_n) == ((0.0,) * 4, (0.0,) * 4)
    assert sum(lowered.wheel_loads_n) == pytest.approx(VEHICLE.multibody.masses.mass_kg * 9.81, rel=1e-3)


def test_a_car_is_lowered_where_its_virtual_self_has_driven():
    car = multibody(is_lifted=True)
    run(car, 2.0, steered(0.5, accelerator_norm=0.2))
    run(car, 3.0, PlantInputs(brake_norm=0.5))
    hanging = run(car, 1.0, PlantInputs(brake_norm=0.5))
    assert math.hypot(hanging.x_m - POSE[0], hanging.y_m - POSE[1]) > 1.0
    car.lower_car(PlantInputs(brake_norm=0.5))
    state = run(car, 0.5, PlantInputs(brake_norm=0.5))
    assert (state.x_m, state.y_m, state.yaw_rad) == pytest.approx((hanging.x_m, hanging.y_m, hanging.yaw_rad), abs=1e-3)
    assert state.steering_wheel_rad == pytest.approx(hanging.steering_wheel_rad, abs=0.01)


def test_free_wheels_that_creep_keep_the_car_up_until_they_are_braked():
    car = multibody(is_lifted=True)
    run(car, 2.0, PlantInputs())
    assert "a wheel turns" in refusal(car.lower_car, PlantInputs())
    run(car, 2.0, BRAKED)
    car.lower_car(BRAKED)
    assert not car.is_lifted


def test_raising_a_car_that_hangs_already_leaves_it_as_it_is():
    road, bench = recorders(STILL, STILL)
    car = Car(road, is_lifted=True)
    road.bench = None
    car.raise_car(PlantInputs())
    assert car.is_lifted
    assert bench.inputs == []


def test_a_kind_of_car_that_cannot_hang_is_refused():
    bicycle = BicyclePlant(VEHICLE, Level())
    with pytest.raises(LiftRefused, match="cannot hang on a lift; plant multibody can"):
        Car(bicycle, is_lifted=True)
    car = Car(bicycle)
    assert refusal(car.raise_car, PlantInputs()) == "this kind of car cannot hang on a lift; plant multibody can"
    assert not car.is_lifted
    assert car.step(STEP_S, PlantInputs()) == bicycle.state


class Served:
    """A car that others ask over the service of the emulator, and the thread that steps it."""

    def __init__(self, car: Car):
        self.inputs, self.robot_actions = BRAKED, []
        self.service = EmulatorService(lift_operations(car, lambda: self.inputs, lambda: self.robot_actions))

    def ask(self, op, **arguments):
        told, done = [], threading.Event()

        def asker():
            told.append(json.loads(self.service.answer(json.dumps({"op": op, "arguments": arguments}).encode())))
            done.set()

        threading.Thread(target=asker).start()
        while not done.wait(0.001):
            self.service.run_due(1)
        return told[0]


def test_the_operations_over_the_service():
    car = Car(recorders(STILL, STILL)[0])
    served = Served(car)
    assert served.ask(RAISE) == {"answer": "done", "result": {"is_lifted": True}}
    assert car.is_lifted
    assert served.ask(RAISE)["result"] == {"is_lifted": True}
    served.inputs = steered(0.0)
    assert served.ask(LOWER) == {"answer": "refused", "reason": "the car cannot be lowered: the steering robot is powered"}
    assert car.is_lifted
    served.inputs, served.robot_actions = BRAKED, ["the robot system is in Engaged", "the brake robot is at 30 %"]
    reason = "the car stays where it is: the robot system is in Engaged; the brake robot is at 30 %"
    assert served.ask(LOWER) == {"answer": "refused", "reason": reason}
    served.robot_actions = []
    assert served.ask(LOWER) == {"answer": "done", "result": {"is_lifted": False}}
    assert not car.is_lifted


@pytest.mark.parametrize("op", [RAISE, LOWER])
def test_an_operation_takes_no_arguments_and_says_so_before_the_car_is_touched(op):
    car = Car(recorders(STILL)[0])
    with pytest.raises(UserMistake, match="height_m: unknown key; allowed: none"):
        lift_operations(car, PlantInputs, list)[op]({"height_m": 1.0})
    lift_operations(car, PlantInputs, list)[op]({})  # prepared, not done
    assert not car.is_lifted


class Ride:
    """An emulator, a gateway that asks it for something, and the lift."""

    def __init__(self, **setup):
        catalogue = load()
        self.emulator, self.step = Emulator(EmulatorSetup(VEHICLE, **setup), catalogue, 0), 0
        self.gateway = GatewayStub(catalogue, lambda: self.emulator._robots.watchdog_question)
        self.lift = lift_operations(self.emulator.car, lambda: self.emulator.inputs, self.emulator.robot_actions)

    def run(self, seconds: float, request: str | None, **commands: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.step += 1
            frames = self.gateway.frames(request, **commands) if request and self.step % 10 == 0 else []
            self.emulator.step(self.step * STEP_NS, frames)

    def start(self) -> None:
        for request in ("Disarm", "Arm", "Engage"):
            self.run(0.15, request)

    def refusal(self, op: str) -> str:
        with pytest.raises(LiftRefused) as caught:
            self.lift[op]({})(self.step * STEP_NS)
        return str(caught.value)


def test_the_robots_must_be_neutral():
    ride = Ride()
    for request, state in (("Disarm", None), ("Arm", "Armed"), ("Engage", "Engaged")):
        ride.run(0.15, request)
        if state is not None:
            assert ride.refusal(RAISE) == f"the car stays where it is: the robot system is in {state}"
    ride.run(1.5, None)  # the gateway is gone: the robots stop the car
    assert ride.refusal(RAISE) == "the car stays where it is: the robot system is in ControlledStop; the brake robot is at 32 %"
    assert not ride.emulator.car.is_lifted
    ride.run(0.03, "Disarm")
    assert ride.refusal(RAISE).startswith("the car stays where it is: the brake robot is at ")
    ride.run(1.0, "Disarm")
    assert ride.lift[RAISE]({})(0) == {"is_lifted": True}


def test_a_car_that_the_robots_have_driven_on_the_lift_can_be_lowered():
    ride = Ride(is_lifted=True)
    ride.start()
    ride.run(1.0, "Engage", ar_percent=15.0)
    ride.run(2.0, "Engage", br_percent=40.0)
    ride.run(2.0, "Disarm")
    assert ride.lift[LOWER]({})(0) == {"is_lifted": False}
