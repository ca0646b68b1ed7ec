"""Workbench: a ball that bounces on the wall as its floor, and the figures drawn from it.

The ball is a handle without the imperfections of a bench: its state is exact, without delay or
quantisation, so every deviation is the law's own.
"""

from canwall.workbench.ball import (
    CONTINUOUS,
    Ball,
    continuous_ball,
    sampled_ball,
    simulate_ball,
    write_ball,
)

__all__ = ["CONTINUOUS", "Ball", "continuous_ball", "sampled_ball", "simulate_ball", "write_ball"]
