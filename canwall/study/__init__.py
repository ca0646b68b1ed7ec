"""Walls judged by a person at the handle: staircases, laws that alternate, and the questions."""

from canwall.study.session import Session, Verdict
from canwall.study.staircase import Staircase, alternating, limits, staircases
from canwall.study.terminal import SessionEndedError, Terminal

__all__ = [
    "Session",
    "SessionEndedError",
    "Staircase",
    "Terminal",
    "Verdict",
    "alternating",
    "limits",
    "staircases",
]
