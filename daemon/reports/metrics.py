"""The facts of a site as Prometheus' metrics: base units, times as timestamps, no ages.

Names follow https://prometheus.io/docs/practices/naming/. All are gauges: what is counted here is
counted within a window, and falls again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from core.results import Displacement
from daemon.status.facts import Daemon, Disk, Facts
from daemon.status.item import Item, Level, worst
from daemon.store.queries.overview import ClosureSummary, TargetSummary
from daemon.store.records import Coverage, GapCause, MeasurementRecord
from daemon.version import VERSION

AXES = ("x", "y", "z")
M_PER_MM = 1e-3
S_PER_US = 1e-6
_LEVELS = "0 ok, 1 warning, 2 critical, 3 unknown"


def metrics_text(facts: Facts, items: Sequence[Item]) -> bytes:
    """Give everything that `status --json` tells as numbers, in Prometheus' text format, UTF-8."""
    return _text(
        [
            *_verdict(worst(list(items)), items),
            *_site(facts),
            *(_row(facts.last) if facts.last else ()),
            *_closure({"24h": facts.closure_24h, "30d": facts.closure_30d}),
            *_targets(facts.targets),
            *_coverage({"24h": facts.coverage_24h, "30d": facts.coverage_30d}),
            *_daemon(facts.daemon),
            *_disk(facts.disk),
        ]
    )


def no_metrics_text(why: Item) -> bytes:
    """Give what is left to say of a site of which nothing can be known: its level."""
    return _text(_verdict(why.level, [why]))


@dataclass(frozen=True, slots=True, eq=False)  # a registry wants it hashable
class _Found(Collector):
    families: list[GaugeMetricFamily]

    def collect(self) -> Iterable[GaugeMetricFamily]:
        return self.families


def _text(families: Iterable[GaugeMetricFamily]) -> bytes:
    registry = CollectorRegistry()
    # What is not known has no line: never a zero, never NaN.
    registry.register(_Found([family for family in families if family.samples]))
    return generate_latest(registry)


def _gauge(name: str, text: str, value: float | datetime | None) -> GaugeMetricFamily:
    """One number; without a line where it is not known."""
    family = GaugeMetricFamily(f"dcam_{name}", text)
    if value is not None:
        family.add_metric((), _number(value))
    return family


def _labelled(
    name: str,
    text: str,
    labels: Sequence[str],
    values: Iterable[tuple[tuple[str, ...], float | None]],
) -> GaugeMetricFamily:
    """A number for each combination of labels; without a line where it is not known."""
    family = GaugeMetricFamily(f"dcam_{name}", text, labels=labels)
    for named, value in values:
        if value is not None:
            family.add_metric(named, value)
    return family


def _number(value: float | datetime) -> float:
    return value.timestamp() if isinstance(value, datetime) else float(value)


def _verdict(level: Level, items: Sequence[Item]) -> Iterator[GaugeMetricFamily]:
    yield _gauge("level", f"Verdict of dcam-ctl status: {_LEVELS}", level)
    levels = (((item.name,), float(item.level)) for item in items)
    yield _labelled("status_level", f"Verdict on each thing: {_LEVELS}", ("item",), levels)


def _site(facts: Facts) -> Iterator[GaugeMetricFamily]:
    named = ((facts.site, VERSION), 1.0)
    yield _labelled("site_info", "Name and version", ("site", "version"), [named])
    yield _gauge("period_seconds", "From one slot to the next", facts.period_s)
    good = facts.last_good_utc
    yield _gauge("last_good_slot_timestamp_seconds", "Slot of the last good row", good)
    calibration = facts.calibration
    if calibration:
        created = calibration.created_utc
        yield _gauge("calibration_id", "The calibration in use", calibration.id)
        yield _gauge("calibration_created_timestamp_seconds", "When it was made", created)
        yield _gauge("calibration_passed", "1 if it passed its own checks", calibration.passed)
        if calibration.datum and calibration.datum.steps:
            text = "Of the calibration's reference in the record's zero, x right, y up"
            yield _by_axis("datum_metres", text, _metres(calibration.datum.offset))
            text = "1 sigma of the datum"
            yield _by_axis("datum_sigma_metres", text, _sigmas(calibration.datum.offset))
        fits = calibration.config_hash == facts.config_hash
        yield _gauge("calibration_fits_config", "0 if the config has changed since", fits)
    text = "Residuals of the corners over their level at calibration"
    yield _gauge("calibration_misfit_ratio", text, facts.residual_ratio)
    synchronised = facts.clock_synchronised
    yield _gauge("clock_synchronised", "1 if NTP or PTP disciplines the clock", synchronised)
    yield _gauge("undated_pairs", "Taken under a wrong clock, without a slot yet", facts.undated)
    yield _gauge(
        "rows_to_measure_again",
        "Of a wrong clock, in their slots, with values as of the wrong time still",
        facts.to_measure_again,
    )
    text = "Rows of 24 hours without their images"
    yield _gauge("rows_without_frames", text, facts.frames_not_kept_24h)
    text = "Damaged databases that were set aside"
    yield _gauge("databases_set_aside", text, len(facts.set_aside))


def _row(row: MeasurementRecord) -> Iterator[GaugeMetricFamily]:
    """The last row; a value that was withheld has no line."""
    measured = row.measurement
    yield _gauge("last_slot_timestamp_seconds", "Slot of the last row", row.slot_utc)
    yield _gauge("last_slot_flag", "1 good, 3 suspect, 4 bad, 9 missing", measured.flag)
    yield _by_axis("displacement_metres", "Corrected, x right, y up", _metres(measured.corrected))
    text = "1 sigma of the corrected displacement"
    yield _by_axis("displacement_sigma_metres", text, _sigmas(measured.corrected))
    text = "Of the main camera alone, x right, y up"
    yield _by_axis("raw_displacement_metres", text, _metres(measured.raw))
    if measured.motion:
        turn = measured.motion.rotation_rad.tolist()
        yield _by_axis("rig_rotation_radians", "Of the rig since the reference", turn)
        shift = (measured.motion.translation_mm * M_PER_MM).tolist()
        yield _by_axis("rig_translation_metres", "Of the rig since the reference", shift)
    yield from _cameras(row)
    readings = (((one.name, one.unit), one.value) for one in row.readings)
    text = "Of a sensor at the last row, in its unit"
    yield _labelled("reading", text, ("name", "unit"), readings)


def _closure(windows: Mapping[str, ClosureSummary | None]) -> Iterator[GaugeMetricFamily]:
    known = {name: closure for name, closure in windows.items() if closure is not None}
    text = "What fixed targets show of the rig's error, rms of x and y"
    values = [((name,), closure.rms_mm * M_PER_MM) for name, closure in known.items()]
    yield _labelled("closure_rms_metres", text, ("window",), values)
    text = "What that should be, by its sigmas"
    values = [((name,), closure.sigma_mm * M_PER_MM) for name, closure in known.items()]
    yield _labelled("closure_sigma_metres", text, ("window",), values)


def _targets(targets: Sequence[TargetSummary]) -> Iterator[GaugeMetricFamily]:
    """The further targets, by their names; without a line what is not known."""
    text = "Of the last row: 1 good, 3 suspect, 4 bad, 9 missing"
    flags = [((target.now.name,), float(target.now.flag)) for target in targets]
    yield _labelled("target_flag", text, ("target",), flags)
    text = "Corrected, x right, y up; of a fixed target its closure"
    yield _of_targets("target_displacement_metres", text, targets, _metres)
    text = "1 sigma of it"
    yield _of_targets("target_displacement_sigma_metres", text, targets, _sigmas)
    text = "Of 24 hours, the share of the rows with a value that have one of it too"
    shares = [
        ((target.now.name,), target.rows_with_value / target.rows)
        for target in targets
        if target.rows
    ]
    yield _labelled("target_value_ratio", text, ("target",), shares)


def _of_targets(
    name: str,
    text: str,
    targets: Sequence[TargetSummary],
    numbers: Callable[[Displacement | None], Sequence[float]],
) -> GaugeMetricFamily:
    values = (
        ((target.now.name, axis), value)
        for target in targets
        for axis, value in zip(AXES, numbers(target.now.corrected), strict=False)
    )
    return _labelled(name, text, ("target", "axis"), values)


def _cameras(row: MeasurementRecord) -> Iterator[GaugeMetricFamily]:
    cameras = {"main": row.main_camera, "sub": row.sub_camera}
    yield _labelled(
        "camera_temperature_celsius",
        "At the last row",
        ("camera",),
        (((role,), camera.temperature_c) for role, camera in cameras.items()),
    )
    yield _labelled(
        "camera_exposure_seconds",
        "At the last row",
        ("camera",),
        (
            ((role,), camera.exposure_us * S_PER_US)
            for role, camera in cameras.items()
            if camera.exposure_us is not None
        ),
    )


def _metres(displacement: Displacement | None) -> list[float]:
    return [] if displacement is None else (displacement.mm * M_PER_MM).tolist()


def _sigmas(displacement: Displacement | None) -> list[float]:
    if displacement is None:
        return []
    return [
        float(variance) ** 0.5 * M_PER_MM for variance in displacement.covariance_mm2.diagonal()
    ]


def _by_axis(name: str, text: str, values: Sequence[float]) -> GaugeMetricFamily:
    named = (((axis,), value) for axis, value in zip(AXES, values, strict=False))
    return _labelled(name, text, ("axis",), named)


def _coverage(windows: dict[str, Coverage]) -> Iterator[GaugeMetricFamily]:
    shares = (
        ((window,), coverage.measured / coverage.expected)
        for window, coverage in windows.items()
        if coverage.expected
    )
    yield _labelled("coverage_ratio", "Slots with a row", ("window",), shares)
    outcomes = (
        ((window, outcome), getattr(coverage, outcome))
        for window, coverage in windows.items()
        for outcome in ("good", "suspect", "bad", "missing", "unaccounted")
    )
    text = "Slots of the last hours or days by what became of them"
    yield _labelled("slots", text, ("window", "outcome"), outcomes)
    causes = (
        ((window, cause.value), coverage.gaps.get(cause, 0))
        for window, coverage in windows.items()
        for cause in GapCause
    )
    text = "Slots in gaps, by the gap's cause"
    yield _labelled("slots_missed", text, ("window", "cause"), causes)


def _daemon(daemon: Daemon) -> Iterator[GaugeMetricFamily]:
    yield _gauge("daemon_up", "1 if a dcamd runs", daemon.running)
    heartbeat = daemon.heartbeat_utc
    text = "Up to when every slot has its row or gap"
    yield _gauge("daemon_heartbeat_timestamp_seconds", text, heartbeat)
    yield _gauge("daemon_starts", "Of dcamd in 24 hours", daemon.starts_24h)
    if daemon.says:
        text = "Slots without a row, since the last that had one"
        yield _gauge("slots_failed_in_a_row", text, daemon.says.failed_in_a_row)
        lost = (((role,), float(role in daemon.says.lost)) for role in ("main", "sub"))
        yield _labelled("camera_lost", "1 if it gave no frame", ("camera",), lost)


def _disk(disk: Disk) -> Iterator[GaugeMetricFamily]:
    yield _gauge("disk_free_bytes", "Of the disk with the state directory", disk.free_bytes)
    yield _gauge("disk_size_bytes", "Of the disk with the state directory", disk.total_bytes)
    yield _gauge("frames_bytes", "What the frames take", disk.archive_bytes)
    yield _gauge("frames_days", "Days with frames", disk.archive_days)
