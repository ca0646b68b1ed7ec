"""Record of a run: one row per cycle, every frame, and a summary.

The cycle writes into a ring in shared memory and never waits for a disk. A separate process
(`writer`) empties the ring into the run's folder and completes the files even if the master dies.
"""

from canwall.record.columns import ROW, TIMING_COLUMNS, Phase, column_table
from canwall.record.folder import RecordError, RunFolder, numbers, read_signals, refuse_taken
from canwall.record.mailbox import Mailbox
from canwall.record.recorder import Recorder, Stream, start_recorders
from canwall.record.ring import FRAME, Ring
from canwall.record.target import parse_target

__all__ = [
    "FRAME",
    "ROW",
    "TIMING_COLUMNS",
    "Mailbox",
    "Phase",
    "RecordError",
    "Recorder",
    "Ring",
    "RunFolder",
    "Stream",
    "column_table",
    "numbers",
    "parse_target",
    "read_signals",
    "refuse_taken",
    "start_recorders",
]
