"""The doctor: from an unknown drive to 'ready', or to a list of what to fix.

Bus and nodes are looked at first. The drive is then identified, set up as for a run, enabled with
zero torque, moved a little if that is asked for, and left alone to see its watchdog react. At the
end it is disabled, and everything that was changed is put back.
"""

from collections.abc import Callable
from contextlib import ExitStack

import can

from canwall.bench.adapter import adapter_reports
from canwall.bench.at_rest import (
    describe_budget,
    describe_identity,
    describe_limits,
    describe_nodes,
    describe_setup,
)
from canwall.bench.findings import Findings, noted
from canwall.bench.latency import measurement_settings
from canwall.bench.trial import Trial
from canwall.config import Settings
from canwall.drive import DriveError, DriveNode, Link, set_up
from canwall.eds import load_eds
from canwall.errors import first_of
from canwall.run import on_the_bus


def diagnose(
    settings: Settings,
    required: tuple[int, ...],
    announce: Callable[[str], None],
    findings: Findings,
    move: bool = False,
) -> None:
    """Open the bus of the configuration and examine it and the drive, as `examine` does.

    Raises:
        ConfigError: If the bus does not exist.
        DictionaryError: If the dictionary cannot be used.
    """
    load_eds(settings.drive.eds, settings.drive.node_id, required)
    for report in adapter_reports(settings.bus):
        findings.add("bus", report.what, report.found, report.well, report.do)
    with ExitStack() as stack:
        try:
            link = stack.enter_context(on_the_bus(measurement_settings(settings)))
        except (DriveError, can.CanError) as error:
            findings.add_trouble("bus", "other masters", str(error))
            return
        examine(link, settings, required, announce, findings, move)


def examine(
    link: Link,
    settings: Settings,
    required: tuple[int, ...],
    announce: Callable[[str], None],
    findings: Findings,
    move: bool = False,
) -> None:
    """Examine the nodes on a bus and the drive; announce gets each step before it is done.

    Whatever happens, torque is zero, the drive is disabled and put back at the end. What the drive
    or the bus fails at is a finding. Raises DictionaryError.

    Args:
        link: The bus.
        settings: Configuration of the bench.
        required: Objects that the dictionary has to have.
        announce: Called with each step.
        findings: Filled.
        move: Try the first motion as well.
    """
    settings = measurement_settings(settings)
    dictionary = load_eds(settings.drive.eds, settings.drive.node_id, required)
    errors = _ErrorFrames(link)
    node: DriveNode | None = None
    try:
        with noted(findings, "bus", "nodes"):
            announce("asking for the nodes on the bus")
            describe_nodes(link, settings, findings)
        node = DriveNode(link, settings.drive.node_id, dictionary, settings.drive.sdo_timeout_s)
        with noted(findings, "drive", "node"):
            identity = describe_identity(node, settings, findings)
            with noted(findings, "set-up", "drive"):
                announce("setting the drive up; nothing is enabled")
                # In doubt the doctor goes on: that there is no watchdog is a finding, not an end.
                lenient = settings.drive.model_copy(update={"accept_no_watchdog": True})
                limit = settings.limits.torque_nm
                setup = set_up(node, lenient, settings.bus, limit, real_time=True)
                describe_setup(node, setup, identity, settings, findings)
                describe_limits(node, setup, settings, findings)
                describe_budget(node, setup, settings, findings)
                Trial(node, setup, settings, announce, findings, move).make()
    finally:
        patience = f"{settings.drive.sdo_timeout_s:g} s for each if the drive does not answer"
        changes = 0 if node is None else node.changes
        announce(f"putting the drive back as it was: {changes} values, {patience}")
        failures = [] if node is None else node.restore()
        if failures:
            do = "switch the drive off and on: nothing was stored"
            findings.add("put back", "not done", first_of(failures), well=False, do=do)
        else:
            findings.add("put back", "changes", "all undone; nothing was stored")
        errors.describe(findings)


class _ErrorFrames:
    """Counter of error frames on a link."""

    def __init__(self, link: Link) -> None:
        self.count = 0
        link.on_error_frame = self.note

    def note(self, message: can.Message) -> None:
        self.count += 1

    def describe(self, findings: Findings) -> None:
        """Note the error frames of the examination."""
        if self.count:
            findings.add(
                "bus",
                "error frames",
                f"{self.count} during the examination",
                well=False,
                do="look to bit rate, cable and termination (60 Ω between CAN_H and CAN_L)",
            )
