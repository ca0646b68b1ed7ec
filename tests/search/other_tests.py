"""Modules of other folders of tests, which the search uses: to be imported before them."""

import sys
from pathlib import Path

_TESTS = Path(__file__).parents[1]

sys.path += [str(_TESTS), *(str(_TESTS / folder) for folder in ("run", "simdrive"))]
