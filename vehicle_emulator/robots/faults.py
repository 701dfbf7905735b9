"""What can be wrong with one robot, as data; whoever injects faults replaces the whole value."""

from typing import NamedTuple


class RobotFaults(NamedTuple):
    """What is wrong with one robot now; nothing by default.

    Args:
        is_stuck: its mechanics have seized: it stays where it is, whatever is commanded and whoever pulls.
        slow_factor: share of its rates, accelerations and bandwidth that is left; above 0, at most 1.
        offset: what it adds to every commanded position: rad of the steering wheel, or share of the pedal's stroke.
        is_silent: it works and sends nothing.
        dtc: trouble code that it finds in itself, an entry of the DBC's table; 0 for none.
        drops_torque: it has no torque or force: it lets go.
    """

    is_stuck: bool = False
    slow_factor: float = 1.0
    offset: float = 0.0
    is_silent: bool = False
    dtc: int = 0
    drops_torque: bool = False


HEALTHY = RobotFaults()
