"""One device through `harvesters` and a vendor's GenTL producer; implements `device`.

To be used in the main thread of a process of its own (`drivers.genicam.gentl_worker`): the binding
holds Python's lock while a producer's call lasts, and a producer's fault ends its process.
"""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import structlog

from drivers.errors import DeviceLostError, MissingLibraryError
from drivers.genicam.device import (
    CONTROL_WAIT_S,
    FOREIGN_ADVICE,
    N_BUFFERS,
    POLL_S,
    Grabbed,
    NoAnswerError,
    NodeRefusedError,
    Value,
)
from drivers.genicam.gentl_listing import Listed, find_entries, read_list
from drivers.libraries import how_to_install
from drivers.protocols import CameraSettings

_log = structlog.get_logger("dcam.drivers")

LEAST_WAIT_S = 0.001
"""`harvesters` takes no time-out to mean for ever."""


def load_harvesters() -> tuple[Any, Any, Any]:
    """Give `harvesters.core`, `genicam.genapi` and `genicam.gentl`.

    Raises MissingLibraryError that says what to install.
    """
    try:
        from genicam import genapi, gentl
        from harvesters import core
    except ImportError as error:
        msg = f"harvesters cannot be loaded ({error}); {how_to_install('harvesters')}"
        raise MissingLibraryError(msg) from error
    return core, genapi, gentl


class GentlDevice:
    """One device, its features and its stream."""

    def __init__(self, serial: str, producer: Path) -> None:
        self._serial = serial
        self._producer = producer
        self._core, self._genapi, self._gentl = load_harvesters()
        self._harvester: Any = None
        self._acquirer: Any = None
        self._format = ""
        self._torn = 0
        self.listed_serial = ""
        self._complaints = _Complaints()

    @property
    def features(self) -> GentlFeatures:
        """Its features, once it is open."""
        return GentlFeatures(self._acquirer.remote_device.node_map, self._genapi, self._gentl)

    @property
    def is_lost(self) -> bool:
        """A producer does not tell; its calls fail."""
        return False

    @property
    def missing_data_advice(self) -> str:
        """What to look at when data of a frame are missing."""
        return (
            "check the cable; on GigE switch, packet size, and that net.core.rmem_max exceeds four"
            " frames; on USB hub, port and usbfs_memory_mb"
        )

    def open(self) -> None:
        """Load the producer, find the device and become the one program that controls it."""
        with _answers(self._genapi, self._gentl):
            self._harvester = self._core.Harvester(config=self._logged())
            try:
                self._harvester.add_file(str(self._producer), check_validity=True)
            except OSError as error:
                msg = f"{self._producer}: not a GenTL producer that can be loaded: {error}"
                raise MissingLibraryError(msg) from None
            self._take_control()
            self._acquirer.num_buffers = N_BUFFERS
            self._acquirer.add_callback(
                self._core.ImageAcquirer.Events.INCOMPLETE_BUFFER, self._torn_callback()
            )
        self._stop_what_runs()

    def open_stream(self, settings: CameraSettings) -> None:
        """Note what the frames must be; `start` makes the buffers."""
        self._format = settings.pixel_format

    def start(self) -> None:
        """Announce the buffers and start acquisition."""
        with _answers(self._genapi, self._gentl):
            self._acquirer.start()

    def stop(self) -> None:
        """Stop acquisition and revoke the buffers."""
        with _answers(self._genapi, self._gentl):
            self._acquirer.stop()

    def pop(self, timeout_s: float) -> Grabbed | None:
        """Give the next frame as a copy; its buffer is back in the queue."""
        torn = self._torn
        with _answers(self._genapi, self._gentl):
            buffer = self._acquirer.try_fetch(timeout=max(timeout_s, LEAST_WAIT_S))
            if buffer is None:
                if self._torn == torn:
                    return None
                return Grabbed(None, 0, None, "packets are missing")
            with buffer:
                return self._grabbed(buffer)

    def release(self) -> None:
        """Let go of device and producer; a dead one takes its time-outs."""
        acquirer, self._acquirer = self._acquirer, None
        harvester, self._harvester = self._harvester, None
        with _answers(self._genapi, self._gentl):
            if acquirer is not None:
                acquirer.destroy()
            if harvester is not None:
                harvester.reset()

    def _take_control(self) -> None:
        """Look for the device, and wait until a program that died is forgotten by it."""
        deadline_s = time.monotonic() + CONTROL_WAIT_S
        while True:
            self._harvester.update()
            if self._open_first(find_entries(self._serial, self._listed(), self._producer.name)):
                return
            if time.monotonic() > deadline_s:
                msg = f"camera {self._serial}: in use by another program, which must be stopped"
                raise DeviceLostError(msg)
            time.sleep(POLL_S)

    def _open_first(self, entries: list[Listed]) -> bool:
        """Open the first entry that can be; False when another program has the camera.

        Raises NoAnswerError when no entry can be opened for another reason.
        """
        failures: list[str] = []
        for entry in entries:
            try:
                self._acquirer = self._harvester.create(entry.info, config=self._config())
            except (self._gentl.AccessDeniedException, self._gentl.ResourceInUseException):
                continue
            except self._gentl.GenericException as error:
                failures.append(_first_line(error))
            else:
                self.listed_serial = entry.serial
                if len(entries) > 1:
                    others = [other.device_id for other in entries if other is not entry]
                    what = {"opened": entry.device_id, "others": others}
                    _log.info("camera_listed_more_than_once", serial=self._serial, **what)
                return True
            finally:
                # `create` has put a handler of its own, which destroys the device.
                signal.signal(signal.SIGINT, signal.SIG_IGN)
        if len(failures) < len(entries):
            return False
        raise NoAnswerError("; ".join(dict.fromkeys(failures)))

    def _logged(self) -> Any:
        key = self._core.ParameterKey
        return self._core.ParameterSet({key.LOGGER: self._complaints.logger()})

    def _config(self) -> Any:
        """No look for chunks in each frame: producers without the call for it crash."""
        key = self._core.ParameterKey
        return self._core.ParameterSet({key.ENABLE_AUTO_CHUNK_DATA_UPDATE: False})

    def _listed(self) -> list[Listed]:
        """What the producer lists; raises DeviceLostError, in its words, when it lists nothing.

        A producer that fails at one interface may have listed the devices of others before.
        """
        infos = self._harvester.device_info_list
        if not infos and not self._harvester.has_revised_device_info_list:
            why = f" ({self._complaints.last})" if self._complaints.last else ""
            msg = f"camera {self._serial}: {self._producer} cannot list its cameras{why}"
            raise DeviceLostError(msg)
        return read_list(infos)

    def _torn_callback(self) -> Any:
        """`harvesters` puts incomplete frames back without a word but to this."""
        device = self

        class Torn(self._core.Callback):  # type: ignore[misc, name-defined]
            def emit(self, context: object = None) -> None:
                del context
                device._torn += 1

        return Torn()

    def _stop_what_runs(self) -> None:
        """A program that was killed may have left the camera running, its settings locked."""
        try:
            self.features.execute("AcquisitionStop")
        except NodeRefusedError:
            return  # a camera at rest may decline

    def _grabbed(self, buffer: Any) -> Grabbed:
        frame_id = int(buffer.module.frame_id)
        time_ns = self._time_ns(buffer)
        part = buffer.payload.components[0]
        samples = np.asarray(part.data)
        if part.data_format != self._format or samples.size != part.width * part.height:
            problem = f"{part.width}x{part.height} px of {part.data_format}"
            return Grabbed(frame_id, time_ns, None, problem, FOREIGN_ADVICE)
        # A view of the buffer, which is the producer's again after this.
        return Grabbed(frame_id, time_ns, samples.reshape(part.height, part.width).copy())

    def _time_ns(self, buffer: Any) -> int:
        """0 for a producer that tells no time; then only the frame counter tells stale frames."""
        try:
            return int(buffer.timestamp_ns)
        except self._gentl.GenericException:
            return 0


class GentlFeatures:
    """The features of one open device, through GenApi."""

    def __init__(self, node_map: Any, genapi: Any, gentl: Any) -> None:
        self._nodes = node_map
        self._genapi = genapi
        self._gentl = gentl

    def has(self, name: str) -> bool:
        """Whether the feature is there and can be used now."""
        with _answers(self._genapi, self._gentl):
            if not self._nodes.has_node(name):
                return False
            usable = (self._genapi.EAccessMode.NI, self._genapi.EAccessMode.NA)
            return self._nodes.get_node(name).get_access_mode() not in usable

    def read(self, name: str) -> Value:
        """Give the value as the camera has it now: GenApi keeps what was read before."""
        with self._node(name) as node:
            value: Value = node.get_value(False, True)  # noqa: FBT003  (verify, ignore_cache)
            return value

    def write(self, name: str, value: Value) -> None:
        """Set the value in the type of its node."""
        with self._node(name) as node:
            node.value = type(node.value)(value) if isinstance(value, int | float) else value

    def limits(self, name: str) -> tuple[float, float]:
        """Give the least and the greatest value."""
        with self._node(name) as node:
            return node.min, node.max

    def step(self, name: str) -> int:
        """Give the step of an integer."""
        with self._node(name) as node:
            return int(node.inc)

    def choices(self, name: str) -> list[str]:
        """Give the entries of an enumeration that can be chosen now."""
        with self._node(name) as node:
            hidden = (self._genapi.EAccessMode.NI, self._genapi.EAccessMode.NA)
            return [
                entry.symbolic for entry in node.entries if entry.get_access_mode() not in hidden
            ]

    def execute(self, name: str) -> None:
        """Carry out a command."""
        with self._node(name) as node:
            node.execute()

    @contextmanager
    def _node(self, name: str) -> Iterator[Any]:
        with _answers(self._genapi, self._gentl, declines=True):
            if not self._nodes.has_node(name):
                msg = f"the camera has no {name}"
                raise NodeRefusedError(msg)
            yield getattr(self._nodes, name)


class _Complaints(logging.Handler):
    """Keeps the last error that `harvesters` met while it looked for devices: it only logs them."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.last = ""

    def logger(self) -> logging.Logger:
        """The logger to give to `harvesters`."""
        logger = logging.Logger("harvesters", logging.WARNING)  # noqa: LOG001  (no global one)
        logger.addHandler(self)
        return logger

    def emit(self, record: logging.LogRecord) -> None:
        """Keep its first line."""
        self.last = record.getMessage().split("\n", 1)[0].strip()


@contextmanager
def _answers(genapi: Any, gentl: Any, *, declines: bool = False) -> Iterator[None]:
    """Turn the libraries' errors into ours: declined, or no answer.

    GenApi's errors of access, range and logic are the camera's description speaking; whatever the
    port could not do comes as a TimeoutException or RuntimeException, or as an error of GenTL's.
    """
    refusals = (
        genapi.AccessException,
        genapi.OutOfRangeException,
        genapi.InvalidArgumentException,
        genapi.LogicalErrorException,
        genapi.PropertyException,
    )
    try:
        yield
    except refusals as error:
        if declines:
            raise NodeRefusedError(_first_line(error)) from None
        raise NoAnswerError(_first_line(error)) from None
    except (genapi.GenericException, gentl.GenericException) as error:
        raise NoAnswerError(_first_line(error)) from None


def _first_line(error: Exception) -> str:
    """GenApi's messages go on with source files and lines of its own."""
    return str(error).split("\n", 1)[0].split(" : ", 1)[0].strip()
