"""The energy-bounding algorithm (J.-P. Kim and J. Ryu, Int. J. Robotics Research 29(6), 2010).

The force changes by no more per sample than the device's own damping makes good for. Over an
interval that damping takes at least c₂·Δy², c₂ = b/T, and the held force f[j−1] gives off
f[j−1]·Δy[j]. With f²/(2·c₁) for the energy stored, no energy comes out that was not put in if

    f[j]² ≤ f[j−1]² − 2·c₁·f[j−1]·Δy[j] + 2·c₁·c₂·Δy[j]²,   c₁ ≤ 2·c₂.

In the paper it reads f[j] = f[j−1] − β·Δy[j] with β between bounds that follow from this condition.
At c₁ = 2·c₂, the stiffest, it is |f[j]| ≤ |f[j−1] − c₁·Δy[j]|; a wall that is softer keeps its own
K as c₁, and is then not changed at all. No model of wall or operator is needed, only the damping b.

A force that comes D periods late has c₂ = b/T − D·c₁ left, so that c₁ ≤ 2·b/(T·(1 + 2·D)): the
stiffness of a spring that is passive with this delay (docs/laws.md).
"""

import math

from canwall.compiled import Record, compiled
from canwall.walls.interface import sampled_law

#: damping: that of the device, 0: as configured; delay: periods from a sample to its force, 0: that
#: of the paper.
OPTIONS = {"damping": 0.0, "delay": 1.0}

# Places in the law's memory.
_FORCE, _BEFORE, _BEGUN = 0, 1, 2


@compiled
def largest_force(force: float, moved: float, c1: float, c2: float) -> float:
    """Return the bound of |f[j]| after f[j−1] = force and Δy[j] = moved."""
    square = force * force - 2.0 * c1 * force * moved + 2.0 * c1 * c2 * moved * moved
    return math.sqrt(max(square, 0.0))


@sampled_law
def energy_bounding(wall: Record) -> float:
    """F = −K·y[j] − B·ẏ[j] inside, no further from 0 than `largest_force`."""
    memory = wall.memory
    moved = wall.y_sample - memory[_BEFORE] if memory[_BEGUN] else 0.0
    memory[_BEFORE], memory[_BEGUN] = wall.y_sample, 1.0
    device = wall.options.damping if wall.options.damping > 0.0 else wall.device_viscous
    taken, delay = device / wall.period, wall.options.delay
    c1 = min(wall.stiffness, 2.0 * taken / (1.0 + 2.0 * delay))
    bound = largest_force(memory[_FORCE], moved, c1, taken - delay * c1)
    force = 0.0
    if wall.y_sample < 0.0:
        force = -wall.stiffness * wall.y_sample - wall.damping * wall.v_sample
    memory[_FORCE] = min(max(force, -bound), bound)
    return memory[_FORCE]
