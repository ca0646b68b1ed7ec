"""The main job of tests/vcan: two strikes, one by each law, in a quarter of config/sim.toml's time.

As a program it leaves the record of the embedded bus in a folder, which a guest is given: its host
makes that ten times faster.
"""

import sys
import tempfile
from pathlib import Path

from commands import config_file

from canwall import config
from canwall.run import run

DURATION_S = 1.1

#: Changes of config/sim.toml, and of config/vcan.toml.
CHANGES = {
    "duration_s = 4.2": f"duration_s = {DURATION_S}",
    "interval_s = 1.0": "interval_s = 0.5",
    "press_s = 0.5": "press_s = 0.2",
    "at_s = 1.1": "at_s = 0.6",
}


def run_embedded(folder: Path) -> None:
    """Leave a record of the job with the drive on the bus inside the program."""
    with tempfile.TemporaryDirectory() as work:
        settings = config.load(config_file(Path(work) / "main_job.toml", CHANGES))
        run(settings, folder)


if __name__ == "__main__":
    run_embedded(Path(sys.argv[1]))
