"""The watchdog between robot controller and gateway: it asks, the gateway answers, and only a living program finds the answer.

The robot controller asks a new question with every safety status; the answer goes out with the next safety command. An echo would
not do: a gateway that repeats what it heard, or a frame that a bus delivers twice, must not pass for one that computes.
"""

QUESTIONS = 256

_KEY = 0xA7
"""With an odd number of bits no question is its own answer: a rotation keeps the number of bits."""


def answer(question: int) -> int:
    """Answer to a question, both 0 to 255: three bits rotated to the left, then combined with a key; a bijection without a fixed point."""
    return ((question << 3 | question >> 5) & 0xFF) ^ _KEY
