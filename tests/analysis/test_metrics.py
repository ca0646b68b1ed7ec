"""The metrics on signals whose answer is known, and against slower ways to the same number."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from canwall.analysis.metrics import (
    EVENTS_OF_CHATTER,
    QUIET_N,
    STRIKE_GAP_S,
    Chatter,
    Comparison,
    Ripple,
    StrikeContacts,
    amplitude_tolerance,
    bounces_more,
    chatter,
    contacts,
    energy_out,
    limit_cycle,
    moves_more,
    settled_stretch,
    strikes,
)

BOUNDED = settings(derandomize=True, deadline=None, max_examples=300)

Array = NDArray[np.float64]

PERIOD = 1e-3
COUNT = 5e-5
TOLERANCE = 6 * COUNT


def samples(*values: float) -> Array:
    return np.array(values, dtype=float)


# Energy


@BOUNDED
@given(st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(-5.0, 5.0)), min_size=1, max_size=30))
def test_energy_is_the_sum_of_force_times_way(signal: list[tuple[float, float]]) -> None:
    y, force = (np.array(column) for column in zip(*signal, strict=True))
    work = energy_out(y, force)
    assert work.shape == y.shape
    for j in range(len(y)):
        direct = math.fsum(force[i] * (y[i + 1] - y[i]) for i in range(j))
        assert work[j] == pytest.approx(direct, rel=0.0, abs=1e-12)


def test_energy_is_the_work_of_a_held_force() -> None:
    mass, viscous, push, stiffness = 0.2, 0.1, -3.0, 60.0
    period, n = 0.02, 60
    y, v, force, work = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    y[0], v[0] = 0.05, -1.0

    for j in range(n):
        force[j] = -stiffness * y[j] if y[j] < 0.0 else 0.0

        def motion(t: float, state: Array, held: float = force[j]) -> list[float]:
            speed = state[1]
            return [speed, (held + push - viscous * speed) / mass, held * speed]

        if j + 1 < n:
            state = [y[j], v[j], work[j]]
            end = solve_ivp(motion, (0.0, period), state, "DOP853", rtol=1e-12, atol=1e-13)
            y[j + 1], v[j + 1], work[j + 1] = end.y[:, -1]
    assert work.max() > 0.01
    np.testing.assert_allclose(energy_out(y, force), work, rtol=0.0, atol=1e-10)


def test_a_spring_held_from_sample_to_sample_gives_energy() -> None:
    y = 0.1 * np.sin(np.linspace(math.pi, 2.0 * math.pi, 20))
    force = np.where(y < 0.0, -50.0 * y, 0.0)
    work = energy_out(y, force)
    assert work[0] == 0.0
    assert work[10] < 0.0 < work[-1]


# Contacts and strikes


def test_a_contact_ends_with_the_first_cycle_after_it() -> None:
    y = samples(1, 1, -1, -1, 1, 1, 1)
    assert contacts(y, np.zeros(7)) == [slice(2, 5)]


def test_a_force_still_held_outside_belongs_to_the_contact() -> None:
    y = samples(1, -1, 1, 1, 1)
    force = samples(0, 2, 3, 0, 0)
    assert contacts(y, force) == [slice(1, 4)]
    # So all the work of the contact lies in it.
    (contact,) = contacts(y, force)
    work = energy_out(y, force)
    assert work[contact.stop - 1] - work[contact.start] == work[-1] == 4.0


def test_contacts_at_the_edges_of_the_record() -> None:
    y = samples(-1, 1, 1, -1, -1)
    assert contacts(y, np.zeros(5)) == [slice(0, 2), slice(3, 5)]


def test_no_contact() -> None:
    assert contacts(samples(0, 1, 2), np.zeros(3)) == []
    assert contacts(samples(), samples()) == []
    assert strikes([], PERIOD) == []


@BOUNDED
@given(st.lists(st.tuples(st.sampled_from([-1.0, 0.0, 1.0]), st.sampled_from([0.0, 2.0]))))
def test_every_touching_cycle_is_in_one_contact(signal: list[tuple[float, float]]) -> None:
    y = np.array([position for position, _ in signal])
    force = np.array([f for _, f in signal])
    found = contacts(y, force)
    inside = [j for j in range(len(signal)) if y[j] < 0.0 or force[j] != 0.0]
    covered = [j for c in found for j in range(c.start, c.stop)]
    assert [j for j in covered if j in inside] == inside
    for contact in found:
        rest = set(range(contact.start, contact.stop)) - set(inside)
        assert rest <= {contact.stop - 1}


def test_contacts_close_together_are_one_strike() -> None:
    gap = round(STRIKE_GAP_S / PERIOD)
    first, second, third = slice(10, 20), slice(30, 40), slice(41 + gap, 60 + gap)
    assert strikes([first, second, third], PERIOD) == [
        StrikeContacts(slice(10, 40), (first, second)),
        StrikeContacts(third, (third,)),
    ]
    exactly = slice(40 + gap, 60 + gap)
    assert strikes([second, exactly], PERIOD) == [
        StrikeContacts(slice(30, 60 + gap), (second, exactly))
    ]


def test_a_change_of_the_wall_begins_a_new_strike() -> None:
    first, second = slice(10, 20), slice(30, 40)
    for boundary in (20, 25, 30):
        found = strikes([first, second], PERIOD, samples(boundary))
        assert [s.cycles for s in found] == [first, second]
    for boundary in (5, 10, 31, 99):
        found = strikes([first, second], PERIOD, samples(boundary))
        assert [s.cycles for s in found] == [slice(10, 40)]


# Chatter


@pytest.mark.parametrize(
    ("stiffness", "tolerance"), [(1e6, 3e-4), (100.0, 6e-4), (0.0, 3e-4), (200.0, 3e-4)]
)
def test_tolerance_is_what_quantisation_explains(stiffness: float, tolerance: float) -> None:
    assert amplitude_tolerance(stiffness, count=5e-5, force_step=0.02) == pytest.approx(tolerance)


def pressing(seconds: float = 0.6) -> Array:
    """A referent that comes in, settles at −0.01 and goes out again."""
    t = np.arange(0.0, seconds, PERIOD)
    settling = -0.01 * (1.0 - np.exp(-t / 0.01))
    return np.where(t < seconds - 0.02, settling, settling + (t - seconds + 0.02))


def judged(y: Array, referent: Array | None) -> Chatter:
    return chatter(y, compared(referent), PERIOD, COUNT)


def compared(referent: Array | None) -> Comparison | None:
    return None if referent is None else Comparison(referent, TOLERANCE)


def oscillation(y: Array, amplitude: float, frequency: float = 20.0) -> Array:
    oscillating: Array = amplitude * np.sin(2.0 * math.pi * frequency * PERIOD * np.arange(len(y)))
    return oscillating


def test_a_settled_position_does_not_chatter() -> None:
    referent = pressing()
    rounded = np.round(referent / COUNT) * COUNT
    for y in (referent, rounded, referent + 5e-3 * (referent < -0.005)):
        verdict = judged(y, referent)
        assert not verdict.chatters
        assert "about the settled contact" in verdict.reason


@pytest.mark.parametrize(("share", "chatters"), [(0.9, False), (1.1, True), (5.0, True)])
def test_a_limit_cycle_chatters_beyond_the_tolerance(share: float, chatters: bool) -> None:
    referent = pressing()
    y = referent + oscillation(referent, share * TOLERANCE / 2.0)
    verdict = judged(y, referent)
    assert verdict.chatters is chatters
    assert "about the settled contact" in verdict.reason


def test_motion_of_the_referent_itself_is_no_chatter() -> None:
    own = pressing() + oscillation(pressing(), 0.4 * TOLERANCE)
    assert not judged(own, own).chatters
    # Twice that exceeds it by less than the tolerance.
    assert not judged(own + oscillation(own, 0.4 * TOLERANCE), own).chatters
    assert judged(own + oscillation(own, 0.6 * TOLERANCE), own).chatters


def test_late_to_rest_and_early_to_leave_is_no_chatter() -> None:
    referent = pressing()
    y = referent + oscillation(referent, 0.004) * np.exp(-np.arange(len(referent)) / 40.0)
    assert not judged(y, referent).chatters


def bouncing(bounces: int, every_s: float, seconds: float = 0.6) -> Array:
    """In and out `bounces` times with the given spacing, then resting well inside."""
    t = np.arange(0.0, seconds, PERIOD)
    inside = -0.01 * np.ones(len(t))
    for i in range(bounces):
        out = (t >= (i + 0.5) * every_s) & (t < (i + 1) * every_s)
        inside[out] = 0.01
    return inside


def test_bounces_that_the_referent_makes_too_are_no_chatter() -> None:
    referent = bouncing(4, 0.03)
    assert not judged(referent, referent).chatters
    # Having lost some energy it bounces as often, and earlier.
    assert not judged(bouncing(4, 0.025), referent).chatters


@pytest.mark.parametrize(("more", "chatters"), [(0, False), (1, False), (2, True), (3, True)])
def test_bounces_that_the_referent_does_not_make_are(more: int, chatters: bool) -> None:
    referent, y = bouncing(1, 0.03), bouncing(1 + more, 0.03)
    verdict = judged(y, referent)
    assert verdict.chatters is chatters  # a bounce is a break and a make
    if chatters:
        assert verdict.reason == f"{2 + 2 * more} makes and breaks within 200 ms, the referent 2"


def test_makes_and_breaks_are_compared_relatively() -> None:
    """25 against 21 is no chatter where no energy came out."""
    assert not bounces_more(25, 21, gives_energy=False)
    assert bounces_more(25, 21, gives_energy=True)
    assert bounces_more(27, 21, gives_energy=False)
    assert bounces_more(EVENTS_OF_CHATTER, 0, gives_energy=False)
    assert not bounces_more(2, 0, gives_energy=True)


@pytest.mark.parametrize("counts", [-3, 1, 7, 1000])
def test_a_motion_of_six_counts_is_what_quantisation_explains(counts: int) -> None:
    """As a difference of positions it may come out larger than six counts by a rounding."""
    count = 2.0 * math.pi / 131072
    tolerance = amplitude_tolerance(200.0, count, 1e-4)
    assert tolerance == 6.0 * count
    positions = np.arange(counts, counts + 200) * count
    assert np.any(positions[6:] - positions[:-6] > tolerance)
    for low, high in zip(positions[:-6], positions[6:], strict=True):
        assert not moves_more(high - low, 0.0, tolerance)
        assert moves_more(high + 0.5 * count - low, 0.0, tolerance)


@pytest.mark.parametrize("referent", [pressing(), None])
def test_a_ripple_that_is_felt_is_chatter(referent: Array | None) -> None:
    def felt(measured: float, own: float = 0.0) -> Chatter:
        ripple = Ripple(measured, own, ", by a sensor")
        return chatter(pressing(), compared(referent), PERIOD, COUNT, ripple=ripple)

    assert not felt(0.99 * QUIET_N).chatters
    assert not felt(0.5, 0.45).chatters
    assert not felt(math.nan).chatters
    verdict = felt(0.5)
    assert (verdict.chatters, verdict.by) == (True, "ripple")
    assert verdict.reason == (
        "felt ripple 0.5 N r.m.s. in 20–500 Hz, by a sensor, quiet up to 0.1 N"
    )


def test_bounces_far_apart_are_no_chatter() -> None:
    assert not judged(bouncing(4, 0.45, seconds=2.0), None).chatters


def test_without_a_referent_the_events_alone_are_judged() -> None:
    often = judged(bouncing(3, 0.03), None)
    assert often.chatters
    assert often.reason == "6 makes and breaks within 200 ms, without a referent"
    seldom = judged(bouncing(1, 0.03), None)
    assert not seldom.chatters
    assert "not judged" in seldom.reason


def test_a_last_bit_that_flickers_at_the_surface_is_no_event() -> None:
    counts = np.resize([0, -1, 1, 0, -1], 600)
    assert not judged(counts * COUNT, None).chatters
    assert judged(3 * counts * COUNT, None).chatters


def test_a_referent_without_loss_never_settles() -> None:
    referent = -0.01 + oscillation(np.zeros(600), 0.005)
    y = referent + oscillation(referent, 5 * TOLERANCE, 31.0)
    verdict = judged(y, referent)
    assert not verdict.chatters
    assert verdict.reason == "the referent never settles; amplitude not judged"


def test_a_rest_too_short_is_not_judged() -> None:
    referent = bouncing(0, 1.0, seconds=0.049)
    assert "never settles" in judged(referent + oscillation(referent, 0.005), referent).reason
    referent = bouncing(0, 1.0, seconds=0.1)
    assert judged(referent + oscillation(referent, 0.005, 50.0), referent).chatters


@pytest.mark.parametrize("n", [0, 1, 2, 5])
def test_hardly_a_record(n: int) -> None:
    y = -np.ones(n)
    assert not judged(y, y).chatters
    assert not judged(y, None).chatters


def settled_by_brute_force(referent: Array, tolerance: float) -> slice:
    best = slice(0, 0)
    for start in range(len(referent)):
        for stop in range(start + 1, len(referent) + 1):
            piece = referent[start:stop]
            settled = piece.max() < 0.0 and np.ptp(piece) <= tolerance
            if settled and stop - start > best.stop - best.start:
                best = slice(start, stop)
    return best


@BOUNDED
@given(
    st.lists(st.integers(-12, 1), max_size=25).map(lambda steps: np.array(steps) / 8.0),
    st.integers(0, 8).map(lambda steps: steps / 8.0),
)
def test_settled_stretch_is_the_longest_there_is(referent: Array, tolerance: float) -> None:
    found = slice(*settled_stretch(referent, tolerance))
    assert found == settled_by_brute_force(referent, tolerance)


@BOUNDED
@given(st.lists(st.floats(-1.0, 0.2), max_size=20).map(np.array), st.floats(0.0, 1.0))
def test_settled_stretch_of_any_signal(referent: Array, tolerance: float) -> None:
    found = slice(*settled_stretch(referent, tolerance))
    expected = settled_by_brute_force(referent, tolerance)
    assert found.stop - found.start == expected.stop - expected.start


# Limit cycle


@pytest.mark.parametrize("frequency", [7.0, 20.0, 33.3])
@pytest.mark.parametrize("phase", [0.0, 1.0, 4.0])
def test_limit_cycle_of_a_sine(frequency: float, phase: float) -> None:
    t = PERIOD * np.arange(3000)
    y = -0.2 + 0.03 * np.sin(2.0 * math.pi * frequency * t + phase)
    amplitude, found = limit_cycle(y, PERIOD)
    assert amplitude == pytest.approx(0.03, rel=0.01)
    assert found == pytest.approx(frequency, rel=0.01)


def test_no_limit_cycle() -> None:
    assert limit_cycle(np.full(100, -0.3), PERIOD) == (0.0, 0.0)
    assert limit_cycle(samples(), PERIOD) == (0.0, 0.0)
    assert limit_cycle(samples(-1.0), PERIOD) == (0.0, 0.0)
    amplitude, frequency = limit_cycle(np.linspace(-0.3, -0.1, 50), PERIOD)
    assert amplitude == pytest.approx(0.1)
    assert frequency == 0.0
