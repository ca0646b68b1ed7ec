"""The search, see `__main__`: modules of other folders of tests, which it uses."""

import sys
from pathlib import Path

sys.path += [str(Path(__file__).parents[1] / folder) for folder in ("run", "simdrive")]
