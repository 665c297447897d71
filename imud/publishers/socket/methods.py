"""Methods of the UNIX socket: the table METHODS, and the path from a line to its reply."""

import asyncio
from collections.abc import Callable, Collection, Coroutine, Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from math import ceil
from typing import Any, Final, Generic, TypeVar

import msgspec

from imud.attitude.conventions import Convention
from imud.contracts.command import REQUESTED_BY, CalibrationInfo, CalibrationResult, VerbInfo, described, infos
from imud.contracts.firmware import FirmwareImage, FirmwareResult
from imud.contracts.publisher import Batch, DeviceControl
from imud.contracts.setting import AppliedSettings, SettingsPlan, SettingsReport
from imud.contracts.status import LATENCY_BOUNDS_NS, CKernelStatus, DeviceState, DeviceStatus
from imud.formats import kernel
from imud.formats.jsonrpc import (
    PROTOCOL,
    Code,
    RpcError,
    RpcRequest,
    encode,
    encode_error,
    encode_result,
    parse_request,
    with_texts,
)
from imud.formats.slot import PRESENT_BITS, SLOT_BYTES, SLOT_FIELDS, SLOT_LAYOUT_VERSION, SYNC_CODES
from imud.model.errors import ImudError
from imud.model.event import EVENTS_MAX
from imud.model.options import unknown_name, wrong_values
from imud.model.sample import SAMPLE_FIELDS, SAMPLE_SCHEMA, Sample
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.publishers.socket.admission import Rights
from imud.publishers.socket.client import ClientConnection
from imud.publishers.socket.history import KEPT_S, History, buckets, end_ns
from imud.publishers.socket.hub import Hub
from imud.publishers.socket.messages import (
    BigNumbers,
    CalibrateParams,
    CommandParams,
    DeviceFrame,
    DeviceParams,
    DeviceSummary,
    EventsParams,
    EventsResult,
    FirmwareOpenParams,
    FirmwareOpenResult,
    FirmwareUpdateParams,
    HistoryParams,
    HistoryResult,
    NoParams,
    NothingMore,
    NotifyParams,
    NotifyResult,
    OptionsParams,
    OptionsResult,
    PollParams,
    PollResult,
    RecordParams,
    RecordResult,
    RecordStopResult,
    SchemaResult,
    SettingsChangeParams,
    SettingsParams,
    SlotMember,
    SlotSchema,
    SnapshotResult,
    StatusResult,
    StopResult,
    WatchParams,
    WatchResult,
)
from imud.publishers.socket.outbox import NO_FD, selector
from imud.publishers.socket.subscription import Form, Subscription

DEVICES_PER_PIECE: Final = 8
"""Number of devices in one piece of a reply: about 0.3 ms; 0.5 ms with big numbers as strings."""
CLIENTS_PER_PIECE: Final = 64
"""Number of clients in one piece of a reply: about 0.3 ms."""
BUCKETS_PER_PIECE: Final = 8
"""Number of buckets in one piece of a reply: about 0.3 ms."""
HISTORY_DEVICES_MAX: Final = 4
"""Maximum number of devices in a request for the history."""
POINTS_MAX: Final = 1000
"""Maximum number of buckets of each device in a reply: 0.8 MB."""
POINTS_DEFAULT: Final = 600
RATE_MIN_HZ: Final = 0.001
"""Minimum `rate_hz`. A lower rate is probably a wrong unit, and `poll` can replace it."""
RATE_MAX_HZ: Final = 1_000_000
"""Maximum `rate_hz`, above the rate of any sensor. A much higher rate exceeds the range of the period count."""
LATENCY_MAX_MS: Final = 60_000
"""Maximum `latency_ms`. A higher value is probably a wrong unit."""
LATENCY_OF_RATE_MAX_MS: Final = 20.0
"""Maximum latency of a client that only defines `rate_hz`, ms."""
NAME_MAX: Final = 64
"""Maximum length of the name of a command or calibration, more than twice the longest name."""

SLOT_SCHEMA: Final = SlotSchema(
    bytes=SLOT_BYTES,
    layout_version=SLOT_LAYOUT_VERSION,
    byte_order="little",
    fields=[SlotMember(f.name, f.code, f.count, f.offset) for f in SLOT_FIELDS],
    present_bits=dict(PRESENT_BITS),
    sync_codes={str(name): code for name, code in SYNC_CODES.items()},
)


@dataclass(frozen=True, slots=True)
class MethodReply:
    """The reply of a method."""

    result: object
    fd: int = NO_FD  # descriptor; imud sends a copy with the reply
    framed_from_here: bool = False  # whether imud sends frames after this reply
    big_numbers: bool = True  # whether `result` may contain integers above 2⁵³ that are not converted to strings yet


Pieces = Generator[int, None, MethodReply]
"""A reply in pieces. Each piece yields the number of bytes that the reply occupies so far."""
Later = Coroutine[Any, Any, object]
"""A result that takes time. imud carries out other requests of the client before it. May raise ImudError."""
P = TypeVar("P", bound=msgspec.Struct)


@dataclass(frozen=True, slots=True)
class Method(Generic[P]):
    """A row of METHODS."""

    params: type[P]
    run: Callable[[Hub, ClientConnection, P], MethodReply | Pieces | Later]
    right: Rights = Rights.READ  # the right that the client needs
    acts: bool = False
    """Whether the method has an effect other than its reply. Otherwise imud ignores a request without `id`."""
    result: Any = Any  # type of the result


# --- requests and replies -------------------------------------------------------------------------------------------


def handle_line(hub: Hub, connection: ClientConnection, line: bytes) -> None:
    """Carry out the request in `line` and send the reply. The connection stays open for every line."""
    try:
        request = parse_request(line)
    except RpcError as error:
        connection.post(encode_error(error))
        return
    try:
        method = METHODS.get(request.method)
        if method is None:
            message = unknown_name("a method", request.method[:64], list(METHODS))
            raise RpcError(Code.METHOD_NOT_FOUND, message)
        if method.right not in connection.rights:
            raise RpcError(Code.DENIED, f"{request.method}: expected root or a member of {hub.control_group}")
        if not request.wants_reply and not method.acts:
            return
        try:
            params = msgspec.convert(request.params, method.params)
        except msgspec.ValidationError:
            wrong = "; ".join(map(str, wrong_values(method.params, request.params, "parameter")))
            raise RpcError(Code.INVALID_PARAMS, f"{request.method}: {wrong}") from None
        reply = method.run(hub, connection, params)
    except RpcError as error:
        if request.wants_reply:
            connection.post(encode_error(RpcError(error.code, str(error), request.request_id)))
        return
    if isinstance(reply, Generator):
        connection.work_on(_reply_in_pieces(connection, request, reply))
    elif isinstance(reply, MethodReply):
        _send(connection, request, reply)
    else:  # the request continues if the client leaves
        hub.running[connection.number] = asyncio.create_task(_reply_later(hub, connection, request, reply))


def _send(connection: ClientConnection, request: RpcRequest, reply: MethodReply) -> None:
    if request.wants_reply:
        texts = connection.text_numbers and reply.big_numbers
        connection.post(encode_result(request.request_id, reply.result, texts=texts), reply.fd)
    if reply.framed_from_here:
        connection.framed = True


def _reply_in_pieces(connection: ClientConnection, request: RpcRequest, pieces: Pieces) -> Iterator[int]:
    reply = yield from pieces
    _send(connection, request, reply)


async def _reply_later(hub: Hub, connection: ClientConnection, request: RpcRequest, later: Later) -> None:
    REQUESTED_BY.set(f"uid {connection.peer.uid}")
    try:
        try:
            result = await later
            body = encode_result(request.request_id, result, texts=connection.text_numbers)
        except ImudError as error:
            body = encode_error(RpcError(Code.FAILED, str(error), request.request_id, error.data))
        if request.wants_reply:
            connection.post(body)
    except Exception as error:  # noqa: BLE001 - an internal error ends this client, not the daemon
        connection.on_failure(error)
    finally:
        hub.running.pop(connection.number, None)


# --- devices, status, schema ----------------------------------------------------------------------------------------
#
# The state of 256 devices takes several ms, and 10 ms more with big numbers as strings. That is too long for one turn
# of the event loop. imud encodes the state of a device when it reads it, a few devices in each turn. The states of two
# devices may be some turns apart. A device that is removed in the meantime is absent.


def _devices(hub: Hub, connection: ClientConnection, _params: NoParams) -> Pieces:
    rings = hub.context.outputs.rings
    summaries = (
        DeviceSummary(
            one.name, one.device_id, one.driver, one.link, one.state, one.problem, one.condition, one.identity,
            one.rate_hz, one.clock.sync, rings.get(one.name),
        )
        for one in hub.context.devices.each_status()
    )  # fmt: skip
    made = yield from _encoded(summaries, DEVICES_PER_PIECE, connection.text_numbers)
    return MethodReply(made, big_numbers=False)


def _status(hub: Hub, connection: ClientConnection, _params: NoParams) -> Pieces:
    texts = connection.text_numbers
    made = yield from _encoded(hub.context.devices.each_status(), DEVICES_PER_PIECE, texts)
    held_bytes = sum(map(len, made))
    clients = yield from _encoded(hub.each_client(), CLIENTS_PER_PIECE, texts, held_bytes)
    now_ns = hub.context.clock.now_ns()
    socket = msgspec.structs.asdict(hub.status(())) | {"clients": clients}
    result = {
        "now_ns": str(now_ns) if texts else now_ns, "devices": made, "socket": socket,
        "configuration": hub.context.configuration, "mqtt": [status() for status in hub.context.outputs.mqtts],
        "outputs": hub.context.outputs.problems(), "output_states": hub.context.outputs.states(),
        "c_kernel": CKernelStatus(kernel.present.module is not None, kernel.present.problem),
    }  # fmt: skip
    return MethodReply(result, big_numbers=False)


def _schema(hub: Hub, _connection: ClientConnection, _params: NoParams) -> Pieces:
    names: list[str] = []

    def frames() -> Iterator[DeviceFrame]:
        for device in hub.context.devices.each_status():
            names.append(device.name)
            yield _frame_of(device)

    made = yield from _encoded(frames(), DEVICES_PER_PIECE, texts=False)
    bounds, states = list(LATENCY_BOUNDS_NS), list(DeviceState)
    result = SchemaResult(PROTOCOL, list(SAMPLE_SCHEMA), {}, SLOT_SCHEMA, bounds, states)
    of_devices = {"devices": dict(zip(names, made, strict=True))}
    return MethodReply(msgspec.structs.asdict(result) | of_devices, big_numbers=False)


def _encoded(
    values: Iterable[object], per_piece: int, texts: bool, held_bytes: int = 0
) -> Generator[int, None, list[msgspec.Raw]]:
    """Encode `per_piece` values in each piece. `held_bytes` is the size of the earlier parts of the reply."""
    made: list[msgspec.Raw] = []
    for value in values:
        if made and not len(made) % per_piece:
            yield held_bytes
        body = encode(with_texts(value) if texts else value)
        held_bytes += len(body)
        made.append(msgspec.Raw(body))
    return made


def _frame_of(device: DeviceStatus) -> DeviceFrame:
    """Return the axes and angles of a device's samples. Without a known driver, optional members are absent."""
    known = DeviceFrame(device.driver, device.euler_convention, device.navigation_frame, device.status_bit_names)
    frame = device.frame
    if frame is not None:
        known.frame, known.convention, known.heading = frame.frame, frame.convention, frame.heading
        known.declination_deg, known.conventions = frame.declination_deg, frame.conventions
        known.attitude = frame.attitude
    return known


def _options(hub: Hub, connection: ClientConnection, params: OptionsParams) -> MethodReply:
    """Set the form of big numbers on this connection. A running `watch` does not change."""
    if params.big_numbers is not None:
        connection.text_numbers = params.big_numbers is BigNumbers.STRING
    form = BigNumbers.STRING if connection.text_numbers else BigNumbers.NUMBER
    return MethodReply(OptionsResult(form, hub.context.epoch))


# --- samples and events ---------------------------------------------------------------------------------------------


def _watch(hub: Hub, connection: ClientConnection, params: WatchParams) -> MethodReply:
    devices = _known_devices(hub, params.devices)
    fields = _known_fields(params.fields)
    rate_hz = _rate(params.rate_hz)
    form = params.encoding or Form.JSON
    framed = connection.framed or form is Form.BINARY
    latency_ms = _latency_ms(params.latency_ms, rate_hz)
    wanted = Subscription(
        devices, fields, rate_hz, form, framed, params.convention, connection.text_numbers,
        round(latency_ms * NS_PER_MS),
    )  # fmt: skip
    hub.subscribe(connection, wanted)
    numbers = hub.devices if devices is None else {name: hub.devices[name] for name in devices}
    result = WatchResult(form, dict(numbers), rate_hz, latency_ms, params.convention)
    return MethodReply(result, framed_from_here=form is Form.BINARY)


def _unwatch(hub: Hub, connection: ClientConnection, _params: NoParams) -> MethodReply:
    """Stop sending samples. imud still sends the queued samples."""
    hub.unsubscribe(connection)
    return MethodReply(NothingMore())


def _poll(hub: Hub, _connection: ClientConnection, params: PollParams) -> MethodReply:
    names = _known_devices(hub, params.devices) or tuple(hub.devices)
    fields = _known_fields(params.fields)
    newest = [_newest_of(hub.newest[name], params.convention) for name in names if name in hub.newest]
    samples = newest if fields is None else list(map(selector(fields), newest))
    return MethodReply(PollResult(hub.context.clock.now_ns(), samples, params.convention))


def _newest_of(batch: Batch, convention: Convention | None) -> Sample:
    rotation = None if convention is None else batch.frame.rotation_to(convention)
    sample = batch.samples[-1]
    return sample if rotation is None else rotation.sample(sample)


def _events(hub: Hub, connection: ClientConnection, params: EventsParams) -> MethodReply:
    devices = _known_devices(hub, params.devices)
    enable = params.enable is not False
    limit = EVENTS_MAX if params.limit is None else params.limit
    if not 1 <= limit <= EVENTS_MAX:
        raise RpcError(Code.INVALID_PARAMS, f"limit: expected 1 to {EVENTS_MAX}, got {limit}")
    result = EventsResult(enable)
    if params.since_ns is not None:
        past = hub.context.past_events.newest(params.since_ns, limit, devices)
        result = EventsResult(enable, past.events, past.since_ns)
    if enable:
        hub.subscribe_events(connection, devices)
    else:
        hub.unsubscribe_events(connection)
    return MethodReply(result)


def _history(hub: Hub, _connection: ClientConnection, params: HistoryParams) -> Pieces:
    names = _known("device", params.devices, hub.devices)
    points = POINTS_DEFAULT if params.points is None else params.points
    if len(names) > HISTORY_DEVICES_MAX:
        raise RpcError(Code.INVALID_PARAMS, f"devices: expected at most {HISTORY_DEVICES_MAX} names, got {len(names)}")
    if not 1 <= points <= POINTS_MAX:
        raise RpcError(Code.INVALID_PARAMS, f"points: expected 1 to {POINTS_MAX}, got {points}")
    if params.from_ns is not None and params.to_ns is not None and params.from_ns > params.to_ns:
        message = f"from_ns: expected at most to_ns ({params.to_ns}), got {params.from_ns}"
        raise RpcError(Code.INVALID_PARAMS, message)
    if hub.history is None:
        message = "history: the history is off; set `socket: {history: true}` in the configuration"
        raise RpcError(Code.UNAVAILABLE, message)
    return _history_of(hub.history, names, points, params)


def _history_of(history: History, names: Iterable[str], points: int, params: HistoryParams) -> Pieces:
    found: dict[str, list[msgspec.Raw]] = {}
    held_bytes = 0
    for name in names:
        records, frame = history.seconds(name), history.frame(name)
        newest_ns = end_ns(records) or 0
        to_ns = newest_ns if params.to_ns is None else min(params.to_ns, newest_ns)
        oldest_ns = to_ns - KEPT_S * NS_PER_S + 1
        from_ns = oldest_ns if params.from_ns is None else max(params.from_ns, oldest_ns)
        period_s = max(1, ceil((to_ns // NS_PER_S - from_ns // NS_PER_S + 1) / points))
        rotation = None if frame is None or params.convention is None else frame.rotation_to(params.convention)
        made = buckets(records, from_ns, to_ns, period_s, rotation)
        found[name] = yield from _encoded(made, BUCKETS_PER_PIECE, texts=False, held_bytes=held_bytes + len(records))
        held_bytes += sum(map(len, found[name]))
    result = HistoryResult(history.kept_s, {}, params.convention)
    return MethodReply(msgspec.structs.asdict(result) | {"devices": found}, big_numbers=False)


def _notify(hub: Hub, connection: ClientConnection, params: NotifyParams) -> MethodReply:
    _known_devices(hub, [params.device])
    latency_ms = _latency_ms(params.latency_ms, 0.0)
    fd = hub.make_waker(connection, params.device, round(latency_ms * NS_PER_MS))
    return MethodReply(NotifyResult(params.device, latency_ms), fd)


# --- commands, calibrations, settings -------------------------------------------------------------------------------


def _control(hub: Hub, device: str, connection: ClientConnection | None = None, method: str = "") -> DeviceControl:
    """Return the control of a device, for a `method` that takes time if given.

    Raises RpcError if the device is unknown, or if the previous request of the connection is not finished.
    """
    _known("device", [device], hub.devices)
    if connection is not None and connection.number in hub.running:
        message = f"{method}: the previous request of this connection is not finished; wait for its reply"
        raise RpcError(Code.UNAVAILABLE, message)
    return hub.context.devices.control(device)


def _actions(hub: Hub, _connection: ClientConnection, params: DeviceParams) -> MethodReply:
    return MethodReply(described(_control(hub, params.device).verbs))


def _command(hub: Hub, connection: ClientConnection, params: CommandParams) -> Later:
    control = _control(hub, params.device, connection, "command")
    _check_name("command", params.name)
    return control.act(params.name, params.arguments or {})


def _calibrations(hub: Hub, _connection: ClientConnection, params: DeviceParams) -> MethodReply:
    control = _control(hub, params.device)
    return MethodReply(infos(control.calibrations, control.last_calibrations))


def _calibrate(hub: Hub, connection: ClientConnection, params: CalibrateParams) -> Later:
    control = _control(hub, params.device, connection, "calibrate")
    _check_name("calibrate", params.kind)
    return control.calibrate(params.kind, save=bool(params.save))


def _firmware_open(hub: Hub, connection: ClientConnection, params: FirmwareOpenParams) -> MethodReply:
    fd = hub.firmware.open(connection, params.size_bytes)
    return MethodReply(FirmwareOpenResult(params.size_bytes), fd)


def _firmware_update(hub: Hub, connection: ClientConnection, params: FirmwareUpdateParams) -> Later:
    control = _control(hub, params.device, connection, "firmware.update")
    image = FirmwareImage(params.address, hub.firmware.take(connection.number, params.crc32))
    product, version = params.product or "", params.version or ""
    return hub.firmware.alone(params.device, connection.uid, lambda: control.firmware.update(image, product, version))


def _stop_calibration(hub: Hub, _connection: ClientConnection, params: DeviceParams) -> MethodReply:
    """Stop the running calibration of a device, also if another client started it."""
    return MethodReply(StopResult(_control(hub, params.device).stop_calibration()))


def _settings(hub: Hub, connection: ClientConnection, params: SettingsParams) -> Later:
    control = _control(hub, params.device)
    if params.fresh:
        if Rights.CONTROL not in connection.rights:
            message = f"settings.get: for fresh, expected root or a member of {hub.control_group}"
            raise RpcError(Code.DENIED, message)
        _control(hub, params.device, connection, "settings.get")
    return control.settings.report(fresh=bool(params.fresh))


def _settings_change(method: str, hub: Hub, connection: ClientConnection, params: SettingsChangeParams) -> Later:
    settings = _control(hub, params.device, connection, method).settings
    change = settings.plan if method == "settings.plan" else settings.apply
    return change(params.settings, save=bool(params.save))


def _check_name(method: str, name: str) -> None:
    if len(name) > NAME_MAX or not name.isprintable():
        raise RpcError(Code.INVALID_PARAMS, f"{method}: expected a name of at most {NAME_MAX} printable characters")


# --- recordings -----------------------------------------------------------------------------------------------------


def _record_start(hub: Hub, connection: ClientConnection, params: RecordParams) -> MethodReply:
    devices = _known_devices(hub, params.devices)
    fd = hub.recordings.start(connection, devices)
    return MethodReply(RecordResult(None if devices is None else list(devices)), fd)


def _record_stop(hub: Hub, connection: ClientConnection, _params: NoParams) -> MethodReply:
    return MethodReply(RecordStopResult(*hub.recordings.stop(connection)))


def _record_snapshot(hub: Hub, connection: ClientConnection, _params: NoParams) -> MethodReply:
    seconds, fd = hub.recordings.snapshot(connection)
    return MethodReply(SnapshotResult(seconds), fd)


METHODS: Final[Mapping[str, Method[Any]]] = {
    "devices": Method(NoParams, _devices, result=list[DeviceSummary]),
    "status": Method(NoParams, _status, result=StatusResult),
    "schema": Method(NoParams, _schema, result=SchemaResult),
    "options": Method(OptionsParams, _options, acts=True, result=OptionsResult),
    "watch": Method(WatchParams, _watch, acts=True, result=WatchResult),
    "unwatch": Method(NoParams, _unwatch, acts=True, result=NothingMore),
    "poll": Method(PollParams, _poll, result=PollResult),
    "events": Method(EventsParams, _events, acts=True, result=EventsResult),
    "history": Method(HistoryParams, _history, result=HistoryResult),
    "notify": Method(NotifyParams, _notify, result=NotifyResult),
    "actions": Method(DeviceParams, _actions, result=list[VerbInfo]),
    "command": Method(CommandParams, _command, Rights.CONTROL, acts=True),
    "calibrations": Method(DeviceParams, _calibrations, result=list[CalibrationInfo]),
    "calibrate": Method(CalibrateParams, _calibrate, Rights.CONTROL, acts=True, result=CalibrationResult),
    "firmware.open": Method(FirmwareOpenParams, _firmware_open, Rights.CONTROL, result=FirmwareOpenResult),
    "firmware.update": Method(FirmwareUpdateParams, _firmware_update, Rights.CONTROL, acts=True, result=FirmwareResult),
    "settings.get": Method(SettingsParams, _settings, result=SettingsReport),
    "settings.plan": Method(
        SettingsChangeParams, partial(_settings_change, "settings.plan"), Rights.CONTROL, result=SettingsPlan
    ),
    "settings.apply": Method(
        SettingsChangeParams,
        partial(_settings_change, "settings.apply"),
        Rights.CONTROL,
        acts=True,
        result=AppliedSettings,
    ),
    "stop_calibration": Method(DeviceParams, _stop_calibration, Rights.CONTROL, acts=True, result=StopResult),
    "record.start": Method(RecordParams, _record_start, Rights.CONTROL, result=RecordResult),
    "record.stop": Method(NoParams, _record_stop, Rights.CONTROL, acts=True, result=RecordStopResult),
    "record.snapshot": Method(NoParams, _record_snapshot, Rights.CONTROL, result=SnapshotResult),
}


# --- parameters -----------------------------------------------------------------------------------------------------


def _known_devices(hub: Hub, names: list[str] | None) -> tuple[str, ...] | None:
    """Return the names without repetition; None for all devices. Raises RpcError."""
    return None if names is None else _known("device", names, hub.devices)


def _known_fields(names: list[str] | None) -> tuple[str, ...] | None:
    """Return the names in the order of `schema`; None for all fields. Raises RpcError."""
    if names is None:
        return None
    known = set(_known("field", names, SAMPLE_FIELDS))
    return tuple(name for name in SAMPLE_FIELDS if name in known)  # one order: imud encodes a selection once


def _known(kind: str, names: list[str], known: Collection[str]) -> tuple[str, ...]:
    if not names:
        raise RpcError(Code.INVALID_PARAMS, f"{kind}s: expected at least one name; leave `{kind}s` out for all")
    for name in names:
        if name not in known:
            raise RpcError(Code.INVALID_PARAMS, unknown_name(f"a {kind}", name[:64], list(known)))
    return tuple(dict.fromkeys(names))


def _rate(rate_hz: float | None) -> float:
    """Return the rate, Hz; 0.0 for every sample. Raises RpcError."""
    if not rate_hz:
        return 0.0
    if not RATE_MIN_HZ <= rate_hz <= RATE_MAX_HZ:  # false for NaN too
        message = f"rate_hz: expected 0 (every sample) or {RATE_MIN_HZ} … {RATE_MAX_HZ}, got {rate_hz}"
        raise RpcError(Code.INVALID_PARAMS, message)
    return float(rate_hz)


def _latency_ms(latency_ms: float | None, rate_hz: float) -> float:
    """Return the latency, ms. The default is a period of the rate, and 0 for every sample. Raises RpcError."""
    if latency_ms is None:
        return min(1000.0 / rate_hz, LATENCY_OF_RATE_MAX_MS) if rate_hz else 0.0
    if not 0 <= latency_ms <= LATENCY_MAX_MS:  # false for NaN too
        message = f"latency_ms: expected 0 (no delay) … {LATENCY_MAX_MS}, got {latency_ms}"
        raise RpcError(Code.INVALID_PARAMS, message)
    return float(latency_ms)
