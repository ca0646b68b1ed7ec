"""Report of an identification: lines of text, a fragment of TOML, JSON, a picture."""

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from canwall.config import Settings
from canwall.extras import is_installed
from canwall.figure_style import COLOURS, DPI, PAGE_IN, STYLE
from canwall.identify.estimates import Estimate, ServoFit
from canwall.identify.hand import HandFit
from canwall.identify.session import Identified, Measured
from canwall.record import RecordError, refuse_taken

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

#: Deviation of the inertia or of 0x6077 that is said to be one.
_DEVIATES = 0.1
#: Length of the moving average with which 0x6077 is compared [cycles].
_SLOW_CYCLES = 200
#: Part of the cycle above which the lag of the drive costs stiffness and is called slow.
_SLOW = 0.15


def report_lines(found: Identified, settings: Settings, inertia: float | None = None) -> list[str]:
    """Return what was found, a line for each quantity with its 95 % interval.

    `inertia` is the true one [kg·m²], if it is known: it gives the scale of the torque constant.
    """
    if found.hand is not None:
        return _hand_lines(found.hand)
    servo, measured = _of_servo(found)
    lines = [
        _line("inertia", servo.inertia, "kg·m²"),
        _line("viscous friction", servo.viscous, "N·m·s/rad"),
        _line("Coulomb friction", servo.coulomb, "N·m"),
        _line("  forwards", servo.forward, "N·m"),
        _line("  backwards", servo.backward, "N·m"),
        _stiction_line(found),
        _cogging_line(servo),
        _line("delay and lag", servo.total, "cycles"),
        _line("  delay", servo.delay, "cycles, the drive's own cycle included"),
        _line("  lag of the current loop", servo.lag, f"s, {_bandwidth_text(servo)}"),
    ]
    if servo.shaft is None:
        lines.append("shaft: rigid as far as the data tell")
    else:
        lines += [
            _line("resonance of the shaft", servo.shaft.hz, "Hz"),
            _line("  damping ratio", servo.shaft.damping_ratio, ""),
            _line("  inertia of load/rotor", servo.shaft.ratio, ""),
        ]
    residuals = servo.residuals
    correlation = ", ".join(f"{value:+.2f}" for value in residuals.correlation)
    lines += [
        f"encoder: step {measured.step:.3g} rad",
        f"residuals: {residuals.rms:.2f} steps r.m.s. (0.29: quantisation alone), "
        f"{'white' if residuals.white else 'not white: the intervals allow for it'}; "
        f"autocorrelation {correlation}; {residuals.explained:.4%} explained; "
        f"{residuals.left_out:.1%} of the data left out",
    ]
    return lines + remarks(found, settings, inertia)


def remarks(found: Identified, settings: Settings, inertia: float | None = None) -> list[str]:
    """Return what is out of the ordinary."""
    servo, measured = _of_servo(found)
    said = []
    if inertia is not None:
        scale = Estimate(
            inertia / servo.inertia.value, inertia * servo.inertia.half / servo.inertia.value**2
        )
        said.append(_line("torque constant, true/assumed", scale, ""))
        if abs(scale.value - 1.0) > max(_DEVIATES, scale.half):
            said.append(
                f"the torque is {scale.value:.2f} times the commanded one: look to the rated "
                f"torque (0x6076, drive.rated_torque_nm); until then the values here, in commanded "
                f"torque, are right for the laws"
            )
    else:
        ratio = servo.inertia.value / settings.mechanics.inertia_kg_m2
        if abs(ratio - 1.0) > _DEVIATES:
            said.append(
                f"the inertia is {ratio:.2f} times that of [mechanics]: if that one is known well, "
                f"the torque constant is off by {1.0 / ratio:.2f}; --inertia tells"
            )
    gain = torque_actual_gain(measured, servo)
    if gain is not None and abs(gain - 1.0) > _DEVIATES:
        said.append(f"0x6077 shows {gain:.2f} times the commanded torque")
    own = servo.lag.value / measured.period
    if own > _SLOW:
        said.append(
            f"the current loop is slow: its lag is {own:.2f} of a cycle, which a law has to know"
        )
    return said


def torque_actual_gain(measured: Measured, servo: ServoFit) -> float | None:
    """Return 0x6077 over the commanded torque, None if the drive does not report it.

    Slow torques are compared: a moving average makes lags small.
    """
    actual, sent = measured.torque_actual, measured.torque
    if np.array_equal(actual[1:], sent[:-1]) or not np.any(actual):
        return None
    window = np.hanning(_SLOW_CYCLES)
    late = round(servo.total.value)
    shown = np.convolve(actual[late:], window, "valid")
    wanted = np.convolve(sent[: len(sent) - late], window, "valid")
    return float(shown @ wanted / (wanted @ wanted))


def toml_fragment(found: Identified) -> str:
    """Return what was found as sections of a configuration."""
    if found.hand is not None:
        return ""
    servo, _ = _of_servo(found)
    lines = [
        "[mechanics]               # the free handle; a hand adds to it",
        f"inertia_kg_m2 = {servo.inertia.value:.4g}",
        f"viscous_nm_s_per_rad = {max(servo.viscous.value, 0.0):.3g}",
        f"coulomb_nm = {max(servo.coulomb.value, 0.0):.3g}",
    ]
    if servo.shaft is not None:
        rotor = servo.inertia.value / (1.0 + servo.shaft.ratio.value)
        lines += [
            f"shaft_hz = {servo.shaft.hz.value:.1f}",
            f"shaft_damping_ratio = {max(servo.shaft.damping_ratio.value, 0.0):.3g}",
            f"rotor_inertia_kg_m2 = {rotor:.3g}",
        ]
    lines += ["", "[drive]"]
    if lag_is_known(servo):
        lines.append(f"current_bandwidth_hz = {_bandwidth_hz(servo.lag.value):.0f}")
        delay = servo.delay.high
    else:
        lines.append("current_bandwidth_hz = 0   # not told apart from the delay, which has it")
        delay = servo.total.high
    lines += [
        "drive_cycle_s = 0.0        # not told apart from the delay, which has it",
        "",
        "[estimator]",
        f"delay_cycles = {delay:.3f}      # upper end of the interval: too little costs more",
    ]
    return "\n".join(lines) + "\n"


def lag_is_known(servo: ServoFit) -> bool:
    """Return True if the lag of the current loop differs from none."""
    return servo.lag.low > 0.0


def refuse_report(folder: Path) -> None:
    """Raise ConfigError for a folder that holds a report already, before anything moves."""
    refuse_taken(folder / f"identify.{ending}" for ending in ("txt", "json", "toml", "png"))


def write_report(found: Identified, settings: Settings, inertia: float | None = None) -> list[Path]:
    """Write identify.txt, .toml, .json and .png into the folder of the record; return the paths.

    There is no picture without the packages of the extra `plot`.

    Raises RecordError if they cannot be written.
    """
    folder = found.result.folder.path
    paths = [folder / f"identify.{ending}" for ending in ("txt", "json")]
    try:
        lines = report_lines(found, settings, inertia)
        paths[0].write_text("\n".join(lines) + "\n", encoding="utf-8")
        text = json.dumps(json_content(found), indent=2, ensure_ascii=False)
        paths[1].write_text(text + "\n", encoding="utf-8")
        if found.servo is None:
            return paths
        paths.append(folder / "identify.toml")
        paths[-1].write_text(toml_fragment(found), encoding="utf-8")
        if is_installed("plot"):
            paths.append(folder / "identify.png")
            draw(found, paths[-1])
    except OSError as error:
        raise RecordError(f"{folder}: {error.strerror}") from None
    return paths


def _of_servo(found: Identified) -> tuple[ServoFit, Measured]:
    assert found.servo is not None
    assert found.measured is not None
    return found.servo, found.measured


def _line(name: str, estimate: Estimate, unit: str) -> str:
    """Return a line with the value and its interval."""
    low, high = estimate.low, estimate.high
    return f"{name}: {estimate.value:.4g} {unit}".rstrip() + f" [{low:.4g}, {high:.4g}]"


def _hand_lines(hand: HandFit) -> list[str]:
    return [
        _line("inertia of the operator", hand.inertia, "kg·m²"),
        _line("damping of the operator", hand.damping, "N·m·s/rad"),
        _line("stiffness of the operator", hand.stiffness, "N·m/rad"),
        f"residuals: {hand.explained:.1%} of the motion explained",
    ]


def _stiction_line(found: Identified) -> str:
    if found.stiction is None:
        return "stiction: the handle did not break loose often enough to tell"
    return _line("stiction", found.stiction, "N·m")


def _cogging_line(servo: ServoFit) -> str:
    place, torque = servo.cogging
    amplitude = 0.5 * float(np.ptp(torque))
    power = np.abs(np.fft.rfft(torque * np.hanning(len(torque)), 8 * len(torque)))
    power[:16] = 0.0
    span = (place[1] - place[0]) * 8 * len(torque)
    per_rev = 2.0 * math.pi * int(np.argmax(power)) / span
    return f"cogging: {amplitude:.3g} N·m in amplitude, most of it {per_rev:.1f} times a revolution"


def _bandwidth_hz(lag: float) -> float:
    return 1.0 / (2.0 * math.pi * lag)


def _bandwidth_text(servo: ServoFit) -> str:
    if not lag_is_known(servo):
        return "not told apart from none"
    return f"{_bandwidth_hz(servo.lag.value):.0f} Hz"


def json_content(found: Identified) -> dict[str, Any]:
    """Return the content of identify.json."""
    source = found.hand if found.hand is not None else found.servo
    content: dict[str, Any] = {}
    parts = dict(vars(source))
    if found.servo is not None and found.servo.shaft is not None:
        parts |= {f"shaft_{name}": value for name, value in vars(found.servo.shaft).items()}
    if found.stiction is not None:
        parts["stiction"] = found.stiction
    for name, value in parts.items():
        if isinstance(value, Estimate):
            content[name] = {"value": value.value, "interval": [value.low, value.high]}
    if found.servo is not None:
        residuals = found.servo.residuals
        content["cogging"] = found.servo.cogging.tolist()
        content["residuals"] = {
            "rms_steps": residuals.rms,
            "explained": residuals.explained,
            "autocorrelation": residuals.correlation.tolist(),
            "white": residuals.white,
        }
    return content


def draw(found: Identified, path: Path) -> None:
    """Draw measured and modelled motion, what is left, cogging, and the whole record."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    servo, measured = _of_servo(found)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(PAGE_IN, 6.0), layout="constrained", dpi=DPI)
        (motion, left), (cogging, whole) = figure.subplots(2, 2)
        _draw_motion(motion, left, servo, measured)
        place, torque = servo.cogging
        cogging.plot(place, torque * 1e3, color=COLOURS[0])
        cogging.set(title="cogging over position", xlabel="position [rad]", ylabel="torque [mN·m]")
        time = np.arange(len(measured.position)) * measured.period
        whole.plot(time, measured.position, color=COLOURS[0], lw=0.6)
        whole.set(title="the whole record", xlabel="time [s]", ylabel="position [rad]")
        figure.savefig(path)


def _draw_motion(motion: "Axes", left: "Axes", servo: ServoFit, measured: Measured) -> None:
    time, position, model = servo.shown
    begin = time - time[0]
    # The mean speed hides what the torques do.
    mean = np.polyval(np.polyfit(begin, position, 1), begin)
    motion.plot(
        begin * 1e3, (position - mean) * 1e3, ".", ms=3.5, color=COLOURS[4], label="measured"
    )
    motion.plot(begin * 1e3, (model - mean) * 1e3, lw=0.9, color="k", label="model")
    motion.set(
        title="position without its mean speed", xlabel="time [ms]", ylabel="position [mrad]"
    )
    motion.legend()
    left.plot(begin * 1e3, (position - model) / measured.step, ".", ms=3, color=COLOURS[4])
    left.axhline(0.5, color="black", lw=0.8, ls="--")
    left.axhline(-0.5, color="black", lw=0.8, ls="--", label="half a step of the encoder")
    left.set(
        title="measured minus model", xlabel="time [ms]", ylabel="position [steps of the encoder]"
    )
    left.legend(loc="upper left", frameon=True, edgecolor="none")
