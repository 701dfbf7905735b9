"""The person in the car, as data: hands, feet, dead-man switch, gear lever and stop button."""

from typing import NamedTuple

from vehicle_emulator.plants.interface import Selector


class Driver(NamedTuple):
    """What the person in the car does now; by default nothing but hold the dead-man switch, with the lever in D.

    Pedals move to whoever presses them deeper, foot or robot. The steering wheel feels the sum of both torques.

    Args:
        steering_torque_nm: of the hands on the steering wheel, left positive.
        accelerator_norm, brake_norm: where the feet hold the pedals, shares of their stroke, 0 to 1.
        is_dead_man_pressed: whether the robots may be on.
        is_stop_button_pressed: the emergency stop in the cabin.
        selector: gear lever.
    """

    steering_torque_nm: float = 0.0
    accelerator_norm: float = 0.0
    brake_norm: float = 0.0
    is_dead_man_pressed: bool = True
    is_stop_button_pressed: bool = False
    selector: Selector = Selector.DRIVE
