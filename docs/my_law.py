"""A law of one's own: a spring that grows stiffer with depth, half a period ahead of the sample.

One file, one function. Named `my_law.py:my_law`, in a configuration (`[wall] law`, relative to
the configuration) or on the command line (`--law`), it runs wherever a law runs:

    canwall ball --law docs/my_law.py:my_law --option growth=2 --output ball.csv

The function takes one record, `wall`, and returns the force that pushes out of the wall. Every
field of the record stands in canwall/walls/interface.py; y < 0 is inside the wall. The function is
compiled by numba: arithmetic, `math`, `if` and loops over numbers.
"""

from typing import Any

#: Names and defaults of what `[wall.options]` may set; the function reads `wall.options.growth`.
#: growth [1/rad or 1/m]: the stiffness doubles within a depth of 1/growth.
OPTIONS = {"growth": 5.0}


def my_law(wall: Any) -> float:
    """F = K·depth·(1 + growth·depth) − B·ẏ, with the depth in the middle of the coming period."""
    if wall.y >= 0.0:
        return 0.0
    growth = wall.options.growth
    depth = max(0.0, -(wall.y + 0.5 * wall.period * wall.v))
    return wall.stiffness * depth * (1.0 + growth * depth) - wall.damping * wall.v
