"""The doctor's look at a drive that is not enabled: nodes, identity, set-up, limits, budget."""

import math

from canwall.analysis.analytic_limits import stable_stiffness
from canwall.bench.budget import USABLE, cycle_budget
from canwall.bench.findings import DIFFERENT_FILE, OWN_FILE, Findings
from canwall.bench.scan import scan_nodes
from canwall.bench.soft_wall import WORST_DELAY, with_fingertip
from canwall.config import Drive as DriveSettings
from canwall.config import Settings
from canwall.drive import DriveNode, DriveSetup, Link, PdoLayout
from canwall.drive import objects as od
from canwall.drive.identity import Identity, identify


def describe_nodes(link: Link, settings: Settings, findings: Findings) -> None:
    """Describe the nodes on the bus, and whether the configured one is among them."""
    nodes = scan_nodes(link)
    wanted = settings.drive.node_id
    for node in nodes:
        parts = [node.name or "", node.profile, node.nmt_state or "", node.drive_state or ""]
        mark = ", drive.node_id" if node.node_id == wanted else ""
        findings.add("bus", f"node {node.node_id}{mark}", ", ".join(part for part in parts if part))
    if nodes and wanted not in [node.node_id for node in nodes]:
        drives = [str(node.node_id) for node in nodes if node.is_drive]
        do = f"drives are {', '.join(drives)}: correct drive.node_id" if drives else ""
        found = f"node {wanted} (drive.node_id) is not among them"
        findings.add("bus", "nodes", found, well=False, do=do or "switch the drive on")


def describe_identity(node: DriveNode, settings: Settings, findings: Findings) -> Identity:
    """Return what the drive says it is. Raises DriveError if it is absent, or has a twin."""
    node.wait_until_present(settings.drive.wait_s)
    identity = identify(node)
    node.refuse_twin()
    findings.add("drive", "0x1000, 0x1018", str(identity))
    for doubt in identity.doubts:
        found, asks, whose = doubt.partition(": is it this ")
        do = OWN_FILE if asks else ""
        # Another revision may do; another product has other objects.
        findings.add("drive", "file", found, well=not whose.startswith("drive"), do=do)
    return identity


def describe_setup(
    node: DriveNode, setup: DriveSetup, identity: Identity, settings: Settings, findings: Findings
) -> None:
    """Describe the set-up of a drive: mode, units, PDOs, watchdog."""
    findings.add("mode", "0x6060", str(setup.mode))
    if setup.scales is not None:
        for found, whence in setup.scales.sources:
            findings.add("units", whence, found)
        _compare_rated_torque(node, settings.drive, findings)
    findings.add("PDO", "TPDO, with every SYNC", _shown(setup.tpdo))
    effect = "at the next SYNC" if setup.synchronous else "on reception"
    findings.add("PDO", f"RPDO, effective {effect}", _shown(setup.rpdo))
    findings.add("PDO", "SYNC", f"{setup.sync_cob_id:#x}")
    for note in setup.notes:
        if note not in identity.doubts:
            findings.add("notes", "drive", note, do=OWN_FILE if DIFFERENT_FILE in note else "")
    watchdog = setup.watchdog
    present = watchdog.kind != "none"
    findings.add(
        "watchdog",
        "set",
        str(watchdog),
        well=present or settings.drive.accept_no_watchdog,
        do=""
        if present
        else "--accept-no-watchdog accepts a drive that nothing stops if its "
        "master dies; better a drive, or a firmware, that has one",
    )
    for passed_over in watchdog.passed_over:
        findings.add("watchdog", "passed over", passed_over)


def _compare_rated_torque(node: DriveNode, settings: DriveSettings, findings: Findings) -> None:
    """Doubt a rated torque that was given and is far from 0x6076, in whatever unit that is."""
    given = settings.rated_torque_nm
    if given is None or not node.has(od.MOTOR_RATED_TORQUE):
        return
    value = node.read(od.MOTOR_RATED_TORQUE)
    units = (settings.rated_torque_unit_nm or 1e-3, 1e-6)
    if any(0.5 * given <= value * unit <= 2.0 * given for unit in units):
        return
    findings.add(
        "units",
        "0x6076",
        f"{value}, {value * units[0]:g} N·m, but drive.rated_torque_nm is {given:g}",
        do="see which of them is on the motor's plate: all torques are parts of it",
    )


def describe_limits(
    node: DriveNode, setup: DriveSetup, settings: Settings, findings: Findings
) -> None:
    """Compare the limits and the wall with what drive and handle are."""
    units, limits, wall = setup.units, settings.limits, settings.wall
    torque = limits.torque_nm
    part = torque / units.rated_torque_nm
    enough = setup.torque_limit_nm >= torque
    more = f", and more than the drive gives, {setup.torque_limit_nm:g} N·m"
    do = ""
    if not enough:
        do = "lower limits.torque_nm, or raise 0x6072 and 0x6073 (drive.parameters)"
    elif part > 1.0:
        do = "begin with a tenth of the rated torque"
    findings.add(
        "limits",
        "limits.torque_nm",
        f"{torque:g} N·m is {part:.0%} of the rated torque{'' if enough else more}",
        well=enough,
        do=do,
    )
    here = node.read(od.POSITION_ACTUAL_VALUE) * units.rad_per_count
    low, high = limits.position_rad
    inside = low <= here <= high
    findings.add(
        "limits",
        "limits.position_rad",
        f"the handle is at {here:.3f} rad, the limits are {low:g} and {high:g}",
        well=inside,
        do="" if inside else "turn the handle there, or move limits.position_rad and the wall",
    )
    depth = (wall.position_rad - here) * wall.orientation
    if depth > 0.0:
        findings.add(
            "limits",
            "wall.position_rad",
            f"the handle is {depth:.3f} rad inside the wall",
            do="turn it out before a run; within run.ramp_in_s the force fades in",
        )
    mass, viscous = with_fingertip(settings.mechanics)
    stable = stable_stiffness(mass, viscous, 0.0, settings.bus.cycle_s, WORST_DELAY)
    findings.add(
        "limits",
        "wall.stiffness_nm_per_rad",
        f"{wall.stiffness_nm_per_rad:g} N·m/rad; the plain wall is stable up to {stable:.2g} in "
        f"the lightest hand, at a delay of {WORST_DELAY} periods",
        do="begin with a tenth of that" if wall.stiffness_nm_per_rad > stable else "",
    )


def describe_budget(
    node: DriveNode, setup: DriveSetup, settings: Settings, findings: Findings
) -> None:
    """Describe the budget of all that the drive sends with a SYNC, needed or not."""
    bus, budget = settings.bus, cycle_budget(node, setup, settings.bus)
    for line in budget.lines:
        frame = line.frame
        over = f"{line.earliest_s * 1e6:.0f} to {line.latest_s * 1e6:.0f} µs"
        findings.add(
            "bus budget",
            f"{frame.name} {frame.can_id:#05x}, {frame.length} bytes",
            f"at most {line.bits} bits, {line.share:.1%} of the cycle; over {over} after the SYNC "
            f"begins, by the bus alone",
        )
    findings.add(
        "bus budget",
        f"cycle of {bus.cycle_s * 1e3:g} ms at {bus.bitrate / 1000:g} kbit/s",
        f"{budget.share:.1%} used of {USABLE:.0%} that leave room for SDO, EMCY and heartbeats; "
        f"the highest rate that fits is {budget.highest_hz:g} Hz",
        well=budget.fits,
        do=""
        if budget.fits
        else f"set bus.cycle_s to {math.ceil(1e5 / budget.highest_hz) / 1e5:g} or more, or raise "
        f"the bit rate of all nodes",
    )


def _shown(pdo: PdoLayout) -> str:
    return f"{pdo.cob_id:#x}: {', '.join(str(field) for field in pdo.fields)}"
