"""Fault injection: on the bus, the robots, the navigation system and the car; by time, count or condition; seeded.

    kinds       the table of what can go wrong, with the parameters of each
    spec        one fault as people and files give it, checked
    condition   when a fault begins, as an expression over what the car does
    schedule    when a fault is active
    frames      what the faults of the bus do to frames
    effects     what the other faults do to robots, navigation system and car
    engine      all faults of a run, one millisecond at a time
    operations  faults while the emulator runs: add, list, clear
"""
