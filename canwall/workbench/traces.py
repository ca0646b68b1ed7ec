"""Ball of the source's figures, and the traces drawn of its motion.

All figures use one ball: 1 kg dropped from 12 m onto 1 N/m under 1 m/s², sampled every 0.25 s
(θ = 0.25). Contacts have about 14 periods, few enough to see the held force as stairs.
"""

from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from canwall.workbench.ball import Ball
from canwall.workbench.bounces import Bounces, continuous_between
from canwall.workbench.figure_page import REFERENT, RENDERED, SAMPLES, stairs

Array = NDArray[np.float64]

BALL = Ball(stiffness=1.0, mass=1.0, gravity=1.0, height=12.0, period=0.25)
#: Time covered by the figures of a few bounces [s].
SHORT_S = 45.0
#: Points per period at which the motion is drawn.
POINTS = 20

#: Labels of the axes.
TIME, POSITION = "time t [s]", "height y, −f/K [m]"


def drop_ball(law: str, seconds: float = SHORT_S, height: float = BALL.height) -> Bounces:
    """Drop the ball of the figures from a height [m] onto a floor rendered by a law."""
    periods = round(seconds / BALL.period)
    return Bounces.on(replace(BALL, height=height, periods=periods), law)


@dataclass(frozen=True)
class Traces:
    """Motion, held force and continuous referent over a range of samples."""

    t: Array
    y: Array
    force: Array
    referent: Array
    at_sample: NDArray[np.int64]

    @classmethod
    def of(cls, bounces: Bounces, samples: slice | None = None) -> "Traces":
        """Trace the samples from samples.start to samples.stop, both included; None: all."""
        t, y = bounces.between(POINTS)
        fine = slice(None)
        if samples is not None:
            fine = slice(samples.start * POINTS, samples.stop * POINTS + 1)
        force = np.append(np.repeat(bounces.force[:-1], POINTS), bounces.force[-1])
        at_sample = (np.arange(len(t)) % POINTS == 0).astype(np.int64)
        referent = continuous_between(bounces.ball, POINTS)
        return cls(t[fine], y[fine], force[fine], referent[fine], at_sample[fine])

    def columns(self) -> dict[str, Array | NDArray[np.int64]]:
        """Return the columns of the CSV file."""
        return {
            "t [s]": self.t,
            "at a sample [0 or 1]": self.at_sample,
            "y rendered [m]": self.y,
            "y continuous [m]": self.referent,
            "f held [N]": self.force,
            # 0.0 − 0.0 has no sign.
            "-f/K [m]": 0.0 - self.force / BALL.stiffness,
        }

    def draw(self, axes: Axes, samples: bool) -> None:
        """Draw referent, rendered motion and force, with the samples if asked for."""
        axes.axhline(0.0, color="0.6", lw=0.8)
        axes.plot(self.t, self.y, color=RENDERED, lw=2.4, label="sampled-data floor")
        # Dashed over solid, so that both are visible where they agree.
        axes.plot(self.t, self.referent, color=REFERENT, lw=1.0, ls="--", label="continuous floor")
        if samples:
            at = self.at_sample == 1
            axes.plot(self.t[at], self.y[at], "o", color=SAMPLES, ms=4.0, label="samples")
        stairs(axes, self.t, -self.force / BALL.stiffness, "held force, −f/K")
        axes.margins(x=0.01)


def around(contact: slice) -> slice:
    """Return a contact with a few samples of flight on either side."""
    return slice(contact.start - 3, contact.stop + 2)
