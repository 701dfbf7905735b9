"""What the faults that are active do to robots, driver, navigation system and car. Several on the same thing add up."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

from vehicle_emulator.driver import Driver
from vehicle_emulator.faults.spec import FaultSpec
from vehicle_emulator.ins import MAX_LATENCY_EXTRA_S, InsFaults
from vehicle_emulator.plants.interface import PlantFaults
from vehicle_emulator.robots.faults import HEALTHY, RobotFaults

_ROBOTS = ("SR", "AR", "BR")
_SLOWEST, _SLIPPERIEST, _NOISIEST = 0.01, 0.05, 1_000.0
"""Where several factors on one thing end: what they belong to is made for no more."""


class Disturbance(NamedTuple):
    """Transmissions to destroy on the wire.

    Args:
        arbitration_id: of the frames; None for any frame on any bus.
        transmissions: how many, in the place of those that are left; 0 takes them back.
    """

    arbitration_id: int | None
    transmissions: int


class ActiveFaults(NamedTuple):
    """What is wrong in one step; neutral by default.

    Args:
        robots: of each robot, by node.
        driver: what the person in the car does besides what he should; see `driven_by`.
        friction: factor on the grip of the road.
        disturbances: transmissions to destroy, to be asked of the buses in this step.
    """

    robots: Mapping[str, RobotFaults] = MappingProxyType(dict.fromkeys(_ROBOTS, HEALTHY))
    driver: Driver = Driver()
    ins: InsFaults = InsFaults()
    plant: PlantFaults = PlantFaults()
    friction: float = 1.0
    disturbances: tuple[Disturbance, ...] = ()

    def driven_by(self, driver: Driver) -> Driver:
        """What the person in the car does, faults included."""
        if self is NOTHING:
            return driver
        wrong = self.driver
        return driver._replace(
            steering_torque_nm=driver.steering_torque_nm + wrong.steering_torque_nm,
            accelerator_norm=max(driver.accelerator_norm, wrong.accelerator_norm),
            brake_norm=max(driver.brake_norm, wrong.brake_norm),
            is_dead_man_pressed=driver.is_dead_man_pressed and wrong.is_dead_man_pressed,
            is_stop_button_pressed=driver.is_stop_button_pressed or wrong.is_stop_button_pressed,
        )


NOTHING = ActiveFaults()


@dataclass(frozen=True, slots=True)
class Moment:
    """What an effect may depend on besides its fault.

    Args:
        age_s: time since the fault began.
        direction_rad: random, the same as long as the fault is there.
    """

    age_s: float
    direction_rad: float


StateEffect = Callable[[ActiveFaults, FaultSpec, Moment], ActiveFaults]


def _robot(change: Callable[[RobotFaults, FaultSpec], RobotFaults]) -> StateEffect:
    def effect(active: ActiveFaults, spec: FaultSpec, _: Moment) -> ActiveFaults:
        node = str(spec.values.get("robot", "SR"))
        return active._replace(robots=MappingProxyType({**active.robots, node: change(active.robots[node], spec)}))

    return effect


def _driver(change: Callable[[Driver, FaultSpec], Driver]) -> StateEffect:
    return lambda active, spec, _: active._replace(driver=change(active.driver, spec))


def _ins(change: Callable[[InsFaults, FaultSpec], InsFaults]) -> StateEffect:
    return lambda active, spec, _: active._replace(ins=change(active.ins, spec))


def _plant(change: Callable[[PlantFaults, FaultSpec], PlantFaults]) -> StateEffect:
    return lambda active, spec, _: active._replace(plant=change(active.plant, spec))


def _pedals(driver: Driver, spec: FaultSpec) -> Driver:
    return driver._replace(
        accelerator_norm=max(driver.accelerator_norm, spec.number("accelerator")), brake_norm=max(driver.brake_norm, spec.number("brake"))
    )


def _bias(ins: InsFaults, spec: FaultSpec) -> InsFaults:
    x_m, y_m, z_m = ins.position_bias_m
    return ins._replace(
        position_bias_m=(x_m + spec.number("x_m"), y_m + spec.number("y_m"), z_m + spec.number("z_m")),
        yaw_bias_rad=ins.yaw_bias_rad + math.radians(spec.number("yaw_deg")),
        velocity_bias_mps=ins.velocity_bias_mps + spec.number("speed_mps"),
        yaw_rate_bias_radps=ins.yaw_rate_bias_radps + math.radians(spec.number("yaw_rate_degps")),
        acceleration_bias_mps2=ins.acceleration_bias_mps2 + spec.number("ax_mps2"),
    )


def _displaced(active: ActiveFaults, distance_m: float, direction_rad: float) -> ActiveFaults:
    x_m, y_m, z_m = active.ins.position_bias_m
    position_m = (x_m + distance_m * math.cos(direction_rad), y_m + distance_m * math.sin(direction_rad), z_m)
    return active._replace(ins=active.ins._replace(position_bias_m=position_m))


STATE_EFFECTS: Mapping[str, StateEffect] = {
    "robot_stuck": _robot(lambda robot, _: robot._replace(is_stuck=True)),
    "robot_slow": _robot(lambda robot, spec: robot._replace(slow_factor=max(robot.slow_factor * spec.number("factor"), _SLOWEST))),
    "steering_offset": _robot(lambda robot, spec: robot._replace(offset=robot.offset + math.radians(spec.number("angle_deg")))),
    "pedal_offset": _robot(lambda robot, spec: robot._replace(offset=robot.offset + spec.number("stroke"))),
    "robot_silent": _robot(lambda robot, _: robot._replace(is_silent=True)),
    "robot_dtc": _robot(lambda robot, spec: robot._replace(dtc=int(spec.number("code")))),
    "robot_torque_loss": _robot(lambda robot, _: robot._replace(drops_torque=True)),
    "dead_man_released": _driver(lambda driver, _: driver._replace(is_dead_man_pressed=False)),
    "stop_button": _driver(lambda driver, _: driver._replace(is_stop_button_pressed=True)),
    "driver_steering": _driver(
        lambda driver, spec: driver._replace(steering_torque_nm=driver.steering_torque_nm + spec.number("torque_nm"))
    ),
    "driver_pedals": _driver(_pedals),
    "ins_bias": _ins(_bias),
    "ins_drift": lambda active, spec, moment: _displaced(active, spec.number("rate_mps") * moment.age_s, moment.direction_rad),
    "ins_jump": lambda active, spec, moment: _displaced(active, spec.number("distance_m"), moment.direction_rad),
    "ins_freeze": _ins(lambda ins, _: ins._replace(is_frozen=True)),
    "ins_time_freeze": _ins(lambda ins, _: ins._replace(is_time_frozen=True)),
    "ins_dropout": _ins(lambda ins, _: ins._replace(is_silent=True)),
    "gnss_mode": _ins(lambda ins, spec: ins._replace(gnss_mode=str(spec.values["mode"]))),
    "ins_latency": _ins(
        lambda ins, spec: ins._replace(latency_extra_s=min(ins.latency_extra_s + 1e-3 * spec.number("latency_ms"), MAX_LATENCY_EXTRA_S))
    ),
    "ins_noise": _ins(lambda ins, spec: ins._replace(noise_factor=min(ins.noise_factor * spec.number("factor"), _NOISIEST))),
    "friction": lambda active, spec, _: active._replace(friction=max(active.friction * spec.number("factor"), _SLIPPERIEST)),
    "drive_loss": _plant(lambda plant, spec: plant._replace(drive_norm=plant.drive_norm * spec.number("left"))),
    "brake_loss": _plant(lambda plant, spec: plant._replace(brake_norm=plant.brake_norm * spec.number("left"))),
    "gust": _plant(lambda plant, spec: plant._replace(push_n=plant.push_n + spec.number("push_n"))),
}
"""What a kind of fault does to the rest of the car."""
GROWING = ("ins_drift",)
"""Kinds whose effect changes from step to step."""
