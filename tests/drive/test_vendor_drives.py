"""The configurations of config/drives/, each on a simulated drive with that vendor's dictionary."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from commands import Record, command
from rig import Loop, Rig, RigFactory

from canwall import config
from canwall.bench.soft_wall import soft_stiffness, soft_torque
from canwall.config import Settings
from canwall.drive import DriveError, set_up

EDS = Path(__file__).parents[3] / "shared" / "vendor-eds"
DRIVES = config.shipped("config/drives/epos4.toml").parent


@dataclass(frozen=True)
class Drive:
    """A configuration, its dictionary, and what the master is to find."""

    name: str
    eds: str
    watchdog: str
    rated_torque_nm: float
    evidence: str


FOUND = [
    Drive("epos4", "maxon_epos4_0x1018.eds", "consumer heartbeat", 0.637, "lists it"),
    Drive("elmo", "elmo_gold.dcf", "none", 0.637, "lists it"),
    Drive("nanotec", "nanotec_C5-E-2-09.eds", "consumer heartbeat", 0.637, "lists it"),
    Drive("ipos", "technosoft_iPOS.D.v1.04.eds", "life guarding", 0.637, "when it was tried"),
    Drive("ingenia", "ingenia_eve-net-c_1.8.1.eds", "RPDO event timer", 1.0, "when it was tried"),
]


@pytest.fixture(params=FOUND, ids=lambda drive: drive.name)
def drive(request: pytest.FixtureRequest) -> Drive:
    found: Drive = request.param
    if not (EDS / found.eds).is_file():
        pytest.skip(f"{EDS} has no {found.eds}")
    return found


def settings_of(drive: Drive, **overrides: object) -> Settings:
    given = {key.replace("__", "."): value for key, value in overrides.items()}
    return config.load(DRIVES / f"{drive.name}.toml", {"drive.eds": EDS / drive.eds} | given)


@pytest.fixture
def rig(drive: Drive, make_rig: RigFactory) -> Rig:
    return make_rig(settings_of(drive))


def stiff() -> dict[str, object]:
    """The wall of config/sim.toml in place of the soft one of the file."""
    own = config.load(config.shipped("config/sim.toml"))
    return {
        "wall__stiffness_nm_per_rad": own.wall.stiffness_nm_per_rad,
        "limits__torque_nm": own.limits.torque_nm,
    }


def sync(rig: Rig) -> None:
    """One SYNC, and all that comes of it."""
    rig.inject(0x80, b"")
    while rig.link.serve(0.002):
        pass


def test_every_configuration_is_tested() -> None:
    assert {path.stem for path in DRIVES.glob("*.toml")} == {drive.name for drive in FOUND}


def test_what_the_master_finds(drive: Drive, rig: Rig) -> None:
    setup = rig.set_up()
    assert setup.mode is not None
    assert setup.mode.number == 10
    assert drive.evidence in setup.mode.why
    assert setup.watchdog.kind == drive.watchdog
    assert [field.index for field in setup.tpdo.fields] == [0x6064, 0x6041, 0x6077]
    assert [field.index for field in setup.rpdo.fields] == [0x6040, 0x6071]
    assert setup.torque_limit_nm >= rig.settings.limits.torque_nm
    assert setup.notes == ()
    assert rig.node.restore() == []


def test_scales_are_those_of_the_motion(drive: Drive, rig: Rig) -> None:
    """The master reads the first position as the one at which the simulated handle rests."""
    assert rig.settings.simulation is not None
    units = rig.set_up().units
    assert units.rated_torque_nm == pytest.approx(drive.rated_torque_nm)
    sync(rig)
    rest = rig.settings.simulation.hand.rest_rad
    assert rig.node.read(0x6064) * units.rad_per_count == pytest.approx(rest, abs=1e-4)


def test_torque_moves_the_handle_by_as_much(drive: Drive, make_rig: RigFactory) -> None:
    """A free inertia under a held torque: position and torque in SI, against Newton."""
    free = {
        "simulation__ideal": True,
        "simulation__viscous_nm_s_per_rad": 0.0,
        "simulation__coulomb_nm": 0.0,
        "simulation__hand": {
            "strikes": 0,
            "inertia_kg_m2": 0.0,
            "damping_nm_s_per_rad": 0.0,
            "stiffness_nm_per_rad": 0.0,
        },
    }
    rig = make_rig(settings_of(drive, **free))
    assert rig.settings.simulation is not None
    units = rig.set_up().units
    node = rig.node
    for word in (0x06, 0x07, 0x0F):
        node.write(0x6040, 0, word)
    sync(rig)
    begun = node.read(0x6064) * units.rad_per_count
    per_mille, cycles, period = 100, 40, rig.settings.bus.cycle_s
    node.write(0x6071, 0, per_mille)
    for _ in range(cycles):  # a torque that comes by SDO acts at once
        sync(rig)
    moved = node.read(0x6064) * units.rad_per_count - begun
    acceleration = per_mille * units.nm_per_mille / rig.settings.simulation.inertia_kg_m2
    assert moved == pytest.approx(0.5 * acceleration * (cycles * period) ** 2, rel=1e-3)


def test_strikes_come_out_as_on_our_own_drive(drive: Drive, make_rig: RigFactory) -> None:
    # What a hand tells of mass and delay depends on the steps of the torque, and one drive has its
    # own: there nothing is to be found.
    steps = drive.name == "ingenia"
    plain = {"operator__adapt": False, "estimator__force_walk_nm_per_sqrt_s": 0.2} if steps else {}
    keys = {key.replace("__", "."): value for key, value in plain.items()}
    own = Loop(make_rig(config.load(config.shipped("config/sim.toml"), keys)))
    theirs = Loop(make_rig(settings_of(drive, **stiff(), **plain)))
    for loop in (own, theirs):
        assert loop.run(700).trips == []
    ours, others = own.rows(), theirs.rows()
    if steps:
        impulses = [np.cumsum(rows["torque_applied"]) * 1e-3 for rows in (ours, others)]
        assert others["position_rad"] == pytest.approx(ours["position_rad"], abs=2.5e-4)
        assert impulses[1] == pytest.approx(impulses[0], abs=5e-4)
        return
    for column in ("position_rad", "torque_applied"):
        assert others[column] == pytest.approx(ours[column], abs=1e-9)


@pytest.mark.slow
def test_run(drive: Drive, tmp_path: Path) -> None:
    """Four strikes through the command, by the name of the configuration: nothing chatters."""
    eds, folder = EDS / drive.eds, tmp_path / "run"
    done = command("run", drive.name, "--eds", eds, "--restore", "--output", folder)
    assert done.returncode == 0, done.stderr
    assert "guard" not in done.stderr
    strikes = Record(folder).summary["strikes"]
    assert [strike["chatter"] for strike in strikes] == [False] * 4
    assert max(strike["contacts"] for strike in strikes) <= 2


def test_first_wall_is_soft_by_the_rule(drive: Drive) -> None:
    settings = settings_of(drive)
    mechanics, cycle_s = settings.mechanics, settings.bus.cycle_s
    inertia, viscous = mechanics.inertia_kg_m2, mechanics.viscous_nm_s_per_rad
    assert settings.wall.stiffness_nm_per_rad == soft_stiffness(inertia, viscous, cycle_s)
    assert settings.limits.torque_nm == soft_torque(drive.rated_torque_nm)
    assert settings.schedule == ()


def test_maxon_counts_the_rated_torque_in_micro(make_rig: RigFactory) -> None:
    drive = FOUND[0]
    if not (EDS / drive.eds).is_file():
        pytest.skip(f"{EDS} has no {drive.eds}")
    settings = settings_of(drive)
    rig = make_rig(settings)
    assert rig.node.read(0x6076) == 637_000
    unsaid = settings.drive.model_copy(update={"rated_torque_unit_nm": None})
    with pytest.raises(DriveError, match=r"give drive\.rated_torque_unit_nm \(1e-6 if"):
        set_up(rig.node, unsaid, settings.bus, settings.limits.torque_nm, False)


def test_wall_that_ends_while_the_handle_turns(drive: Drive, make_rig: RigFactory) -> None:
    """No ramp of the drive's own turns the handle on."""
    ends_at = 690
    loop = Loop(make_rig(settings_of(drive, wall__law="standard", **stiff())))
    outcome = loop.run(ends_at)
    position, period = loop.rows()["position_rad"], loop.rig.settings.bus.cycle_s
    assert abs(position[ends_at] - position[ends_at - 1]) / period > 1.0
    assert (outcome.trips, outcome.disabled) == ([], True)


@pytest.mark.parametrize("name", ["elmo", "nanotec"])
def test_profile_torque(name: str, make_rig: RigFactory) -> None:
    """The two dictionaries that have both modes."""
    drive = next(found for found in FOUND if found.name == name)
    if not (EDS / drive.eds).is_file():
        pytest.skip(f"{EDS} has no {drive.eds}")
    plain = stiff() | {"wall__law": "standard"}
    cst = Loop(make_rig(settings_of(drive, **plain)))
    pt = Loop(make_rig(settings_of(drive, **plain, drive__mode="pt")))
    for loop in (cst, pt):
        assert loop.run(700).trips == []
    assert pt.setup.mode is not None
    assert pt.setup.mode.number == 4
    # The slope is so steep that the torque follows within the cycle.
    torques = [loop.rows()["torque_applied"][:700] for loop in (pt, cst)]
    assert (torques[0] == torques[1]).all()
    assert abs(torques[0]).max() > 0.5


@pytest.mark.slow
def test_file_that_is_not_there_says_how_to_give_it() -> None:
    done = command("run", DRIVES / "epos4.toml")
    assert done.returncode == 2
    assert "correct drive.eds, or give --eds" in done.stderr
