"""Identification of a servo, and of the operator who holds its handle, from their motion."""

from canwall.identify.estimates import Estimate, ServoFit, Shaft, UntellingDataError
from canwall.identify.fit import fit_servo
from canwall.identify.hand import HandFit, fit_hand
from canwall.identify.report import (
    json_content,
    refuse_report,
    report_lines,
    toml_fragment,
    write_report,
)
from canwall.identify.session import Identified, identify, with_simulated_hand_still

__all__ = [
    "Estimate",
    "HandFit",
    "Identified",
    "ServoFit",
    "Shaft",
    "UntellingDataError",
    "fit_hand",
    "fit_servo",
    "identify",
    "json_content",
    "refuse_report",
    "report_lines",
    "toml_fragment",
    "with_simulated_hand_still",
    "write_report",
]
