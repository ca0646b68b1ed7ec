"""Colours and line styles of the figures, for readers who see fewer colours, or none."""

import itertools

import numpy as np
import pytest
from colour_vision import APART, VISIONS, distance, lab, least_distance, seen

from canwall.figure_style import (
    CHATTER,
    CHATTER_AREA,
    COLOURS,
    QUIET_AREA,
    REFERENT,
    line_style,
)


@pytest.mark.parametrize(
    ("colour", "vision", "expected"),
    [
        # colorspacious 1.1.2, its CVD space (Machado et al.) of severity 100, as linear RGB.
        ("#D55E00", "protanopia", [0.2191, 0.1642, 0.0000]),
        ("#D55E00", "deuteranopia", [0.3407, 0.2616, 0.0000]),
        ("#D55E00", "tritanopia", [0.8268, 0.0520, 0.0805]),
        ("#0072B2", "protanopia", [0.0859, 0.1765, 0.4603]),
        ("#0072B2", "deuteranopia", [0.0433, 0.1343, 0.4386]),
        ("#0072B2", "tritanopia", [0.0000, 0.2223, 0.2516]),
        ("#009E73", "protanopia", [0.3248, 0.2859, 0.1639]),
        ("#009E73", "deuteranopia", [0.2552, 0.2381, 0.1808]),
        ("#009E73", "tritanopia", [0.0000, 0.3436, 0.2885]),
        ("#CC79A7", "protanopia", [0.2140, 0.2578, 0.3950]),
        ("#CC79A7", "deuteranopia", [0.2983, 0.3160, 0.3755]),
        ("#CC79A7", "tritanopia", [0.6744, 0.1877, 0.2525]),
    ],
)
def test_simulated_vision(colour: str, vision: str, expected: list[float]) -> None:
    np.testing.assert_allclose(seen(colour, vision), expected, atol=2e-4)


def test_lab_of_known_colours() -> None:
    np.testing.assert_allclose(lab(seen("#ffffff", "normal")), [100.0, 0.0, 0.0], atol=1e-6)
    # sRGB's red: Lindbloom's calculator.
    np.testing.assert_allclose(lab(seen("#ff0000", "normal")), [53.24, 80.09, 67.20], atol=0.05)


@pytest.mark.parametrize("vision", VISIONS)
def test_colours_can_be_told_apart(vision: str) -> None:
    for one, other in itertools.combinations((CHATTER, *COLOURS, REFERENT), 2):
        assert distance(one, other, vision) >= APART, (one, other)
    for colour in (CHATTER, *COLOURS, REFERENT):
        assert distance(colour, "white", vision) >= 2.0 * APART, colour


def test_areas_can_be_told_apart() -> None:
    assert least_distance(QUIET_AREA, CHATTER_AREA) >= APART


def test_colours_that_cannot_be_told_apart_are_found() -> None:
    assert least_distance("#7B3294", "#004488") < APART  # protanopia
    assert least_distance("#009E73", "#999999") < APART  # deuteranopia


def test_lines_differ_without_colours() -> None:
    styles = [line_style(number) for number in range(24)]
    forms = [(str(style["ls"]), style["marker"]) for style in styles]
    assert all(forms[i] != forms[j] for i, j in itertools.combinations(range(8), 2))
    looks = [(style["color"], *form) for style, form in zip(styles, forms, strict=True)]
    assert len(set(looks)) == 24
