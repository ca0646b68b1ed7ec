"""The search, see `__main__`."""

import other_tests  # noqa: F401
