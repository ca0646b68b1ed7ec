"""A virtual wall on an industrial servo drive over CANopen."""
