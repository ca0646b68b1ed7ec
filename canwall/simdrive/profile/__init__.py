"""CiA 402: state machine, option codes, torque, feedback, homing, inputs of the one axis.

Nothing here knows of frames; what moves is behind the `Motion` of `feedback`.
"""
