"""CiA 402: state machine, option codes, torque, feedback, homing, inputs of the one axis.

No frames here; motor, encoder and hand are behind the protocol `feedback.Motion`.
"""
