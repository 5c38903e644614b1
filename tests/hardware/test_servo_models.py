"""Servo models: their control tables, chains of them and mixed ones, and finding them."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

import dexctl
from dexctl.cli import commands, main
from dexctl.exceptions import InvalidInput, UnknownName
from hardware import models
from hardware import registers as R  # noqa: N812 (a table of names)
from hardware.bus import Bus
from hardware.calibration import Calibration
from hardware.discovery import discover
from hardware.emulator import Emulator
from hardware.exceptions import ServoError
from hardware.hand import ServoHand
from hardware.limits import Limits
from hardware.models import MODELS, XC330_T288, XL330_M288, XL430_W250, XM430_W210, ServoModel
from hardware.motions import Sine
from hardware.registers import OperatingMode, Register
from hardware.runner import Runner
from hardware.state_machine import State, Torque
from hardware.units import SimGains, to_servo, to_sim

pytest.importorskip("dynamixel_sdk", reason="needs the extra 'hardware'")

PATIENT = Limits(watchdog=2.4, command_age=2.0, state_age=3.0, overruns=(1.0, 1.0))
GAINS = SimGains(3.0, 0.15, 0.4, 0.6)

# Rows of the maker's tables: address, size, unit, lowest and highest, default; by hand.
BY_HAND = {
    "XC330-T288": {
        "model_number": (0, 2, 1.0, None, 1220),
        "temperature_limit": (31, 1, 1.0, (0, 100), 70),
        "max_voltage_limit": (32, 2, 0.1, (55, 140), 140),
        "min_voltage_limit": (34, 2, 0.1, (55, 140), 55),
        "current_limit": (38, 2, 1e-3, (0, 910), 910),
        "velocity_limit": (44, 4, 0.0239808, (0, 2047), 320),
        "shutdown": (63, 1, 1.0, (0, 255), 52),
        "velocity_i_gain": (76, 2, 1.0, (0, 16383), 1200),
        "velocity_p_gain": (78, 2, 1.0, (0, 16383), 40),
        "position_p_gain": (84, 2, 1.0, (0, 16383), 900),
        "goal_current": (102, 2, 1e-3, (-910, 910), 0),
        "present_current": (126, 2, 1e-3, None, 0),
        "present_velocity": (128, 4, 0.0239808, None, 0),
        "present_position": (132, 4, 2 * np.pi / 4096, None, 0),
    },
    "XL330-M288": {
        "model_number": (0, 2, 1.0, None, 1200),
        "max_voltage_limit": (32, 2, 0.1, (31, 70), 70),
        "min_voltage_limit": (34, 2, 0.1, (31, 70), 35),
        "current_limit": (38, 2, 1e-3, (0, 1750), 1750),
        "velocity_limit": (44, 4, 0.0239808, (0, 2047), 445),
        "shutdown": (63, 1, 1.0, (0, 255), 53),
        "velocity_i_gain": (76, 2, 1.0, (0, 16383), 1600),
        "velocity_p_gain": (78, 2, 1.0, (0, 16383), 180),
        "position_p_gain": (84, 2, 1.0, (0, 16383), 400),
        "goal_current": (102, 2, 1e-3, (-1750, 1750), 0),
    },
    "XL430-W250": {
        "model_number": (0, 2, 1.0, None, 1060),
        "temperature_limit": (31, 1, 1.0, (0, 100), 72),
        "max_voltage_limit": (32, 2, 0.1, (60, 140), 140),
        "min_voltage_limit": (34, 2, 0.1, (60, 140), 60),
        "velocity_limit": (44, 4, 0.0239808, (0, 1023), 265),
        "velocity_i_gain": (76, 2, 1.0, (0, 16383), 1000),
        "position_d_gain": (80, 2, 1.0, (0, 16383), 4000),
        "position_p_gain": (84, 2, 1.0, (0, 16383), 640),
        "present_load": (126, 2, 1e-3, (-1000, 1000), 0),
    },
    "XM430-W350": {
        "model_number": (0, 2, 1.0, None, 1020),
        "current_limit": (38, 2, 2.69e-3, (0, 1193), 1193),
        "velocity_limit": (44, 4, 0.0239808, (0, 1023), 200),
        "position_p_gain": (84, 2, 1.0, (0, 16383), 800),
    },
    "XM430-W210": {
        "model_number": (0, 2, 1.0, None, 1030),
        "velocity_limit": (44, 4, 0.0239808, (0, 1023), 330),
        "temperature_limit": (31, 1, 1.0, (0, 100), 80),
    },
}


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_tables_against_the_makers(model: ServoModel) -> None:
    own = {register.name: register for register in model.registers}
    for name, (address, size, unit, span, default) in BY_HAND[model.name].items():
        found = own[name]
        assert (found.address, found.size, found.default) == (address, size, default), name
        assert found.scale == pytest.approx(unit, rel=1e-5), name
        assert span is None or (found.low, found.high) == span, name
    addresses = [register.address for register in model.registers]
    assert len(set(addresses)) == len(addresses)
    for before, after in zip(model.registers, model.registers[1:], strict=False):
        assert before.end <= after.address, (before, after)
    for register in model.registers:
        assert register.low <= register.default <= register.high, register


def test_an_xl430_has_no_current() -> None:
    names = {register.name for register in XL430_W250.registers}
    assert not names & {"current_limit", "goal_current", "present_current"}
    assert XL430_W250.register(R.GOAL_CURRENT) is R.GOAL_PWM
    assert XL430_W250.register(R.PRESENT_CURRENT) is models.PRESENT_LOAD
    with pytest.raises(InvalidInput, match="an XC330-T288 has no register present_load"):
        XC330_T288.register(models.PRESENT_LOAD)
    with pytest.raises(UnknownName, match="unknown servo model 'AX-12'; known: XM430-W210"):
        models.model("AX-12")


def test_gains_by_hand() -> None:
    # 1.15 N m/A x 1 mA / 1.534 mrad / 128 = 5.857e-3 N m/rad for each count of P
    gains = to_servo(GAINS, XC330_T288.loop, XC330_T288.register(R.CURRENT_LIMIT))
    assert gains == (512, 3201, 348, 25)
    # 1.4 N m x 1/885 / 1.534 mrad / 128 = 8.056e-3; 0.4 N m of 1.4 is 253 of 885
    gains = to_servo(GAINS, XL430_W250.loop, XL430_W250.register(R.CURRENT_LIMIT))
    assert gains == (372, 2327, 253, 25)
    for model in MODELS:
        limit = model.register(R.CURRENT_LIMIT)
        gains = to_servo(GAINS, model.loop, limit)
        assert to_sim(gains, model.loop).kp == pytest.approx(3.0, rel=5e-3)
        assert gains.current * limit.scale * model.torque_constant == pytest.approx(0.4, rel=1e-2)
    with pytest.raises(InvalidInput, match=r"torque_limit is 0.8; expected 0 to 0.6195 N m"):
        to_servo(GAINS._replace(torque_limit=0.8), XL330_M288.loop,
                 XL330_M288.register(R.CURRENT_LIMIT))  # fmt: skip


@contextmanager
def chain(names: tuple[str, ...], count: int = 15, **settings: object) -> Iterator[Emulator]:
    with Emulator(count, models=names, start=[0.1] * count, **settings) as emulator:
        yield emulator


MIXED = ("XC330-T288",) * 6 + ("XL430-W250",) * 4 + ("XM430-W350",) * 2 + ("XL330-M288",) * 3


@pytest.mark.parametrize(
    "names",
    [*(pytest.param((model.name,), marks=pytest.mark.slow) for model in MODELS), MIXED],
)
def test_a_run_on_each_model_and_on_a_mixed_chain(
    names: tuple[str, ...], dex5: dexctl.HandModel
) -> None:
    with chain(names) as emulator, Bus(emulator.port, range(1, 16), timeout=0.2) as bus:
        hand = ServoHand(bus, dex5, limits=replace_torque(PATIENT), gains=GAINS)
        hand.arm()
        own = [models.model(name) for name in (names if len(names) > 1 else names * 15)]
        assert hand.models == own
        ids = range(1, 16)
        mode = bus.read(R.OPERATING_MODE, ids).raw
        assert mode.tolist() == [int(model.mode) for model in own]
        # what bounds the torque, as the servo itself says it
        drive = bus.read(R.GOAL_CURRENT, ids)
        limits = [0.4 / (m.torque_constant * m.register(R.GOAL_CURRENT).scale) for m in own]
        np.testing.assert_array_equal(drive.raw, np.round(limits))
        np.testing.assert_allclose(drive.value * hand.torque_constant, 0.4, rtol=1e-2)
        # pushed against a stop, each tells the torque that it makes: at most the limit
        emulator.block(2, 9, 14)
        for _ in range(60):
            hand.sample()
            hand.write(np.full(15, 0.5))
            hand.step()
        torque = hand.sample().torque
        stuck = np.isin(np.arange(1, 16), (2, 9, 14))
        np.testing.assert_allclose(torque[stuck], 0.4, rtol=0.02)
        free = np.minimum(0.5, dex5.upper)[~stuck]
        np.testing.assert_allclose(hand.sample().q[~stuck], free, atol=0.02)
        true = np.array(emulator.state()["torque"])
        np.testing.assert_allclose(torque[stuck], true[stuck], rtol=0.02)
        assert hand.disarm().state is Torque.OFF
        emulator.reset()
        runner = Runner(hand, Sine(dex5), needs_tactile=False)
        report = runner.run(0.5)
        assert (report.outcome, report.torque) == (State.IDLE, Torque.OFF)


def replace_torque(limits: Limits) -> Limits:
    from dataclasses import replace

    return replace(limits, torque_limit=0.4)


def test_warnings_are_the_models_own(dex5: dexctl.HandModel) -> None:
    with chain(MIXED) as emulator, Bus(emulator.port, range(1, 16), timeout=0.2) as bus:
        hand = ServoHand(bus, dex5, limits=PATIENT)
        hand.configure()
        assert hand.hot.tolist() == [60] * 6 + [62] * 4 + [70] * 2 + [60] * 3
        assert hand.voltage[:, 0].tolist() == [6.5, 12.0]
        assert hand.voltage[:, -1].tolist() == [3.7, 6.0]
        for _ in range(3):
            health = hand.health()
        low, high = hand.voltage
        assert ((health.voltage >= low) & (health.voltage <= high)).all()
        np.testing.assert_allclose(health.voltage[[0, 6, 10, 12]], [11.1, 11.1, 12.0, 5.0])


def test_a_leap_hand_of_sixteen() -> None:
    hand = leap()
    with (
        chain(("XC330-T288",), 16, ids=tuple(range(16))) as emulator,
        Bus(emulator.port, range(16), timeout=0.2) as bus,
    ):
        servos = ServoHand(bus, hand, Calibration.nominal(hand, range(16)), limits=PATIENT)
        report = Runner(servos, Sine(hand), needs_tactile=False).run(0.3)
        assert (report.outcome, report.torque) == (State.IDLE, Torque.OFF)
        assert {model.name for model in servos.models} == {"XC330-T288"}


def leap() -> dexctl.HandModel:
    """The LEAP hand of the menagerie, where there is one."""
    path = Path(os.environ.get("DEXCTL_MENAGERIE", "")) / "leap_hand_mjx" / "leap_rh.xml"
    if not path.is_file():
        pytest.skip("needs the LEAP hand: DEXCTL_MENAGERIE")
    hand = dexctl.HandModel.load(path)
    assert hand.nq == 16
    return hand


def test_registers_at_other_addresses_are_read_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """No model known has them elsewhere; one that has is asked in a packet of its own."""
    from dataclasses import replace

    with chain(("XM430-W210",), 4) as emulator, Bus(emulator.port, range(1, 5), timeout=0.2) as bus:
        bus.identify()
        moved = dict(XM430_W210.table)
        # what another model keeps in place of the present position: here, the goal
        moved["present_position"] = replace(R.GOAL_POSITION, name="present_position")
        bus.models[3] = replace(XM430_W210, table=moved)
        bus._grouped.clear()
        bus.write(R.GOAL_POSITION, [1.0, 2.0, 3.0, 4.0])
        speed, position = bus.read_many([R.PRESENT_VELOCITY, R.PRESENT_POSITION])
        assert position.ok.all() and speed.ok.all()
        np.testing.assert_allclose(position.value[2], 3.0, atol=1e-3)
        assert abs(position.value[[0, 1, 3]] - [1.0, 2.0, 4.0]).min() > 0.1
        emulator.silence(3)
        _, position = bus.read_many([R.PRESENT_VELOCITY, R.PRESENT_POSITION])
        assert position.missing == (3,)


def test_a_model_that_nobody_has_described(dex5: dexctl.HandModel) -> None:
    with chain(("XM430-W210",)) as emulator, Bus(emulator.port, range(1, 16), timeout=0.2) as bus:
        real = bus.read

        def other(register: Register, ids=None):
            found = real(register, ids)
            if register is R.MODEL:
                found.raw[4] = 350
            return found

        bus.read = other
        with pytest.raises(ServoError, match=r"servo 5 has model 350; expected one of XM430-W210"):
            bus.identify()


def test_an_xl430_knows_no_current_modes() -> None:
    with chain(("XL430-W250",), 1) as emulator, Bus(emulator.port, [1], timeout=0.2) as bus:
        with pytest.raises(ServoError, match="refuses"):
            bus.write_checked(R.OPERATING_MODE, float(OperatingMode.CURRENT), 1)
        with pytest.raises(ServoError, match="read-only, or locked"):
            bus.write_checked(R.CURRENT_LIMIT, 0.5, 1)  # asked as what it is not: no such address
        bus.identify()
        bus.write_checked(R.CURRENT_LIMIT, 0.5, 1)
        assert bus.read(R.PWM_LIMIT).raw[0] == 442


# -- finding them ---------------------------------------------------------------------------------


def test_port_and_speed_are_found() -> None:
    with (
        chain(("XM430-W210",), 2) as other,
        chain(MIXED, ids=(7, *range(20, 34)), baudrate=1_000_000) as emulator,
    ):
        other.silence(1, 2)
        # as patient as a busy machine asks for
        found = discover([other.port, emulator.port], (4_000_000, 1_000_000), timeout=0.2)
        assert (found.port, found.baudrate) == (emulator.port, 1_000_000)
        assert sorted(found.servos) == [7, *range(20, 34)]
        assert [found.servos[i].model for i in (7, 25, 26, 30, 33)] == [
            1220,
            1060,
            1060,
            1020,
            1200,
        ]
        with pytest.raises(
            InvalidInput, match=r"no servo answers on .* at 9600 bit/s; check power"
        ):
            discover([emulator.port], (9600,))
    with pytest.raises(InvalidInput, match="any port: there is none"):
        discover([])


@pytest.fixture
def group(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("hardware", "hardware.cli:COMMANDS", commands.GROUP)
    monkeypatch.setattr(commands, "entry_points", lambda group: [point])


def test_check_finds_all_of_it(
    group: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ids = (0, 2, *range(10, 23))
    with (
        chain(("XM430-W210",), 1) as other,
        chain(MIXED, ids=ids, baudrate=57_600) as emulator,
    ):
        other.silence(1)
        ports = [other.port, emulator.port]
        monkeypatch.setattr("hardware.cli.options.ports", lambda: ports)
        code = main(["hardware", "check", "--json", "--patience", "10"])
        said = json.loads(capsys.readouterr().out)
        assert (said["port"], said["baudrate"]) == (emulator.port, 57_600)
        assert [row["servo"] for row in said["servos"]] == list(ids)
        assert [row["model_name"] for row in said["servos"]] == list(MIXED)
        slow = [p for p in said["problems"] if "ms a cycle" in p]  # a slow line is one
        assert said["problems"] == slow and code == bool(slow)
        limits = [row["torque_limit_nm"] for row in said["servos"]]
        np.testing.assert_allclose(limits, 0.5, rtol=1e-2)


def test_check_names_servos_that_the_hand_has_no_joint_for(
    group: None, capsys: pytest.CaptureFixture[str]
) -> None:
    with chain(("XL330-M288",), 16) as emulator:
        words = ["hardware", "check", "--port", emulator.port, "--patience", "10"]
        assert main(words) == 1
        said = " ".join(capsys.readouterr().out.split())
    assert "servo 16 on this line: the hand has no joint for it" in said
    assert "4000000 bit/s" in said and "XL330-M288" in said


def test_emulated_models_are_an_option(
    group: None, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = ["hardware", "check", "--emulate", "--patience", "10", "--json"]
    assert main([*words, "--servo-model", "XL330-M288", "--torque-limit", "0.4"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert {row["model"] for row in said["servos"]} == {1200}
    assert main([*words, "--servo-model", "AX-12"]) == 2
    assert "unknown servo model 'AX-12'" in capsys.readouterr().err
    assert main(["hardware", "check", "--servo-model", "XL330-M288"]) == 2
    assert "--servo-model: servos say themselves what they are" in capsys.readouterr().err
    assert main([*words, "--servo-model", "XL330-M288", "--torque-limit", "1"]) == 2
    assert "torque_limit is 1.0; expected 0 to 0.6195 N m" in capsys.readouterr().err
