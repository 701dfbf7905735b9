"""What people can ask of a running emulator: the shape of an operation.

It is prepared on whatever thread the request came in on, which is where everything is checked that can be; the action that it makes
is done by the thread of the car, at the edge of a step.
"""

from collections.abc import Callable, Mapping

Action = Callable[[int], object]
"""Done with the time of the step [ns]; returns the answer, made of what JSON can carry, or raises `UserMistake` to refuse."""
Operation = Callable[[Mapping[str, object]], Action]
"""Makes an action of the arguments of a request, or raises `UserMistake`; may run on several threads at once."""
