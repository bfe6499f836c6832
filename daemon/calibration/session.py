"""Taking a calibration's views with the rig: kept one by one, resumed after whatever broke off.

A session is a directory below `STATE/calibrations`: a frame set to which each view is added
durably as soon as it is taken, and `session.json`, which says what was planned. From the
directory a calibration can be repeated years later.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path
from types import MappingProxyType
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from core.errors import CalibrationError
from core.site import Site
from daemon.calibration.positions import ZERO, Limits, Position, planned_positions
from daemon.calibration.reference import take_reference
from daemon.calibration.view_check import ViewCheck, further_problems, settled_view_check
from daemon.durable import make_directory_durable, write_durable
from daemon.readings.sampler import Sampler
from daemon.slots.exposure import ExposureLoop, settle
from drivers.errors import DriverError
from drivers.frameset import (
    READING,
    TEMPERATURES,
    FrameRole,
    FrameSet,
    FrameSetRow,
    encode_png,
    read_frame_set,
    write_table,
)
from drivers.protocols import CapturedFrame, CapturedPair, Clock, FramePairSource, PanTiltHead, Role

FOLDER = "calibrations"
"""Below the state directory; one directory a session, named by its time in UTC."""
PLAN = "session.json"
RESUME_WITHIN = timedelta(hours=3)
"""An older session is not taken up again: the bridge may have moved its target since."""
TRIES = 3
"""How often a view is taken until both targets are seen well in it."""
SIMULATED_LENS_VIEWS = 12

OnStep = Callable[[str], None]
"""Called with what is being done, once for each view."""
OnTrouble = Callable[[str], None]
"""Called with what an engineer should know of a view, and what is done about it."""


@dataclass(frozen=True, slots=True)
class CalibrationDevices:
    """What a session works with."""

    site: Site
    source: FramePairSource
    head: PanTiltHead
    limits: Limits
    clock: Clock
    hold_board: Callable[[int | None], None] | None
    """Brings the board into pose n before the sub-camera, and back to its place with None;
    None for a rig whose board is in somebody's hand or bonded already."""
    exposure: ExposureLoop | None = None
    """What settles the light before the first view; then all are exposed alike. None: fixed."""
    sampler: Sampler | None = None
    """The site's sensors, which are read at the zero."""
    serials: Mapping[Role, str] = field(default_factory=dict)
    """The cameras' serial numbers, as far as they have one."""


class Plan(BaseModel):
    """`session.json`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    config_hash: str
    positions: tuple[Position, ...]
    state: Literal["taking", "taken"]
    exposures: dict[Role, tuple[float, float | None]] = {}
    """Exposure in us and gain in dB of all views, where they were settled by the light."""
    serials: dict[Role, str] = {}
    """Of the cameras that take the views."""


@dataclass(slots=True)
class Session:
    """A frame set in the making."""

    directory: Path
    plan: Plan
    rows: list[FrameSetRow]

    @property
    def has_reference(self) -> bool:
        """Whether the zero has been taken."""
        return any(row.role == "reference" for row in self.rows)

    @property
    def done(self) -> set[int]:
        """Numbers of the positions that have been taken."""
        return {int(row.extra["step"]) for row in self.rows if row.role == "rig"}

    def add(self, row: FrameSetRow) -> None:
        """Put a row into the table, whose images are on the disk."""
        self.rows.append(row)
        self.rows.sort(key=lambda row: row.slot_utc)  # lens views may have come by another clock
        write_table(self.directory, self.rows)

    def note(self, plan: Plan) -> None:
        """Change the plan on the disk, in one step."""
        self.plan = plan
        write_durable(self.directory / PLAN, plan.model_dump_json(indent=2).encode())


def unfinished(state: Path, config_hash: str, now_utc: datetime | None = None) -> Session | None:
    """Give the latest session that broke off, if it may be taken up again.

    It is of the same config, has its zero, and is younger than `RESUME_WITHIN` (None: of any
    age, as on a simulated clock).
    """
    for directory in sorted((state / FOLDER).glob("*/"), reverse=True):
        session = _read(directory)
        if session is None or session.plan.state == "taken":
            continue
        if session.plan.config_hash != config_hash or not session.has_reference:
            continue
        old = now_utc is not None and now_utc - session.rows[-1].slot_utc > RESUME_WITHIN
        return None if old else session
    return None


def _read(directory: Path) -> Session | None:
    try:
        plan = Plan.model_validate_json((directory / PLAN).read_bytes())
        rows = read_frame_set(directory).rows
    except (OSError, ValidationError, DriverError):
        return None  # not a session, or one that had nothing yet
    return Session(directory, plan, list(rows))


def serials_of(directory: Path) -> dict[Role, str]:
    """The cameras that took a session's views, as far as it tells."""
    try:
        plan = Plan.model_validate_json((directory / PLAN).read_bytes())
    except (OSError, ValidationError):
        return {}
    return plan.serials


def take_views(
    devices: CalibrationDevices,
    state: Path,
    config_hash: str,
    lens_views: FrameSet | None,
    resume: Session | None,
    on_step: OnStep,
    on_trouble: OnTrouble,
) -> Session:
    """Take what a calibration needs: lens views (given or taken), the zero, all positions.

    The rig ends where it began; after an error the head is halted, and stays where it is. Raises
    CalibrationError for what the first look shows, HardwareError, HeadError, DeviceError, OSError.
    """
    try:
        devices.head.move_to(*ZERO)
        if resume is None:
            session = _begin(devices, state, config_hash, lens_views, on_step, on_trouble)
        else:
            session = resume
            for role, exposure in session.plan.exposures.items():
                devices.source.set_exposure(role, *exposure)
            # Whether anything moved while nobody looked shows at the zero.
            _take_position(devices, session, len(session.plan.positions), ZERO, on_step, on_trouble)
        for number, position in enumerate(session.plan.positions):
            if number not in session.done:
                _take_position(devices, session, number, position, on_step, on_trouble)
        session.note(session.plan.model_copy(update={"state": "taken"}))
    except BaseException:
        devices.head.halt()
        raise
    finally:
        if devices.hold_board is not None:
            devices.hold_board(None)
    devices.head.move_to(*ZERO)
    return session


def take_again(
    devices: CalibrationDevices,
    session: Session,
    rejected: Sequence[FrameSetRow],
    on_step: OnStep,
    on_trouble: OnTrouble,
) -> int:
    """Take the positions of rig views that did not fit once more; give how many there were.

    rejected are rows of the session. Those views stay in the frame set. Raises as `take_views`.
    """
    steps = {int(row.extra["step"]) for row in rejected}
    positions = (*session.plan.positions, ZERO)
    try:
        for number in sorted(steps):
            _take_position(devices, session, number, positions[number], on_step, on_trouble)
    except BaseException:
        devices.head.halt()
        raise
    devices.head.move_to(*ZERO)
    return len(steps)


def _begin(
    devices: CalibrationDevices,
    state: Path,
    config_hash: str,
    lens_views: FrameSet | None,
    on_step: OnStep,
    on_trouble: OnTrouble,
) -> Session:
    """Take lens views and zero, and plan the positions from what the zero shows."""
    if devices.hold_board is not None and lens_views is None:
        devices.hold_board(None)
    exposures = _settled_light(devices)
    first_utc, check = settled_view_check(devices.source, devices.clock, devices.site)
    if check.problems or check.discs is None:
        raise CalibrationError("before calibrating: " + "; ".join(check.problems))
    for problem in further_problems(check, devices.site):
        on_trouble(f"before calibrating: {problem}")
    positions = tuple(planned_positions(devices.site, check.discs, devices.limits))
    directory = new_directory(state / FOLDER / f"{first_utc:%Y%m%dT%H%M%SZ}")
    plan = Plan(
        config_hash=config_hash,
        positions=positions,
        state="taking",
        exposures=exposures,
        serials=dict(devices.serials),
    )
    session = Session(directory, plan, [])
    session.note(plan)
    if lens_views is not None:
        _copy_lens_views(session, lens_views)
    elif devices.hold_board is not None:
        _take_simulated_lens_views(devices, devices.hold_board, session, on_step, on_trouble)
    on_step("zero")
    slot_utc, seen = take_reference(devices.source, devices.clock, devices.site, on_trouble)
    zero = _keep(session, slot_utc, "reference", seen, devices.head, None)
    said = _readings(devices.sampler, slot_utc, on_trouble)
    session.add(replace(zero, extra=MappingProxyType({**zero.extra, **said})))
    return session


def _readings(sampler: Sampler | None, slot_utc: datetime, on_trouble: OnTrouble) -> dict[str, str]:
    """What the sensors say at the zero: columns of its row. One that fails costs its value only."""
    if sampler is None:
        return {}
    sampler.ahead(slot_utc, 0.0)
    found = sampler.collect(slot_utc)
    for one in found:
        if one.value is None:
            on_trouble(f'zero: reading "{one.name}": {one.cause}; the calibration goes on without')
    return {f"{READING}{one.name}": "" if one.value is None else repr(one.value) for one in found}


def _take_simulated_lens_views(
    devices: CalibrationDevices,
    hold_board: Callable[[int | None], None],
    session: Session,
    on_step: OnStep,
    on_trouble: OnTrouble,
) -> None:
    """Let the simulation hold the board before the sub-camera, pose after pose."""
    source, clock, site = devices.source, devices.clock, devices.site
    for number in range(SIMULATED_LENS_VIEWS):
        hold_board(number)
        on_step(f"lens view {number + 1}")
        slot_utc, seen = settled_view_check(source, clock, site, board_only=True)
        session.add(_keep(session, slot_utc, "intrinsics", seen, None, None))
        if seen.problems:
            on_trouble(f"lens view {number + 1}: {'; '.join(seen.problems)}")
    hold_board(None)


def _settled_light(devices: CalibrationDevices) -> dict[Role, tuple[float, float | None]]:
    """Let the light be followed before the first view, and give the exposures found."""
    if devices.exposure is None:
        return {}
    settle(devices.source, devices.clock, devices.exposure)
    return {role: (at.time_us, at.gain_db) for role, at in devices.exposure.asked.items()}


def _take_position(
    devices: CalibrationDevices,
    session: Session,
    number: int,
    position: Position,
    on_step: OnStep,
    on_trouble: OnTrouble,
) -> None:
    """Move, wait until the images stand still, keep the pair; again if it shows too little."""
    on_step(f"position {number + 1} of {len(session.plan.positions)}")
    for left in reversed(range(TRIES)):
        devices.head.move_to(*position)
        slot_utc, check = settled_view_check(devices.source, devices.clock, devices.site)
        session.add(_keep(session, slot_utc, "rig", check, devices.head, number, position))
        if not check.problems:
            return
        then = "taken again" if left else "kept as it is"
        on_trouble(f"position {number + 1}: {'; '.join(check.problems)}: {then}")


def _keep(
    session: Session,
    slot_utc: datetime,
    role: FrameRole,
    check: ViewCheck,
    head: PanTiltHead | None,
    step: int | None,
    position: Position = ZERO,
) -> FrameSetRow:
    """Put a pair's images on the disk; give their row."""
    reached = (head.position_deg() or position) if head is not None else None
    directory, pair = session.directory, check.pair
    return FrameSetRow(
        slot_utc=slot_utc,
        role=role,
        main=None if role == "intrinsics" else write_frame(directory, slot_utc, "main", pair.main),
        sub=write_frame(directory, slot_utc, "sub", pair.sub),
        pan_deg=None if reached is None else round(reached[0], 4),
        tilt_deg=None if reached is None else round(reached[1], 4),
        extra=MappingProxyType({"step": "" if step is None else str(step), **_temperatures(pair)}),
    )


def _temperatures(pair: CapturedPair) -> dict[str, str]:
    """What the cameras say of their own temperatures: columns of the pair's row."""
    said: dict[Role, float | None] = {
        "main": pair.main.temperature_c,
        "sub": pair.sub.temperature_c,
    }
    return {
        TEMPERATURES[role]: "" if celsius is None else repr(celsius)
        for role, celsius in said.items()
    }


def _copy_lens_views(session: Session, lens_views: FrameSet) -> None:
    """Take over the lens views of another frame set, images and all."""
    for row in lens_views.rows_of("intrinsics"):
        name = f"lens_{row.slot_utc:%Y%m%dT%H%M%SZ}_sub.png"
        write_durable(session.directory / name, (lens_views.directory / str(row.sub)).read_bytes())
        step = MappingProxyType({"step": ""})
        session.add(FrameSetRow(row.slot_utc, "intrinsics", None, name, extra=step))


def new_directory(wanted: Path) -> Path:
    """Make a directory; simulated time can come twice, and no session overwrites another."""
    directory, number = wanted, 1
    while directory.exists():
        number += 1
        directory = wanted.with_name(f"{wanted.name}-{number}")
    make_directory_durable(directory)
    return directory


def write_frame(directory: Path, slot_utc: datetime, role: str, frame: CapturedFrame) -> str:
    """Put one image on the disk, durably; give its name."""
    name = f"{slot_utc:%Y%m%dT%H%M%SZ}_{role}.png"
    write_durable(directory / name, encode_png(frame.pixels, frame.bits))
    return name
