"""A recorded run as DataFrames, an Arrow table and a figure."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from canwall.config import ConfigError, Settings
from canwall.config import load as load_settings
from canwall.extras import need
from canwall.record import RunFolder
from canwall.record.columns import UNITS
from canwall.record.summary import STRIKE_KEYS
from canwall.run import read_run

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False, eq=False)
class RecordedRun:
    """A run, as its folder has it.

    Attributes:
        folder: Folder of the record.
        table: The signals as an Arrow table, a row per SYNC; `unit` and `description` are in the
            metadata of its fields, `units` by column, as JSON, in that of its schema.
        summary: Content of summary.json.
        remarks: What the drive did not do as configured, what the guard saw, and how the run ended
            unless it did so by itself; a line each.
    """

    folder: Path
    table: "pa.Table" = field(hash=False)
    summary: dict[str, Any] = field(hash=False)
    remarks: tuple[str, ...]

    @classmethod
    def read(cls, folder: Path, remarks: tuple[str, ...] = ()) -> "RecordedRun":
        """Read the folder of a run; one that was cut off is completed first (`read_run`).

        Raises:
            canwall.errors.ConfigError: If the folder holds no record that can be used.
        """
        found = read_run(RunFolder(folder))
        remark = (found.remark,) if found.remark else ()
        return cls(folder, found.signals, found.summary, (*remarks, *remark))

    @cached_property
    def signals(self) -> "pd.DataFrame":
        """The signals, a row per SYNC; `signals.attrs["units"]` has the unit of each column."""
        need("sweep")
        signals = self.table.to_pandas()
        signals.attrs["units"] = {name: UNITS.get(name, "") for name in signals.columns}
        return signals

    @cached_property
    def strikes(self) -> "pd.DataFrame":
        """The strikes on the wall, a row each, in SI units (docs/formats.md)."""
        need("sweep")
        import pandas as pd

        strikes = self.summary["strikes"]
        return pd.DataFrame(strikes, columns=None if strikes else list(STRIKE_KEYS))

    @cached_property
    def settings(self) -> Settings:
        """The configuration of the run, complete. Raises ConfigError if it cannot be read."""
        config = RunFolder(self.folder).config
        if not config.exists():
            raise ConfigError(
                f"{self.folder}: the record is incomplete: put back its {config.name}"
            )
        return load_settings(config)

    @property
    def chatter(self) -> bool:
        """True if any strike chattered."""
        return bool(self.summary["chatter"])

    @property
    def trips(self) -> list[str]:
        """Messages of what ended the run, empty if nothing did."""
        return list(self.summary["trips"])

    def plot(self) -> "Figure":
        """Draw the run as in run.png; return the figure, which notebooks display.

        Raises:
            canwall.errors.ConfigError: If the record is an older one that lacks a column.
        """
        need("plot")
        from canwall.library.figures import shown_in_notebooks
        from canwall.record import read_signals
        from canwall.record.pictures import DRAWN, run_figure

        signals = self.table
        if missing := set(DRAWN) - set(signals.column_names):
            read_signals(RunFolder(self.folder).signals, sorted(missing))
        return shown_in_notebooks(run_figure(signals, self.summary["strikes"]))

    def to_csv(self) -> list[Path]:
        """Write signals.csv and strikes.csv into the folder, for a spreadsheet; return their paths.

        The first line has names, and for the signals, in brackets, units.

        Raises:
            canwall.errors.RunFailedError: If a file cannot be written.
        """
        from canwall.library.export import write_csv

        return write_csv(self)

    def to_mat(self) -> Path:
        """Write run.mat into the folder, for MATLAB and Octave; return its path.

        It holds `signals`, a struct of columns; `units` and `descriptions` of these; `laws`, into
        which `signals.law` is an index from 1; `summary`; and `config`, the configuration as text.

        Raises:
            canwall.errors.RunFailedError: If the file cannot be written.
        """
        from canwall.library.export import write_mat

        return write_mat(self)

    def __repr__(self) -> str:
        strikes = self.summary["strikes"]
        chattering = sum(bool(strike["chatter"]) for strike in strikes)
        end = "".join(f"; {trip}" for trip in self.trips)
        return (
            f"<RecordedRun {self.folder}: {', '.join(self.summary['law'])}; "
            f"{self.table.num_rows} cycles, {chattering} of {len(strikes)} strikes chatter{end}>"
        )
