"""A socket server with two devices in the test's event loop (`serving`) or in a thread (`daemon`), and a client."""

import asyncio
import grp
import json
import os
import socket
import struct
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractAsyncContextManager, asynccontextmanager, contextmanager, suppress
from functools import wraps
from importlib.util import find_spec
from inspect import Parameter, signature
from pathlib import Path
from typing import Any, Self, TypeVar

from docs.generate.socket_schema import socket_document
from imud.attitude.conventions import Convention, Heading
from imud.contracts import command, setting
from imud.contracts.condition import Condition, DeviceCondition
from imud.contracts.firmware import FirmwareImage, FirmwareResult
from imud.contracts.publisher import AS_SENT, Batch, Latencies, PublisherContext, RecordingSource
from imud.contracts.status import ClockStatus, Deviations, DeviceState, DeviceStatus, FrameStatus, KernelCounters
from imud.host import event_loop
from imud.model.errors import IsSetting, Rejected
from imud.model.sample import Sample, Sync
from imud.publishers.socket.messages import NOTIFICATIONS
from imud.publishers.socket.methods import METHODS
from imud.publishers.socket.server import SocketOptions, SocketServer
from tests.support.event_loops import without_readers_left
from tests.support.publisher_context import publisher_context


class MessageChecker:
    """Checks messages by the closed schema. Without the package jsonschema it checks nothing."""

    def __init__(self) -> None:
        self.checked: dict[str, int] = {}  # number of checked messages, by name
        self._whole = socket_document()
        _close(self._whole)
        self._validators: dict[str, Any] = {}

    @property
    def able(self) -> bool:
        return find_spec("jsonschema") is not None

    def check(self, name: str, message: object) -> None:
        """Raise AssertionError unless `message` is valid for the entry `name` of `$defs`."""
        if not self.able:
            return
        validator = self._validators.get(name)
        if validator is None:
            from jsonschema import Draft202012Validator

            schema = {"$ref": f"#/$defs/{name}", "$defs": self._whole["$defs"]}
            validator = self._validators[name] = Draft202012Validator(schema)
        self.checked[name] = self.checked.get(name, 0) + 1
        errors = [f"{error.json_path}: {error.message}" for error in validator.iter_errors(message)]
        assert not errors, f"{name}: {errors[:3]}"

    def check_sent(self, message: dict[str, Any], method: str | None) -> None:
        """Check a message of the server. `method` is the method of its request, None if unknown."""
        if message.get("method") in NOTIFICATIONS:
            self.check(f"notification.{message['method']}", message)
        elif "error" in message:
            self.check("reply.error", message)
        elif method is not None:
            self.check(f"reply.{method}", message)


def _close(schema: Any) -> None:
    if isinstance(schema, dict):
        if "properties" in schema:
            schema.setdefault("additionalProperties", False)
        for one in schema.values():
            _close(one)
    elif isinstance(schema, list):
        for one in schema:
            _close(one)


NOT_SAVED = "not saved; run `imud command imu0 save`"

T = TypeVar("T")
CHECKER = MessageChecker()  # checker of all messages that a `Peer` receives against docs/socket.schema.json

EPOCH = 4886718345
NOW_NS = 80_000_123_456_789
LIMIT_S = 60.0
DEVICES = {"imu0": 0, "imu1": 1}
SAMPLES_CHECKED = 50  # number of samples of a `Peer` that are checked against the schema, because a check takes 0.3 ms


def sample(device: str = "imu0", seq: int = 1, period_ns: int = 1_000_000) -> Sample:
    t_ns = 80_000_000_000_000 + seq * period_ns
    return Sample(
        device=device, seq=seq, t_ns=t_ns, t_err_ns=12_000, sync=Sync.REGRESSION, t_rx_ns=t_ns + 200_000,
        utc_ns=1_790_000_000_000_000_000 + seq * period_ns, t_dev_ns=seq * period_ns, accel_m_s2=(0.125, -0.5, 9.75),
        gyro_rad_s=(0.25, 0.5, -0.75), temperature_c=31.5,
    )  # fmt: skip


def batch(device: str = "imu0", first: int = 1, count: int = 1, period_ns: int = 1_000_000) -> Batch:
    samples = [sample(device, seq, period_ns) for seq in range(first, first + count)]
    return Batch(device, DEVICES.get(device, 9), samples)


def device_status(name: str, device_id: int) -> DeviceStatus:
    return DeviceStatus(
        name=name, device_id=device_id, driver="hipnuc-uart", link="/dev/ttyUSB0 at 115200 baud",
        state=DeviceState.RUNNING, problem="", identity={"product": "HI13"}, settings={}, rate_hz=1000.0,
        expected_rate_hz=1000.0, newest_seq=1, clock=ClockStatus(sync=Sync.REGRESSION), ledger={"bytes_in": 82},
        kernel=KernelCounters(), latency_buckets=(1, 0), latency_sum_ns=200_000, temperature_c=31.5, status_bits=0,
        connects=1, euler_convention="roll, pitch, yaw; 312 order", navigation_frame="ENU",
        frame=FrameStatus(
            frame=AS_SENT.device.words, convention="device", euler_convention="roll, pitch, yaw; 312 order",
            navigation_frame="ENU", heading=Heading.MAGNETIC, declination_deg=None,
            conventions={str(one): AS_SENT.words_of(one) for one in Convention},
        ),
        noise=Deviations(accel_m_s2=0.01), condition=DeviceCondition(Condition.OK, NOW_NS - 5_000_000_000),
    )  # fmt: skip


def context(
    now_ns: Callable[[], int] = lambda: NOW_NS,
    latencies: Latencies | None = None,
    recording: RecordingSource | None = None,
) -> PublisherContext:
    statuses = [device_status(*item) for item in DEVICES.items()]
    return publisher_context(lambda: statuses, EPOCH, now_ns, FakeControl, latencies=latencies, recording=recording)


def turn(_target: command.Target, *, angle_deg: float, relative: bool = False) -> None:
    """Verb `yaw`."""


VERBS = {"yaw": command.Verb("set the heading", turn)}
CALIBRATIONS = {
    "heading": command.Calibration(
        help="make the present heading zero", section="2.2.4", handling=command.Handling.REST,
        instructions=("Do not touch it.",), begin=lambda _target: None, kept=command.Kept.BY_SAVE,
    )
}  # fmt: skip
done_late = asyncio.Event()  # event that ends the action `wait`


class FakeControl:
    verbs: command.Verbs = VERBS
    calibrations: command.Calibrations = CALIBRATIONS
    last_calibrations: Mapping[str, command.LastCalibration] = {
        "heading": command.LastCalibration(NOW_NS, verified=True, saved=False)
    }

    def __init__(self, device: str) -> None:
        self._device = device
        self.settings = self.firmware = self

    async def update(self, image: FirmwareImage, product: str, version: str) -> FirmwareResult:
        if product == "wait":
            await done_late.wait()
        if product == "refused":
            raise Rejected(f"{self._device} refuses {product}")
        return FirmwareResult(product, "1.5.6", version, len(image.data), True, "", 1.5)

    async def act(self, name: str, arguments: Mapping[str, Any]) -> object:
        if name == "wait":
            await done_late.wait()
            return {"waited": self._device}
        if name == "break":
            raise ZeroDivisionError("a mistake in an action")
        if name == "mode":
            raise IsSetting(
                f"mode is a setting: imud settings {self._device} --set mode=9-axis", {"mode": "9-axis"}, save=False
            )
        if name != "yaw":
            raise Rejected(f"{self._device} refuses {name}")
        VERBS[name].arguments(arguments)
        return None

    async def calibrate(self, kind: str, *, save: bool) -> command.CalibrationResult:
        if kind == "wait":
            await done_late.wait()
        if kind not in CALIBRATIONS:
            raise Rejected(f"{self._device} refuses {kind}")
        check = command.Check("yaw", 0.001, 0.017, "rad", passed=True)
        return command.CalibrationResult(kind, True, "", "", (check,), save, command.Kept.BY_SAVE)

    def stop_calibration(self) -> bool:
        return False

    async def report(self, *, fresh: bool) -> setting.SettingsReport:
        differences = {"mode": setting.SettingDifference("9-axis", "6-axis")}
        status = setting.SettingsStatus(
            setting.SettingsState.DIFFER, setting.OnDifference.REPORT, differences=differences, flash_writes=3,
            read_ns=NOW_NS if fresh else 80_000_000_000_000,
        )  # fmt: skip
        texts = 'one of "6-axis", "9-axis"', "axes that make the attitude", "", "2.2.4"
        mode = setting.SettingInfo(
            "mode", *texts, setting.Effect.IMMEDIATELY, False, True, True, "9-axis", "6-axis", differs=True
        )
        return setting.SettingsReport(self._device, "hipnuc-uart", {"product": "HI13"}, status, (mode,))

    async def plan(self, given: Mapping[str, Any] | None, *, save: bool) -> setting.SettingsPlan:
        """Make one step of a plan: for the given settings or for the declared settings."""
        mode = {"mode": "9-axis"} if given is None else given
        return setting.SettingsPlan(
            tuple(setting.PlannedStep(name, value, "6-axis") for name, value in mode.items()), save=save
        )

    async def apply(self, given: Mapping[str, Any] | None, *, save: bool) -> setting.AppliedSettings:
        if given and "wait" in given:
            await done_late.wait()
        plan = await self.plan(given, save=save)
        steps = [
            setting.AppliedStep(one.name, one.value, one.before, setting.StepOutcome.VERIFIED) for one in plan.steps
        ]
        return setting.AppliedSettings(tuple(steps), saved=save, not_saved="" if save else NOT_SAVED)


def run(body: Callable[[], Awaitable[T]]) -> T:
    """Run a test's coroutine in a new event loop with a time limit."""

    strays: list[dict[str, Any]] = []

    async def limited() -> T:
        asyncio.get_running_loop().set_exception_handler(lambda _loop, stray: strays.append(stray))
        async with asyncio.timeout(LIMIT_S):
            return await body()

    try:
        result = event_loop.run(without_readers_left(limited()))
    finally:
        while _peers:
            _peers.pop().close()
    assert not strays
    return result


class SteppingClock:
    """A clock that advances by `step_ns` with each reading."""

    def __init__(self) -> None:
        self.step_ns, self.ns = 0, NOW_NS

    def __call__(self) -> int:
        self.ns += self.step_ns
        return self.ns


@asynccontextmanager
async def serving(
    directory: Path,
    now_ns: Callable[[], int] = lambda: NOW_NS,
    latencies: Latencies | None = None,
    recording: RecordingSource | None = None,
    **settings: Any,
) -> AsyncIterator[SocketServer]:
    path = directory / "imud.sock"
    own_group = grp.getgrgid(os.getgid()).gr_name
    server = SocketServer(
        SocketOptions(**{"path": str(path), "group": own_group, "history": True, **settings}),
        context(now_ns, latencies, recording),
    )
    server.start()
    for name, number in DEVICES.items():
        server.add_device(name, number)
    try:
        yield server
    finally:
        server.close()
        assert not path.exists()
        assert not server.hub.connections


def in_context(
    name: str, make: Callable[[Path], AbstractAsyncContextManager[Any]]
) -> Callable[[Callable[..., Awaitable[None]]], Callable[..., None]]:
    """Run a test in an event loop of its own. Its argument `name` is the value of the context `make(tmp_path)`."""

    def decorate(test: Callable[..., Awaitable[None]]) -> Callable[..., None]:
        wanted = {key: one for key, one in signature(test).parameters.items() if key != name}

        @wraps(test)
        def run_test(tmp_path: Path, **arguments: Any) -> None:
            async def body() -> None:
                async with make(tmp_path) as value:
                    await test(**({name: value} if name else {}), **arguments)

            if "tmp_path" in wanted:
                arguments["tmp_path"] = tmp_path
            run(body)

        parameters = {"tmp_path": Parameter("tmp_path", Parameter.POSITIONAL_OR_KEYWORD), **wanted}
        seen = signature(test).replace(parameters=list(parameters.values()))
        run_test.__signature__ = seen  # type: ignore[attr-defined]  # pytest reads it
        return run_test

    return decorate


def alone() -> Callable[[Callable[..., Awaitable[None]]], Callable[..., None]]:
    @asynccontextmanager
    async def nothing(_folder: Path) -> AsyncIterator[None]:
        yield

    return in_context("", nothing)


def in_server(**settings: Any) -> Callable[[Callable[..., Awaitable[None]]], Callable[..., None]]:
    """Run a test in a loop of its own. Its argument `server` is a server with these arguments of `serving`."""
    return in_context("server", lambda folder: serving(folder, **settings))


async def until(condition: Callable[[], bool]) -> None:
    while not condition():
        await asyncio.sleep(0)


class Daemon:
    """Runs coroutines of a server in the event loop of its thread and waits for them."""

    def __init__(self, server: SocketServer) -> None:
        self.server = server
        self.path = server.hub.path
        self._loop = asyncio.get_running_loop()
        self._stop = asyncio.Event()

    def do(self, work: Callable[[SocketServer], T]) -> T:
        async def called(server: SocketServer) -> T:
            return work(server)

        return self.start(called).result(LIMIT_S)

    def start(self, work: Callable[[SocketServer], Coroutine[Any, Any, T]]) -> Future[T]:
        return asyncio.run_coroutine_threadsafe(work(self.server), self._loop)

    def stop(self) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)

    async def stopped(self) -> None:
        await self._stop.wait()


@contextmanager
def daemon(directory: Path, **settings: Any) -> Iterator[Daemon]:
    ready = threading.Event()
    found: list[Daemon] = []

    async def main() -> None:
        async with serving(directory, **settings) as server:
            found.append(Daemon(server))
            ready.set()
            await found[0].stopped()

    thread = threading.Thread(target=event_loop.run, args=(main(),))
    thread.start()
    try:
        assert ready.wait(LIMIT_S)
        yield found[0]
    finally:
        found[0].stop()
        thread.join(LIMIT_S)
        assert not thread.is_alive()


class Peer:
    """A simple client that returns messages as JSON objects or slots. `run` closes it at its end."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self.samples = 0
        self.framed = False
        self.buffer = b""
        self.ids = 0
        self._methods: dict[str, str] = {}

    @classmethod
    async def connect(cls, server: SocketServer) -> Self:
        sock = socket.socket(socket.AF_UNIX)
        sock.setblocking(False)
        await asyncio.get_running_loop().sock_connect(sock, server.hub.path)
        peer = cls(sock)
        _peers.append(peer)
        return peer

    @classmethod
    async def greeted(cls, server: SocketServer) -> Self:
        peer = await cls.connect(server)
        assert (await peer.message())["method"] == "hello"
        return peer

    async def send(self, data: bytes) -> None:
        for line in data.splitlines():
            with suppress(ValueError, TypeError, KeyError, RecursionError):
                request = json.loads(line)
                if request["method"] in METHODS:
                    self._methods[json.dumps(request["id"])] = request["method"]
        await asyncio.get_running_loop().sock_sendall(self.sock, data)

    async def ask(self, method: str, **params: object) -> dict[str, Any]:
        """Send a request and return the reply. Only notifications may arrive before it."""
        self.ids += 1
        request = {"jsonrpc": "2.0", "id": self.ids, "method": method, "params": params}
        await self.send(json.dumps(request).encode() + b"\n")
        while "id" not in (reply := await self.message()):
            pass
        assert reply["id"] == self.ids
        return reply

    async def result(self, method: str, **params: object) -> Any:
        reply = await self.ask(method, **params)
        assert "error" not in reply, reply
        return reply["result"]

    async def error(self, method: str, **params: object) -> tuple[int, str]:
        """Send a request that must fail. Return code and message."""
        error = (await self.ask(method, **params))["error"]
        return error["code"], error["message"]

    async def message(self) -> dict[str, Any]:
        body = await self.body()
        value = json.loads(body, parse_constant=_refuse)
        assert isinstance(value, dict)
        self.samples += value.get("method") == "sample"
        if value.get("method") != "sample" or self.samples <= SAMPLES_CHECKED:
            CHECKER.check_sent(value, self._methods.get(json.dumps(value.get("id"))))
        return value

    async def messages(self, count: int) -> Sequence[dict[str, Any]]:
        return [await self.message() for _ in range(count)]

    async def body(self) -> bytes:
        """Return the next line or frame body. Raises EOFError at the end."""
        while (body := self._take()) is None:
            data = await asyncio.get_running_loop().sock_recv(self.sock, 1 << 16)
            if not data:
                raise EOFError
            self.buffer += data
        return body

    async def ended(self) -> bool:
        """Return whether the server has closed the connection and all data is read."""
        try:
            return not self.buffer and await asyncio.get_running_loop().sock_recv(self.sock, 1) == b""
        except ConnectionResetError:
            return True

    def close(self) -> None:
        self.sock.close()

    def _take(self) -> bytes | None:
        if not self.framed:
            line, newline, rest = self.buffer.partition(b"\n")
            if not newline:
                return None
            self.buffer = rest
            return line
        if len(self.buffer) < 4:
            return None
        (length,) = struct.unpack_from("<I", self.buffer)
        if len(self.buffer) < 4 + length:
            return None
        body, self.buffer = self.buffer[4 : 4 + length], self.buffer[4 + length :]
        return body


_peers: list[Peer] = []


def _refuse(word: str) -> None:
    raise AssertionError(f"{word} is not JSON")
