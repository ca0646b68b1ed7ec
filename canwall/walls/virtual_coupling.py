"""A virtual coupling: a spring and a damper between the handle and a tool that meets the wall.

The wall of any stiffness K touches the tool alone; the operator feels it through the coupling
K_c, B_c, which is chosen once, for the device (J. E. Colgate, M. C. Stanley and J. M. Brown,
Proc. IROS 1995; R. J. Adams and B. Hannaford, IEEE Trans. Robotics and Automation 15(3), 1999).
The tool has no mass, and is integrated implicitly (backward Euler), which keeps it passive. The
largest stiffness that is felt is K_c.

By default the coupling is the stiffest that is passive with any operator, for the damping b of the
device. Without delay that is b > K_c·T/2 + B_c, so K_c = 2·b/T and B_c = 0; with a delay of D = 1,
b > 1.5·K_c·T − B_c up to K_c·T = 4·B_c (docs/laws.md), so K_c = 0.8·b/T and B_c = b/5.
"""

from canwall.compiled import Record, compiled
from canwall.walls.interface import sampled_law

#: stiffness, damping: K_c and B_c, both 0: the stiffest passive coupling; delay: D of that, 0 or
#: more periods.
OPTIONS = {"stiffness": 0.0, "damping": 0.0, "delay": 1.0}

# Places in the law's memory: handle and tool at the sample before, and if there has been one.
_HANDLE, _TOOL, _BEGUN = 0, 1, 2


@compiled
def passive_coupling(viscous: float, period: float, delay: float) -> tuple[float, float]:
    """Return (K_c, B_c) of the stiffest coupling that is passive on a device of this damping."""
    if delay == 1.0:
        return 0.8 * viscous / period, 0.2 * viscous
    return 2.0 * viscous / (period * (1.0 + 2.0 * delay)), 0.0


@sampled_law
def virtual_coupling(wall: Record) -> float:
    """F = K_c·(y_t − y[j]) + B_c·(ẏ_t − ẏ[j]), y_t the tool's position."""
    memory, period, y = wall.memory, wall.period, wall.y_sample
    if not memory[_BEGUN]:
        memory[_HANDLE] = memory[_TOOL] = y
        memory[_BEGUN] = 1.0
    stiffness, damping = wall.options.stiffness, wall.options.damping
    if stiffness <= 0.0 and damping <= 0.0:
        stiffness, damping = passive_coupling(wall.device_viscous, period, wall.options.delay)
    # The tool's balance, K·y_t + B·ẏ_t + K_c·(y_t − y) + B_c·(ẏ_t − ẏ) = 0, with backward
    # differences; without the wall where that leaves it outside.
    lag = damping / period
    led = stiffness + lag
    drive = led * y + lag * (memory[_TOOL] - memory[_HANDLE])
    wall_lag = wall.damping / period
    total = led + wall.stiffness + wall_lag
    tool = (drive + wall_lag * memory[_TOOL]) / total if total > 0.0 else y
    if tool >= 0.0:
        tool = drive / led if led > 0.0 else y
    force = stiffness * (tool - y) + lag * ((tool - memory[_TOOL]) - (y - memory[_HANDLE]))
    memory[_HANDLE], memory[_TOOL] = y, tool
    return force
