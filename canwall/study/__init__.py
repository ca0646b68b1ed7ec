"""Walls judged by a person at the handle: staircases, alternating laws, comparisons, dialogue."""

from canwall.study.pairs import Trial, balanced_trials
from canwall.study.psychometric import Psychometric, Share, fit_psychometric, share_of
from canwall.study.session import Session, Verdict
from canwall.study.staircase import (
    Staircase,
    next_wall,
    run_alternating,
    run_staircases,
    stiffness_limits,
)
from canwall.study.terminal import SessionEndedError, Terminal

__all__ = [
    "Psychometric",
    "Session",
    "SessionEndedError",
    "Share",
    "Staircase",
    "Terminal",
    "Trial",
    "Verdict",
    "balanced_trials",
    "fit_psychometric",
    "next_wall",
    "run_alternating",
    "run_staircases",
    "share_of",
    "stiffness_limits",
]
