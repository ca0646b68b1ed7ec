"""Axes of a sweep: names, units, and the change that a value makes to a configuration."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from canwall.config import ConfigError, Settings, with_overrides
from canwall.config.drive import MILLI_NM
from canwall.config.simulation import BREAKAWAY
from canwall.cycle import with_law
from canwall.errors import InputError, did_you_mean
from canwall.run.closed_loop import cached_servo_scales, loop_delay
from canwall.simdrive import TORQUE_LIMITS
from canwall.sweep.strike import OPERATORS, SERVOS, law_model, strike_settings
from canwall.walls import MAX_DELAY

#: Largest rate of the SYNC [Hz]: the least bus.cycle_s.
_FASTEST_HZ = 1e5
#: Largest number of values on one axis: more of them are a typing error.
_MOST_VALUES = 1_000_000

Value = str | int | float | bool
Point = Mapping[str, Value]

#: Axes that are not keys of the configuration: (unit, description).
NAMED = {
    "law": ("", "law of the wall, +deadbeat with the compensation"),
    "stiffness": ("N*m/rad", "K"),
    "stiffness_normalised": ("1", "K*T^2/m, m of drive, handle and hand"),
    "damping": ("N*m*s/rad", "B"),
    "damping_normalised": ("1", "B*T/m, m of drive, handle and hand"),
    "rate": ("Hz", "rate of the SYNC"),
    "delay": ("1", "D, cycles from a sample to its torque"),
    "counts": ("1", "encoder increments per turn, 0x608F"),
    "torque_step": ("N*m", "a thousandth of the rated torque, 0x6076"),
    "operator": ("", "operator at the handle"),
    "model": ("", "model of the laws: matched (it knows the hand), drive, file"),
    "model_error": ("1", "relative error of the model's inertia"),
    "servo": ("", "file: as configured; ideal: as with simulation.ideal; 1600Hz, 800Hz: real ones"),
    "friction": ("N*m", "Coulomb friction; 1.5 times as much holds at rest"),
    "breakaway": ("1", "what holds at rest, over Coulomb friction"),
    "delay_error": ("1", "error of the D that the laws reckon with, in cycles"),
    "speed": ("rad/s", "mean speed of the hand's approach"),
    "phase": ("1", "phase of the contact relative to the SYNC"),
    "start": ("rad", "distance from the wall at which the handle rests before the strike"),
    "press": ("s", "time for which the hand presses"),
    "press_torque": ("N*m", "torque with which the hand presses"),
    "sync_jitter": ("s", "standard deviation of a SYNC from its grid"),
}
#: Axes of the wall itself: a strike is prepared once for all of their values.
STIFFNESS = ("stiffness", "stiffness_normalised")
DAMPING = ("damping", "damping_normalised")
#: Axes over which the worst value counts.
STRIKES = ("speed", "phase")
#: Values of axes that neither the configuration nor the command line gives.
DEFAULTS: dict[str, tuple[Value, ...]] = {
    "model": ("matched",),
    "model_error": (0.0,),
    "servo": ("file",),
    "delay_error": (0.0,),
    "start": (0.03,),
    "press": (0.6,),
    "press_torque": (0.15,),
    "sync_jitter": (0.0,),
    "speed": (0.5, 1.0, 2.0),
    "phase": (0.0, 0.35, 0.7),
}
#: Keys of the configuration that every strike sets anew, and the axes from which it does, if any.
INSTEAD = {
    "bus.cycle_s": "rate",
    "wall.law": "law",
    "wall.stiffness_nm_per_rad": "stiffness",
    "wall.damping_nm_s_per_rad": "damping",
    "simulation.hand.rest_rad": "start",
    "simulation.hand.approach_s": "speed",
    "simulation.hand.withdraw_s": "speed",
    "simulation.hand.press_s": "press",
    "simulation.hand.press_rad": "press_torque",
    "simulation.hand.press_torque_nm": "press_torque",
    "simulation.hand.strikes": "",
    "simulation.hand.first_strike_s": "",
    "simulation.hand.interval_s": "",
    "run.duration_s": "",
}
#: Axes of numbers that may be zero.
_MAY_BE_ZERO = (
    *DAMPING,
    "delay",
    "phase",
    "sync_jitter",
    "friction",
)
_CHOICES = {
    "model": ("matched", "drive", "file"),
    "servo": ("file", "ideal", *SERVOS),
    "operator": tuple(OPERATORS),
}


@dataclass(frozen=True)
class SweepAxis:
    """One axis: its name and its ordered values."""

    name: str
    values: tuple[Value, ...]

    @property
    def unit(self) -> str:
        """Unit of the values; empty for names and for keys of the configuration."""
        return NAMED.get(self.name, ("", ""))[0]


def parse_axis(name: str, given: object) -> SweepAxis:
    """Parse the values of an axis: an array, a single value, "A,B,C" or a range "LO:HI:N".

    A range has N values, geometrically spaced for a stiffness and evenly for everything else;
    "LO:HI:N:log" and "LO:HI:N:lin" choose the spacing. Raises InputError.
    """
    if name not in NAMED and "." not in name:
        hint = did_you_mean(name, NAMED)
        known = f"; known are {', '.join(NAMED)}, and keys of the configuration"
        raise InputError(f"sweep axis {name}: unknown{hint or known}")
    if isinstance(given, str):
        values = tuple(v for part in given.split(",") for v in _parse_part(name, part.strip()))
    elif isinstance(given, Sequence):
        values = tuple(v for part in given for v in parse_axis(name, part).values)
    elif isinstance(given, dict | set):
        what = type(given).__name__
        raise InputError(f"sweep axis {name}: has to have numbers or text as values, not {what}")
    else:
        values = (given,)  # type: ignore[assignment]
    if not values or "" in values:
        raise InputError(f"sweep axis {name}: has no values")
    if len(set(values)) < len(values):
        raise InputError(f"sweep axis {name}: has a value twice")
    for value in values:
        _check(name, value)
    return SweepAxis(name, values)


def _parse_part(name: str, text: str) -> list[Value]:
    """Parse a single value or a range."""
    parts = text.split(":")
    numbers = [_parse_value(part) for part in parts[:3]]
    if len(parts) in (3, 4) and all(isinstance(n, int | float) for n in numbers):
        low, high, count = numbers
        kind = parts[3] if len(parts) == 4 else ("log" if name in STIFFNESS else "lin")
        if not isinstance(count, int) or count < 1 or kind not in ("log", "lin"):
            raise InputError(f"sweep axis {name}: {text!r} is not a range; write LO:HI:N")
        if count > _MOST_VALUES:
            raise InputError(f"sweep axis {name}: {count} values; {_MOST_VALUES} at most")
        if kind == "log" and not (low > 0 and high > 0):  # type: ignore[operator]
            raise InputError(f"sweep axis {name}: {text!r}: a geometric range has to be above 0")
        spaced = np.geomspace if kind == "log" else np.linspace
        values = spaced(float(low), float(high), count)
        whole = all(isinstance(n, int) for n in numbers) and np.all(values == np.rint(values))
        return [int(v) if whole else float(v) for v in values]
    return [_parse_value(text)]


def _parse_value(text: str) -> Value:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return {"true": True, "false": False}.get(text, text)


def _check(name: str, value: Value) -> None:
    """Raise InputError for a value that no configuration allows on the axis."""
    if name in _CHOICES:
        if value not in _CHOICES[name]:
            raise InputError(
                f"sweep axis {name}: has to be one of {', '.join(_CHOICES[name])}, not {value!r}"
                f"{did_you_mean(value, _CHOICES[name])}"
            )
        return
    if name not in NAMED or name == "law":
        return
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not math.isfinite(value):  # type: ignore[arg-type]
        hint = "; a range is LO:HI:N" if ":" in str(value) else ""
        raise InputError(f"sweep axis {name}: has to be a number, not {value!r}{hint}")
    low = {"model_error": -1.0, "delay_error": -MAX_DELAY}.get(name, 0.0)
    low_allowed = name in _MAY_BE_ZERO
    if not (value > low or (low_allowed and value == low)):  # type: ignore[operator]
        bound = "at least" if low_allowed else "greater than"
        raise InputError(f"sweep axis {name}: has to be {bound} {low:g}, not {value!r}")
    most = {"delay": MAX_DELAY, "rate": _FASTEST_HZ}.get(name, math.inf)
    if value > most:  # type: ignore[operator]
        raise InputError(f"sweep axis {name}: has to be at most {most:g}, not {value!r}")
    if name == "counts" and value != int(value):
        raise InputError(f"sweep axis counts: has to be a whole number, not {value!r}")


def settings_at(base: Settings, point: Point) -> Settings:
    """Return the settings of one strike: those of `base`, changed as the point says.

    The axes of the wall, stiffness and damping, are not applied. Raises ConfigError.
    """
    values = {**{name: given[0] for name, given in DEFAULTS.items()}, **point}
    settings = base.model_copy(update={"schedule": (), "sweep": {}})
    if settings.simulation is None:
        raise ConfigError("[simulation] is missing: there is no drive to simulate")
    for name, change in _CHANGES.items():
        if name in values:
            settings = change(settings, values[name])
    keys = {k: v for k, v in values.items() if k not in NAMED}
    settings = _with_keys(settings, {k: v for k, v in keys.items() if not _of_the_model(k)})
    assert settings.simulation is not None
    if values["servo"] == "ideal":
        settings = settings.with_ideal_servo()
    model = law_model(settings, str(values["model"]), float(values["model_error"]))
    settings = settings.model_copy(update={"mechanics": model})
    if values["model"] == "matched" and "operator.adapt" not in keys:
        # It knows the operator already.
        operator = settings.operator.model_copy(update={"adapt": False})
        settings = settings.model_copy(update={"operator": operator})
    settings = _with_keys(settings, {k: v for k, v in keys.items() if _of_the_model(k)})
    settings = _with_known_delay(settings, float(values["delay_error"]))
    strike = (float(values[n]) for n in ("speed", "phase", "start", "press", "press_torque"))
    return strike_settings(settings, *strike)


def _with_known_delay(settings: Settings, error: float) -> Settings:
    """Tell the laws the delay of the loop, unless they have one, with an error [cycles]."""
    delay = settings.estimator.delay_cycles
    if delay is None:
        delay = loop_delay(settings)
    if not 0.0 <= delay + error <= MAX_DELAY:
        raise ConfigError(
            f"sweep axis delay_error: {error:g} makes D = {delay + error:g}; it has to be between "
            f"0 and {MAX_DELAY}"
        )
    known = {"delay_cycles": delay + error, "measure_delay": False}
    return settings.model_copy(update={"estimator": settings.estimator.model_copy(update=known)})


def _of_the_model(key: str) -> bool:
    return key.startswith("mechanics.")


def _with_keys(settings: Settings, keys: Mapping[str, Any]) -> Settings:
    if not keys:
        return settings
    try:
        return with_overrides(settings, keys)
    except ConfigError as error:
        raise ConfigError(f"sweep axis {error}") from None


def _with_rate(settings: Settings, rate: Value) -> Settings:
    return _with_keys(settings, {"bus.cycle_s": 1.0 / float(rate)})


def _with_delay(settings: Settings, delay: Value) -> Settings:
    """Set D: from 1 on with a synchronous RPDO, below with one that acts on reception.

    The laws reckon with the same D.
    """
    synchronous = float(delay) >= 1.0
    return _with_keys(
        settings,
        {
            "drive.torque_pdo": "sync" if synchronous else "immediate",
            "simulation.torque_delay_cycles": float(delay) - (1.0 if synchronous else 0.0),
            "estimator.delay_cycles": float(delay),
            "estimator.measure_delay": False,
        },
    )


def _with_objects(settings: Settings, objects: Mapping[str, int], **more: Any) -> Settings:
    assert settings.simulation is not None
    update = {"objects": {**settings.simulation.objects, **objects}, **more}
    return settings.model_copy(update={"simulation": settings.simulation.model_copy(update=update)})


def _with_counts(settings: Settings, counts: Value) -> Settings:
    return _with_objects(settings, {"0x608F:01": int(counts), "0x608F:02": 1})


def _with_torque_step(settings: Settings, step: Value) -> Settings:
    """Change the rated torque, and keep the limits, which are in per mille of it, in N·m."""
    assert settings.simulation is not None
    scales = cached_servo_scales(settings)
    rated = round(1e6 * float(step))
    if rated < 1 or abs(rated * 1e-6 - float(step)) > 1e-12:
        raise ConfigError(f"sweep axis torque_step: {step} N·m: give it in whole µN·m")
    per_mille = min(round(scales.torque_limit_per_mille * scales.rated_torque_mnm / rated), 32767)
    rated = round(rated * MILLI_NM / (settings.drive.rated_torque_unit_nm or MILLI_NM))
    peak = settings.simulation.peak_torque_nm or 3e-3 * scales.rated_torque_mnm
    objects = {"0x6076": rated} | {f"0x{index:04X}": per_mille for index in TORQUE_LIMITS}
    return _with_objects(settings, objects, peak_torque_nm=peak)


def _with_servo(settings: Settings, name: Value) -> Settings:
    servo = SERVOS.get(str(name))
    return with_overrides(settings, servo.keys) if servo else settings


def _with_friction(settings: Settings, coulomb: Value) -> Settings:
    keys = {"coulomb_nm": float(coulomb), "stiction_nm": BREAKAWAY * float(coulomb)}
    return with_overrides(settings, {f"simulation.{key}": value for key, value in keys.items()})


def _with_breakaway(settings: Settings, ratio: Value) -> Settings:
    assert settings.simulation is not None  # nothing else is swept
    stiction = float(ratio) * settings.simulation.coulomb_nm
    return with_overrides(settings, {"simulation.stiction_nm": stiction})


def _with_operator(settings: Settings, name: Value) -> Settings:
    return with_overrides(settings, OPERATORS[str(name)].keys)


#: In the order in which they are applied, before any key of the configuration.
_CHANGES: dict[str, Callable[[Settings, Value], Settings]] = {
    "law": lambda settings, law: with_law(settings, str(law)),
    "rate": _with_rate,
    "delay": _with_delay,
    "counts": _with_counts,
    "torque_step": _with_torque_step,
    "operator": _with_operator,
    "servo": _with_servo,
    "friction": _with_friction,
    "breakaway": _with_breakaway,
}
