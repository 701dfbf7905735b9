"""The car on the road or on a lift.

On the lift there are two cars. The bench car is what is physically there: its body hangs still, its wheels turn free, and robots,
steering, pedals, engine and brakes are real. The virtual car drives on the road: it is moved by what was measured on the bench,
steering-wheel angle and pedal positions, not by what was commanded. The navigation system reports the virtual car; steering,
wheels, engine and gear are those of the bench, so that the wheel speeds disagree with the motion, as they do on a real lift.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from dbc.errors import UserMistake
from vehicle_emulator.operation import Action, Operation
from vehicle_emulator.plants.interface import LiftablePlant, Plant, PlantInputs, PlantState, SteeringInputs

RAISE, LOWER = "lift_raise", "lift_lower"
MAX_WHEEL_SPEED_RADPS = 0.5
MAX_STEERING_RATE_RADPS = 0.1
MAX_ENGINE_SPEED_RADPS = 110.0
"""Above every idle speed and below every pull: 1,050 rpm."""
_STEP_S = 0.001


class LiftRefused(UserMistake):
    """The car must not be raised or lowered now; one line with every reason."""


class Car:
    """One car, where it stands or hangs.

    Args:
        car: on its road; on the lift it is the virtual one.
        is_lifted: whether it begins on the lift.

    Raises:
        LiftRefused: it is to begin on the lift, and this kind of car cannot.
    """

    def __init__(self, car: Plant, *, is_lifted: bool = False) -> None:
        self._road_car = car
        self._lifted = _lifted(car) if is_lifted else None

    @property
    def is_lifted(self) -> bool:
        """Whether the car hangs on the lift."""
        return self._lifted is not None

    @property
    def state(self) -> PlantState:
        """What the instruments of the car measure; see the module for which of the two cars."""
        motion = self._road_car.state
        if self._lifted is None:
            return motion
        bench = self._lifted.bench.state
        return motion._replace(**{name: getattr(bench, name) for name in _MEASURED_ON_THE_BENCH})

    def step(self, dt_s: float, inputs: PlantInputs) -> PlantState:
        """Advance by `dt_s` (1 ms) with the inputs held and return the state reached."""
        if self._lifted is None:
            return self._road_car.step(dt_s, inputs)
        bench = self._lifted.bench.step(dt_s, inputs)
        self._lifted.virtual.impose_steering(bench.steering_wheel_rad, bench.steering_wheel_rate_radps)
        self._lifted.virtual.step(dt_s, inputs._replace(steering=SteeringInputs()))
        return self.state

    def raise_car(self, inputs: PlantInputs) -> None:
        """Take the car off the ground, with the inputs that act on it now.

        Raises:
            LiftRefused: it moves, robots or driver act on it, or this kind of car cannot hang.
        """
        self._refuse_unless_still("raised", inputs)
        if self._lifted is None:
            lifted = _lifted(self._road_car)
            lifted.bench.step(_STEP_S, inputs)  # its instruments do not show before
            self._lifted = lifted

    def lower_car(self, inputs: PlantInputs) -> None:
        """Set the car on the ground, where its virtual self stands; see `raise_car`."""
        self._refuse_unless_still("lowered", inputs)
        self._lifted = None

    def _refuse_unless_still(self, what: str, inputs: PlantInputs) -> None:
        states = [self._road_car.state, self.state]
        fastest = max(abs(speed) for state in states for speed in state.wheel_speeds_radps)
        engine_radps = max(state.engine_speed_radps for state in states)
        rate_radps = max(abs(state.steering_wheel_rate_radps) for state in states)
        conditions = (
            (fastest >= MAX_WHEEL_SPEED_RADPS, f"a wheel turns at {fastest:.2f} rad/s, allowed below {MAX_WHEEL_SPEED_RADPS:g}"),
            (engine_radps > MAX_ENGINE_SPEED_RADPS, f"the engine turns at {engine_radps:.0f} rad/s, allowed {MAX_ENGINE_SPEED_RADPS:g}"),
            (rate_radps > MAX_STEERING_RATE_RADPS, f"the steering turns at {rate_radps:.2f} rad/s, allowed {MAX_STEERING_RATE_RADPS:g}"),
            (inputs.steering.torque_limit_nm > 0.0, "the steering robot is powered"),
            (inputs.accelerator_norm > 0.0, f"the accelerator is at {100.0 * inputs.accelerator_norm:.0f} %, allowed 0"),
        )
        if reasons := [reason for holds, reason in conditions if holds]:
            raise LiftRefused(f"the car cannot be {what}: {'; '.join(reasons)}")


class _Lifted(NamedTuple):
    """The two cars of one that hangs on the lift."""

    bench: Plant
    virtual: LiftablePlant


_MEASURED_ON_THE_BENCH = (
    *("steering_wheel_rad", "steering_wheel_rate_radps", "steering_robot_nm"),
    *("wheel_speeds_radps", "wheel_loads_n", "engine_speed_radps", "gear"),
)
"""Fields of `PlantState` that are those of the bench car."""


def _lifted(car: Plant) -> _Lifted:
    if not isinstance(car, LiftablePlant) or not isinstance(bench := car.on_the_lift(), LiftablePlant):
        raise LiftRefused("this kind of car cannot hang on a lift; plant multibody can")
    bench.impose_steering(car.state.steering_wheel_rad, car.state.steering_wheel_rate_radps)
    return _Lifted(bench, car)


def lift_operations(car: Car, inputs: Callable[[], PlantInputs], robot_actions: Callable[[], Sequence[str]]) -> dict[str, Operation]:
    """The operations on the lift of a running emulator, by name; they answer where the car is.

    Args:
        inputs: what acts on the car now.
        robot_actions: what the robots do now, in words; it must be nothing.
    """

    def operation(act: Callable[[PlantInputs], None]) -> Operation:
        def prepare(arguments: Mapping[str, object]) -> Action:
            if arguments:
                raise UserMistake(f"{sorted(arguments)[0]}: unknown key; allowed: none")
            return lambda _: done()

        def done() -> object:
            if actions := robot_actions():
                raise LiftRefused(f"the car stays where it is: {'; '.join(actions)}")
            act(inputs())
            return {"is_lifted": car.is_lifted}

        return prepare

    return {RAISE: operation(car.raise_car), LOWER: operation(car.lower_car)}
