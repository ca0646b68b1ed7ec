"""The ball of the source's figures, and what is drawn of its motion.

One ball for all of them: 1 kg dropped from 12 m onto 1 N/m under 1 m/s², sampled every 0.25 s
(θ = 0.25): contacts of some 14 periods, few enough for the held force to be seen as stairs.
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
#: What the figures of a few bounces cover [s].
SHORT_S = 45.0
#: Instants to the period at which the motion is drawn.
POINTS = 20

#: Labels of the axes.
TIME, POSITION = "time t [s]", "height y, held force as −f/K [m]"


def fall(law: str, seconds: float = SHORT_S, height: float = BALL.height) -> Bounces:
    """The ball of the figures on a floor rendered by that law."""
    periods = round(seconds / BALL.period)
    return Bounces.on(replace(BALL, height=height, periods=periods), law)


@dataclass(frozen=True)
class Traces:
    """What is drawn of a stretch of samples: motion, held force, continuous referent."""

    t: Array
    y: Array
    force: Array
    referent: Array
    at_sample: NDArray[np.int64]

    @classmethod
    def of(cls, bounces: Bounces, samples: slice | None = None) -> "Traces":
        """Of the samples from samples.start to samples.stop, both with; or of all."""
        t, y = bounces.between(POINTS)
        fine = slice(None)
        if samples is not None:
            fine = slice(samples.start * POINTS, samples.stop * POINTS + 1)
        force = np.append(np.repeat(bounces.force[:-1], POINTS), bounces.force[-1])
        at_sample = (np.arange(len(t)) % POINTS == 0).astype(np.int64)
        referent = continuous_between(bounces.ball, POINTS)
        return cls(t[fine], y[fine], force[fine], referent[fine], at_sample[fine])

    def columns(self) -> dict[str, Array | NDArray[np.int64]]:
        """For the CSV."""
        return {
            "t [s]": self.t,
            "at a sample [0 or 1]": self.at_sample,
            "y rendered [m]": self.y,
            "y continuous [m]": self.referent,
            "f held [N]": self.force,
            # Zero without a sign.
            "-f/K [m]": 0.0 - self.force / BALL.stiffness,
        }

    def draw(self, axes: Axes, samples: bool) -> None:
        """Referent dashed, rendered motion solid, force as stairs; where wanted its samples."""
        axes.axhline(0.0, color="k", lw=0.8)
        axes.plot(self.t, self.y, color=RENDERED, lw=2.4, label="sampled-data floor")
        # Dashed over solid: where the two agree, both are to be seen.
        axes.plot(self.t, self.referent, color=REFERENT, lw=1.0, ls="--", label="continuous floor")
        if samples:
            at = self.at_sample == 1
            axes.plot(self.t[at], self.y[at], "o", color=SAMPLES, ms=4.0, label="samples")
        stairs(axes, self.t, -self.force / BALL.stiffness, "held force, −f/K")
        axes.margins(x=0.01)


def around(contact: slice) -> slice:
    """A contact with a few samples of flight on either side."""
    return slice(contact.start - 3, contact.stop + 2)
