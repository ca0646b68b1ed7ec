"""What a law sees and how it is called: the record `WALL` and the decorator `law`.

One sign everywhere: y < 0 is inside the wall, a force f > 0 pushes the operator out. A law reads
the record and returns f; it does not clamp to the drive's limits and does not round.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import from_dtype, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from canwall.compiled import Record, compiled, compiled_for_c
from canwall.physics import PLANT, zoh

#: How many numbers a law may have for options, and for its memory.
MAX_OPTIONS = 4
MEMORY = 8
#: The longest contact, in periods, that a law may plan as a whole.
HORIZON = 64

#: One wall as a law sees it. Units: rad or m, s, N·m or N and their quotients.
WALL = np.dtype(
    [
        # The wall to be rendered, and what else the law wants to be told.
        ("stiffness", "f8"),
        ("damping", "f8"),
        ("options", "f8", (MAX_OPTIONS,)),
        # The model of what moves: m·ÿ + b·ẏ + k_h·y = f + d, held over one period T.
        ("mass", "f8"),
        ("viscous", "f8"),
        ("spring", "f8"),
        ("period", "f8"),
        ("phi", "f8", (2, 2)),
        ("gamma", "f8", (2,)),
        # The same with the continuous wall: what the rendered wall is to be like.
        ("referent", PLANT, (1,)),
        # Position as sampled and its velocity: what a law without a model has.
        ("y_sample", "f8"),
        ("v_sample", "f8"),
        # State at the instant at which the force takes effect, and the bias force: what a
        # model-based law works on.
        ("y", "f8"),
        ("v", "f8"),
        ("d", "f8"),
        # What a law wants to remember from one sample to the next; zero at its first call.
        ("memory", "f8", (MEMORY,)),
        ("plan", "f8", (HORIZON,)),
        # The layers over the law: how tension is treated, the passivity controller's largest
        # damping (0: off), and the energy that the wall holds of the present contact.
        ("tension", "i8"),
        ("passivity_damping", "f8"),
        ("absorbed", "f8"),
        ("y_before", "f8"),
        ("force_before", "f8"),
    ],
    align=True,
)
WALL_TYPE = from_dtype(WALL)

#: Signature of every law: record in, force out.
LAW_SIGNATURE = types.float64(WALL_TYPE)


def law(function: Callable[[Any], float], keep: bool = True) -> Any:
    """Compile a function of one WALL record into a law that compiled code calls by address.

    The address stands in a record, so laws can be exchanged between two cycles without touching
    the code that calls them. `keep` keeps what was compiled on disk, for functions of this
    package only: whether it has changed is not watched elsewhere (`compiled`). Returns numba's
    CFunc. Raises numba's TypingError where the function is not within what numba compiles.
    """
    return compiled_for_c(function, LAW_SIGNATURE, keep)


@intrinsic
def call_law(typingctx: Any, address: Any, wall: Any) -> Any:
    """Force of the law at `address` for one record of dtype WALL; from compiled code only."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        record = context.get_value_type(wall)
        function = ir.FunctionType(ir.DoubleType(), [record])
        return builder.call(builder.inttoptr(args[0], function.as_pointer()), [args[1]])

    return types.float64(types.uint64, wall), codegen


def set_plant(
    wall: NDArray[np.void], mass: float, viscous: float, spring: float, period: float
) -> None:
    """Write the model of what moves and its ZOH equivalent into a WALL array of shape (1,)."""
    for name, value in (("mass", mass), ("viscous", viscous), ("spring", spring)):
        wall[name] = value
        wall["referent"][name] = value
    wall["period"] = period
    wall["phi"], wall["gamma"] = zoh(mass, viscous, spring, period)


def set_referent(
    wall: NDArray[np.void], stiffness: float, damping: float, options: Sequence[float] = ()
) -> None:
    """Write the wall to be rendered, and its law's options, into a WALL array of shape (1,)."""
    wall["stiffness"] = stiffness
    wall["damping"] = damping
    wall["referent"]["wall_stiffness"] = stiffness
    wall["referent"]["wall_damping"] = damping
    wall["options"] = 0.0
    wall["options"][0, : len(options)] = options


def clear_memory(wall: NDArray[np.void]) -> None:
    """Clear what law and layers remember: another law takes over."""
    for name in ("memory", "plan", "absorbed", "force_before"):
        wall[name] = 0.0


@compiled
def free_step(wall: Record, y: float, v: float, force: float) -> tuple[float, float]:
    """State one period later under a held force: Φ·x + Γ·(f + d)."""
    phi, gamma = wall.phi, wall.gamma
    u = force + wall.d
    return (
        phi[0, 0] * y + phi[0, 1] * v + gamma[0] * u,
        phi[1, 0] * y + phi[1, 1] * v + gamma[1] * u,
    )
