"""The workbench: a ball on the floor that is the wall, and the figures drawn from it.

The ball is the handle with everything left out that a bench adds: exact state, no delay, no
quantisation. What a law does wrong here is the law's own.
"""

from canwall.workbench.ball import (
    CONTINUOUS,
    Ball,
    bounced,
    continuous_ball,
    sampled_ball,
    write_ball,
)

__all__ = ["CONTINUOUS", "Ball", "bounced", "continuous_ball", "sampled_ball", "write_ball"]
