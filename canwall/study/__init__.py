"""Walls judged by a person at the handle: staircases, alternating laws, and the dialogue."""

from canwall.study.session import Session, Verdict
from canwall.study.staircase import Staircase, run_alternating, run_staircases, stiffness_limits
from canwall.study.terminal import SessionEndedError, Terminal

__all__ = [
    "Session",
    "SessionEndedError",
    "Staircase",
    "Terminal",
    "Verdict",
    "run_alternating",
    "run_staircases",
    "stiffness_limits",
]
