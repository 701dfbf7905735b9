"""The contract of one car: its CAN databases, its numbers, and the one way onto its bus.

This package is the leaf that both ends of the wire share. It knows what a frame means, never what to do about it.
"""
