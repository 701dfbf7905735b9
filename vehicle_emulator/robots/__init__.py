"""Driving robots: steering (SR), accelerator (AR), brake (BR), and the robot controller (RC) above them.

    faults       what can be wrong with one robot
    receiver     command frames, judged
    states       state machine of one robot, and its trouble codes
    supervisor   state machine of the robot controller
    steering     SR: from a command to a torque-limited demand for the steering column
    pedal        AR and BR: from a command to a pedal position and a force
    reports      diagnosis and fault frames
    system       all of it, one millisecond at a time
"""
