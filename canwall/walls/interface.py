"""The interface of a law: the record `WALL` that it reads, and the class `Law` that compiles it.

One sign everywhere: y < 0 is inside the wall, a force f > 0 pushes the operator out. A law reads
the record and returns f; it does not clamp to the drive's limits and does not round.
"""

import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import from_dtype, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from canwall.compiled import Record, compiled, compiled_for_c
from canwall.errors import InputError, did_you_mean
from canwall.physics import PLANT, capped_stiffness, damping_of_ratio, zoh, zoh_coefficients

#: Numbers that the record has room for: options of a law, and its memory.
MAX_OPTIONS = 64
MEMORY = 8
#: The longest contact, in periods, that a law may plan as a whole.
HORIZON = 64

#: One wall. Units: rad or m, s, N·m or N and their quotients. A law with options is compiled for
#: the same record with names to its options (`wall_with`): `wall.options.growth`.
WALL = np.dtype(
    [
        # The wall to be rendered, as it is in force.
        ("stiffness", "f8"),
        ("damping", "f8"),
        # The plant: m·ÿ + b·ẏ + k_h·y = f + d, with its equivalent for forces held over T.
        ("mass", "f8"),
        ("viscous", "f8"),
        ("spring", "f8"),
        ("period", "f8"),
        ("phi", "f8", (2, 2)),
        ("gamma", "f8", (2,)),
        # The plant on the continuous wall: the referent that the rendered wall is to match.
        ("referent", PLANT, (1,)),
        # Position as sampled and its velocity, for laws without a model.
        ("y_sample", "f8"),
        ("v_sample", "f8"),
        # State at the instant at which the force takes effect, and the bias force, for laws with
        # a model.
        ("y", "f8"),
        ("v", "f8"),
        ("d", "f8"),
        # Kept for the law from one sample to the next; zero at its first call.
        ("memory", "f8", (MEMORY,)),
        ("plan", "f8", (HORIZON,)),
        # The layers over the law: the tension policy, the passivity controller's largest damping
        # (0: off), and the energy absorbed so far in the present contact.
        ("tension", "i8"),
        ("passivity_damping", "f8"),
        ("absorbed", "f8"),
        ("y_before", "f8"),
        ("force_before", "f8"),
        # What was asked for: K_e = min(K, cap·m/T²) is in force where there is a cap, and
        # B = 2·ζ·√(K_e·m) where there is a damping ratio; zero: none.
        ("asked_stiffness", "f8"),
        ("asked_damping", "f8"),
        ("damping_ratio", "f8"),
        # By how much larger ζ is in force, relatively, as long as mass or delay are in doubt.
        ("doubt", "f8"),
        ("cap", "f8"),
        # Where there is a cap: the largest stiffness with the mass in force that an elastic shaft
        # bears, or delay and encoder on a rigid one.
        ("stiffest", "f8"),
        # Viscous damping of the device alone: no hand that is identified changes it.
        ("device_viscous", "f8"),
        # The law's options, in the order in which its file declares them.
        ("option_values", "f8", (MAX_OPTIONS,)),
    ],
    align=True,
)


def wall_with(options: Iterable[str]) -> np.dtype[np.void]:
    """Layout of WALL with `option_values` replaced by a record `options` of these names.

    Size and offsets are those of WALL, so a law compiled for this layout can be called with any
    WALL record. Without names it is WALL itself: helpers are then compiled once for all laws.
    """
    names = tuple(options)
    if not names:
        return WALL
    fields = dict(WALL.fields or {})
    _, offset, *_ = fields.pop("option_values")
    fields["options"] = np.dtype([(name, "f8") for name in names], align=True), offset
    return np.dtype(
        {
            "names": list(fields),
            "formats": [field[0] for field in fields.values()],
            "offsets": [field[1] for field in fields.values()],
            "itemsize": WALL.itemsize,
        },
        align=True,
    )


class UnknownLawError(InputError):
    """A law that does not exist, does not compile, or does not have the given options."""


def failed_how(failure: str) -> str:
    """Say of a law how it failed: by what it raised (`Law.failure`), or if that is empty by NaN."""
    return f"raised {failure}" if failure else "gave a force that is not a number"


class Law:
    """A function of one WALL record that returns a force, and the options that it reads.

    Compiled code calls it by `address`, which stands in a record, so laws can be exchanged between
    two cycles without touching the code that calls them. The function is compiled at its first
    use: most runs use one or two laws.

    Attributes:
        name: Name in configurations and summaries.
        options: Names and defaults of what `[wall.options]` may set.
        sampled: True if it goes by the sampled position, not by the state that a model gives.
        failure: Returns what the last call raised, or what one with a given wall raises, dtype WALL
            and shape (1,); empty if nothing.
    """

    def __init__(
        self,
        name: str,
        function: Callable[[Any], float],
        options: Mapping[str, float],
        cached: bool = True,
        failure: Callable[..., str] = lambda wall=None: "",
        sampled: bool = False,
    ) -> None:
        """Declare a law; nothing is compiled yet.

        `cached` keeps the compiled code on disk, for functions of this package only: a change of
        what a function calls is noticed here, not elsewhere (`canwall.compiled`).
        """
        self.name = name
        self.options = options
        self.sampled = sampled
        self._function = function
        self._cached = cached
        self.failure = failure
        self._compiled: Any = None
        self._compiling = threading.Lock()

    def compile(self) -> None:
        """Compile the function, or load it from disk, unless that is done; any thread may call.

        Raises numba's NumbaError where the function is not within what numba compiles.
        """
        with self._compiling:
            if self._compiled is None:
                signature = types.float64(from_dtype(wall_with(self.options)))
                self._compiled = compiled_for_c(self._function, signature, self._cached)

    @property
    def address(self) -> int:
        """Address of the compiled function in this process; compiles at its first use."""
        self.compile()
        return int(self._compiled.address)

    def option_values(self, given: Mapping[str, float]) -> list[float]:
        """All options in the order of the record, defaults where none is `given`.

        Raises UnknownLawError for a name that is no option of this law.
        """
        refuse_other_options(self.name, self.options, given)
        return [given.get(name, default) for name, default in self.options.items()]


def refuse_other_options(law: str, options: Collection[str], given: Iterable[str]) -> None:
    """Raise UnknownLawError for a name given that is none of a law's options."""
    for name in given:
        if name not in options:
            known = ", ".join(options) or "none"
            hint = did_you_mean(name, options) or f"; it has {known}"
            raise UnknownLawError(f"law {law} has no option {name!r}{hint}")


#: Added to a law's name for its variant with deadbeat compensation.
DEADBEAT = "+deadbeat"


def law(function: Callable[[Any], float]) -> Law:
    """Declare a function of this package as a law; its options are the OPTIONS of its file.

    The law has the name of the function; a function `<law>_deadbeat` is the variant of a law with
    deadbeat compensation, `<law>+deadbeat`.
    """
    name = function.__name__
    if name.endswith("_deadbeat"):
        name = name.removesuffix("_deadbeat") + DEADBEAT
    return Law(name, function, function.__globals__.get("OPTIONS", {}))


def sampled_law(function: Callable[[Any], float]) -> Law:
    """Declare a function of this package as a law that goes by the sampled position alone."""
    return Law(function.__name__, function, function.__globals__.get("OPTIONS", {}), sampled=True)


@intrinsic
def call_law(typingctx: Any, address: Any, wall: Any) -> Any:
    """Return the force of the law at `address` for one WALL record; for compiled code only."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        record = context.get_value_type(wall)
        function = ir.FunctionType(ir.DoubleType(), [record])
        return builder.call(builder.inttoptr(args[0], function.as_pointer()), [args[1]])

    return types.float64(types.uint64, wall), codegen


def set_plant(
    wall: NDArray[np.void],
    mass: float,
    viscous: float,
    spring: float,
    period: float,
    device_viscous: float | None = None,
) -> None:
    """Write the plant and its zero-order-hold equivalent into a WALL array of shape (1,).

    Mass, viscous damping and spring in SI units, linear or angular; period in s. device_viscous:
    the part of the damping that is the device's. Default: all of it.
    """
    for name, value in (("mass", mass), ("viscous", viscous), ("spring", spring)):
        wall[name] = value
        wall["referent"][name] = value
    wall["device_viscous"] = viscous if device_viscous is None else device_viscous
    wall["period"] = period
    wall["phi"], wall["gamma"] = zoh(mass, viscous, spring, period)


def set_referent(
    wall: NDArray[np.void], stiffness: float, damping: float, options: Sequence[float] = ()
) -> None:
    """Write the wall to be rendered into a WALL array of shape (1,).

    `options` are the law's, as from `Law.option_values`.
    """
    wall["stiffness"] = wall["asked_stiffness"] = stiffness
    wall["damping"] = wall["asked_damping"] = damping
    wall["referent"]["wall_stiffness"] = stiffness
    wall["referent"]["wall_damping"] = damping
    wall["stiffest"] = np.inf
    wall["option_values"] = 0.0
    wall["option_values"][0, : len(options)] = options


def clear_memory(wall: NDArray[np.void]) -> None:
    """Clear the memory of law and layers, for another law to take over."""
    for name in ("memory", "plan", "absorbed", "force_before"):
        wall[name] = 0.0


#: Rise in a period of a stiffness that the mass in force allows again, as a share of itself:
#: outside the wall, and inside, where the spring is loaded, at most.
_RISE_OUTSIDE, _RISE_INSIDE = 0.2, 0.03
#: Energy that a rise inside may add to the loaded spring, over what the damper takes meanwhile, and
#: time in which a wall at rest, against which the hand holds, rises to what is allowed [s].
_ADDED, _RISE_AT_REST_S = 1.5, 1.0
#: Share of the stiffness asked for from which it grows, where no wall was allowed before.
_LEAST_SHARE = 1e-3


@compiled
def put_in_force(wall: Record) -> None:
    """Set stiffness and damping in force from those asked for, for the mass of the plant."""
    stiffness = wall.asked_stiffness
    if wall.cap > 0.0:
        most = min(capped_stiffness(stiffness, wall.cap, wall.mass, wall.period), wall.stiffest)
        before = max(wall.stiffness, _LEAST_SHARE * stiffness)
        stiffness = min(most, before + _rise(wall, before, most))
    wall.stiffness = stiffness
    ratio = wall.damping_ratio * (1.0 + wall.doubt)
    wall.damping = damping_of_ratio(wall.asked_damping, ratio, stiffness, wall.mass)


@compiled
def _rise(wall: Record, stiffness: float, most: float) -> float:
    """Return by how much the stiffness may rise in a period, up to the most allowed.

    A spring that becomes stiffer under load gains ΔK·y²/2, with which it would throw the handle. So
    it gains about what the damper takes, B·v²·T.
    """
    if wall.y_sample >= 0.0:
        return _RISE_OUTSIDE * stiffness
    rise = _RISE_INSIDE * stiffness
    if wall.y >= 0.0:
        return rise
    taken = wall.damping * wall.v**2 * wall.period
    return min(rise, _ADDED * taken / (0.5 * wall.y**2) + most * wall.period / _RISE_AT_REST_S)


@compiled
def change_plant(wall: Record, mass: float, viscous: float) -> None:
    """Exchange mass and viscous damping of the plant, and with them its hold equivalent."""
    wall.mass = wall.referent[0].mass = mass
    wall.viscous = wall.referent[0].viscous = viscous
    p11, p12, p21, p22, c1, c2 = zoh_coefficients(mass, viscous, wall.spring, wall.period)
    wall.phi[0, 0], wall.phi[0, 1], wall.phi[1, 0], wall.phi[1, 1] = p11, p12, p21, p22
    wall.gamma[0], wall.gamma[1] = c1, c2


@compiled
def free_step(wall: Record, y: float, v: float, force: float) -> tuple[float, float]:
    """Return the state one period later under a held force: Φ·x + Γ·(f + d)."""
    phi, gamma = wall.phi, wall.gamma
    u = force + wall.d
    return (
        phi[0, 0] * y + phi[0, 1] * v + gamma[0] * u,
        phi[1, 0] * y + phi[1, 1] * v + gamma[1] * u,
    )
