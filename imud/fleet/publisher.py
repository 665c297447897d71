"""Output `mqtt`: the part in the event loop, which only puts samples, events and states into a queue.

    loop: publish, event, tick ──▶ WriterQueue ──▶ writer (thread: messages, spool) ──▶ sender (thread: broker)

docs/fleet.md describes the messages. A lock file keeps other daemons from using the same spool.
"""

import fcntl
import logging
import math
import os
import socket
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final
from zlib import crc32

import msgspec

from imud import __version__
from imud.contracts.condition import Condition, signature
from imud.contracts.publisher import Batch, PublisherContext
from imud.contracts.status import DeviceState, DeviceStatus, MqttStatus
from imud.fleet.broker import BROKER_LIMITS, BrokerTurn, Connect, PahoConnection, Will, check_extra
from imud.fleet.commands import CommandChannel
from imud.fleet.messages import (
    SCHEMA,
    SETTINGS,
    STATE,
    STATUS,
    VERSION,
    Stream,
    boot_text,
    topic_of,
)
from imud.fleet.sender import MqttSender
from imud.fleet.settings import LOCALHOST, STATUS_S, DeviceSending, MqttOptions, broker_of, is_name
from imud.fleet.spool import Spool
from imud.fleet.streams import Gateway, gateway_clock
from imud.fleet.writer import SentState, SpoolWriter, WriterQueue
from imud.formats.slot import PRESENT_BITS, SLOT_BYTES, SLOT_FIELDS, SLOT_LAYOUT_VERSION, SYNC_CODES
from imud.host.threads import BusThread, StartWorker
from imud.model.errors import ServerError, reason_of
from imud.model.event import Event, EventKind
from imud.model.sample import SAMPLE_SCHEMA
from imud.model.staleness import STALE_MIN_NS, STALE_PERIODS, is_stale
from imud.model.units import NS_PER_S
from imud.model.work_budget import WorkBudget

PREFIX: Final = "homeassistant"  # default prefix of the discovery topics of Home Assistant
DEG_PER_RAD: Final = "57.29577951308232"  # 180 / π, for templates
TEMPERATURE: Final = "temperature"  # name of an entity
ANGLES: Final = ("roll", "pitch", "yaw")  # components of `euler_rad`


def discovery_topic(gateway: Gateway, device: str) -> str:
    """Return the discovery topic. Its checksum distinguishes device `c` of gateway `a_b` from `b_c` of `a`."""
    return f"{PREFIX}/device/{_unique_id(gateway, device)}/config"


def discovery_of(
    gateway: Gateway, status: DeviceStatus, sending: DeviceSending, status_s: float = STATUS_S
) -> Mapping[str, object]:
    """Return the discovery message of a device with all entities. `status_s` is the interval of the status messages, s.

    Home Assistant marks an entity as unavailable if no message arrives for three intervals, and each value of a sample
    also while the device sends no samples.
    """
    unique_id = _unique_id(gateway, status.name)
    topic = topic_of(gateway.site, gateway.gateway, status.name, STATUS)
    parts = _status_parts(topic)
    for part in parts.values():
        part["expire_after"] = _expiry_s(status_s)
    if sending.rate_hz and "mean" in sending.values:
        angles = _attitude_parts(topic_of(gateway.site, gateway.gateway, status.name, Stream.STATISTICS))
        for part in angles.values():
            part["expire_after"] = _expiry_s(max(sending.batch_s, 1 / sending.rate_hz))
        parts |= angles

    of_gateway = {
        "topic": topic_of(gateway.site, gateway.gateway, "", STATE),
        "value_template": "{{ 'online' if value_json.online else 'offline' }}",
    }
    of_samples = {
        "topic": topic,
        "value_template": f"{{{{ 'online' if value_json.state == '{DeviceState.RUNNING}' else 'offline' }}}}",
    }
    for name in (TEMPERATURE, *ANGLES):
        if name in parts:
            parts[name] |= {"availability": [of_gateway, of_samples], "availability_mode": "all"}
    identity = {
        key: status.identity[name]
        for key, name in (("model", "product"), ("serial_number", "serial_number"), ("sw_version", "firmware"))
        if status.identity.get(name)
    }
    return {
        "device": {"identifiers": [unique_id], "name": f"{gateway.gateway} {status.name}", **identity},
        "origin": {"name": "imud", "sw_version": __version__},
        "availability": [of_gateway],
        "components": {name: {**part, "unique_id": f"{unique_id}_{name}"} for name, part in parts.items()},
        "qos": 1,
    }


def _expiry_s(period_s: float) -> int:
    """Return the time without a message after which Home Assistant marks an entity as unavailable, s."""
    return math.ceil(max(STALE_PERIODS * period_s, STALE_MIN_NS / NS_PER_S))


def _unique_id(gateway: Gateway, device: str) -> str:
    whole = f"{gateway.site}/{gateway.gateway}/{device}"
    return f"imud_{gateway.gateway}_{device}_{crc32(whole.encode()):08x}"


def _status_parts(topic: str) -> dict[str, dict[str, object]]:
    """Return the entities of the retained state."""
    diagnostic = {"state_topic": topic, "entity_category": "diagnostic"}
    return {
        "condition": {
            "platform": "sensor", "name": "Condition", "device_class": "enum", "options": list(Condition),
            **diagnostic, "value_template": "{{ value_json.condition.condition }}",
            "json_attributes_topic": topic, "json_attributes_template": "{{ value_json.condition | tojson }}",
        },
        "problem": {
            "platform": "binary_sensor", "name": "Problem", "device_class": "problem", **diagnostic,
            "value_template": f"{{{{ 'OFF' if value_json.condition.condition == '{Condition.OK}' else 'ON' }}}}",
        },
        "rate": {
            "platform": "sensor", "name": "Sample rate", "device_class": "frequency", "state_class": "measurement",
            "unit_of_measurement": "Hz", **diagnostic, "value_template": "{{ value_json.rate_hz | round(1) }}",
        },
        TEMPERATURE: {
            "platform": "sensor", "name": "Temperature", "device_class": "temperature", "state_class": "measurement",
            "unit_of_measurement": "°C", "state_topic": topic,
            "value_template": "{{ value_json.temperature_c | round(1) if value_json.temperature_c is number else '' }}",
        },
    }  # fmt: skip


def _attitude_parts(topic: str) -> dict[str, dict[str, object]]:
    """Return the entities of the mean attitude in the newest interval. Their templates return an empty value for a
    message without intervals and for a device without angles. Home Assistant ignores empty values."""
    found: dict[str, dict[str, object]] = {}
    for at, name in enumerate(ANGLES):
        newest = "value_json.intervals[-1]['values']"
        value = f"({newest}.euler_rad.mean[{at}] * {DEG_PER_RAD}) | round(2)"
        found[name] = {
            "platform": "sensor", "name": name.capitalize(), "state_class": "measurement", "unit_of_measurement": "°",
            "state_topic": topic, "suggested_display_precision": 1,
            "value_template": (
                f"{{{{ {value} if 'intervals' in value_json and 'euler_rad' in {newest} else '' }}}}"
            ),
        }  # fmt: skip
    return found


log = logging.getLogger(__name__)

LOCK: Final = "lock"
# Minimum time between two state messages, ns. The state of one device costs the event loop 0.6 ms.
STATE_NS: Final = NS_PER_S
# Time without an acknowledgement while messages wait, after which it is a problem, ns
UNDELIVERED_NS: Final = 10 * NS_PER_S
# Events that change the state of a device
STATE_KINDS: Final = frozenset(
    (
        EventKind.UP,
        EventKind.DOWN,
        EventKind.CONDITION,
        EventKind.SYNC,
        EventKind.CONFIGURATION,
        EventKind.ALARM,
        EventKind.ATTITUDE,
    )
)


class MqttPublisher:
    """Output `mqtt`. Synchronization: the event loop's thread only."""

    def __init__(
        self, settings: MqttOptions, context: PublisherContext, *, connect: Connect = PahoConnection,
        start_worker: StartWorker = BusThread, host_name: Callable[[], str] = socket.gethostname,
    ) -> None:  # fmt: skip
        self._settings = settings
        self._context = context
        self._connect, self._start_worker, self._host_name = connect, start_worker, host_name
        self._queue = WriterQueue()
        self._gateway = Gateway("", "", "")
        self._spool: Spool | None = None
        self._sender: MqttSender | None = None
        self._writer: SpoolWriter | None = None
        self._commands: CommandChannel | None = None
        self._names: set[str] = set()
        self._sent: set[str] = set()  # devices with messages
        self._known: dict[str, object] = {}  # published state, problem and axes of each device
        self._settings_known: dict[str, dict[str, object]] = {}  # published settings of each device
        self._state_ns = self._all_ns = 0
        self._is_changed = True  # True after an event of STATE_KINDS
        self._arrivals_ns: dict[str, int] = {}  # CLOCK_MONOTONIC of the newest samples of each device
        self._stale: set[str] = set()  # devices without current samples in their published status
        self._acknowledged = 0  # value of the sender's counter at `_delivery_ns`
        self._delivery_ns = 0  # CLOCK_MONOTONIC of the newest acknowledgement, or since messages wait
        self._budget = WorkBudget(BROKER_LIMITS, context.clock.cpu_ns)  # used in the thread of the sender
        self._is_first = True  # True before the first states
        self._spool_problem = self._problem = ""
        self._refused: Mapping[str, str] = {}  # reported topics that the broker refuses
        self._lock = -1

    # --- publisher ----------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Open the spool and start both threads. Raises ServerError."""
        if self._connect is PahoConnection:
            check_extra()
        settings, context = self._settings, self._context
        gateway = settings.gateway or self._host_name().partition(".")[0]
        if not is_name(gateway) or gateway.lower() in LOCALHOST:
            raise ServerError(
                f"mqtt.gateway: expected 1 to 64 letters, digits, '_' or '-', and a name that no other gateway has, "
                f"got the host name {gateway!r}; set mqtt.gateway"
            )
        self._gateway = Gateway(settings.site, gateway, boot_text(context.epoch))
        directory = Path(settings.spool_directory)
        self._lock_spool(directory)
        will = Will(topic_of(settings.site, gateway, "", STATE), self._state(online=False, reason="connection lost"))
        brokers = [found for url in settings.brokers if (found := broker_of(url)) is not None]
        turn = BrokerTurn(brokers, settings.retry_max_s)
        self._spool = Spool(
            directory, settings.spool_bytes, settings.spool_age_ns, newest_first=settings.newest_first, gateway=gateway
        )  # fmt: skip
        client_id = f"imud-{settings.site}-{gateway}"
        now_ns, utc_offset_ns = context.clock.now_ns, context.clock.utc_offset_ns
        self._sender = MqttSender(settings, client_id, will, turn, self._connect, now_ns)
        self._sender.budget = self._budget
        self._delivery_ns = now_ns()
        if settings.commands.enabled:
            self._commands = CommandChannel(
                settings.commands, self._gateway, context.devices.control, now_ns, utc_offset_ns
            )
            self._commands.answer = self._sender.reply
            self._commands.may_reply = self._sender.may_reply
            self._sender.commands = self._commands
        self._writer = SpoolWriter(settings, self._gateway, self._queue, self._spool, self._sender, context.clock)
        self._writer.start(self._start_worker)
        lock, self._lock = self._lock, -1
        self._writer.closed = lambda: os.close(lock)  # if the disk blocks the writer, its thread keeps the lock
        self._sender.retain({will.topic: self._state(online=True)})
        self._sender.start()
        context.outputs.mqtts.append(self.status)
        log.info("mqtt: %s as imud/%s/%s", ", ".join(broker.name for broker in brokers), settings.site, gateway)

    def add_device(self, name: str, device_id: int) -> None:
        self._names.add(name)
        if is_name(name) and self._settings.sending(name) is not None:
            self._sent.add(name)

    def remove_device(self, name: str) -> None:
        """Remove a device, and its retained messages from the broker."""
        self._names.discard(name)
        self._sent.discard(name)
        self._arrivals_ns.pop(name, None)
        self._stale.discard(name)
        topics = []
        if self._known.pop(name, None) is not None:
            topics += [self._topic(name, STATUS), self._topic(name, SCHEMA)]
            if self._settings.home_assistant:
                topics.append(discovery_topic(self._gateway, name))
        if self._settings_known.pop(name, None) is not None:
            topics.append(self._topic(name, SETTINGS))
        if topics:
            self._queue.put_state(SentState({}, dict.fromkeys(topics)))

    def publish(self, batch: Batch) -> None:
        if batch.device in self._sent:
            self._arrivals_ns[batch.device] = self._context.clock.now_ns()
            self._queue.put_batch(batch)

    def event(self, event: Event) -> None:
        self._is_changed = self._is_changed or event.kind in STATE_KINDS
        if not event.device or event.device in self._sent:
            self._queue.put_event(event)

    def tick(self, now_ns: int) -> None:
        """Check both threads and publish states. Raises the exception that ended a thread."""
        writer, sender = self._writer, self._sender
        if writer is None or sender is None:
            return
        failure = writer.failure or sender.failure
        if failure is not None:
            raise failure
        self._report_problems(now_ns, writer, sender)
        self._note_delivery(now_ns, sender)
        if self._commands is not None:
            self._commands.run_next()
            self._context.owner.tick_soon()  # a request can arrive at any time
        if now_ns - self._state_ns >= STATE_NS:
            self._state_ns = now_ns
            self._send_states(now_ns)

    def close(self) -> None:
        """End both threads. A second call does nothing."""
        sender, self._sender = self._sender, None
        writer, self._writer = self._writer, None
        if self.status in self._context.outputs.mqtts:
            self._context.outputs.mqtts.remove(self.status)
        if self._commands is not None:
            self._commands.close()
        if sender is not None:
            sender.close(self._state(online=False, reason="imud stopped"))
        if writer is not None:
            writer.close()
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def status(self) -> MqttStatus:
        writer, sender, spool = self._writer, self._sender, self._spool
        if writer is None or sender is None or spool is None:
            return MqttStatus("", "", "", self._queue.queued, 0, 0, 0, 0, 0, 0, {}, 0)
        dropped = dict(spool.dropped)
        commands = self._commands
        for cause, count in (("queue", self._queue.dropped), ("disk", writer.lost_on_disk)):
            dropped[cause] = dropped.get(cause, 0) + count
        now_ns = self._context.clock.now_ns()
        limits = (sender.limit, self._budget.problem(now_ns))
        return MqttStatus(
            sender.broker, sender.problem or self._missing_delivery(now_ns), writer.problem,
            self._queue.queued, spool.spooled, sender.sent,
            sender.acknowledged, spool.messages, spool.used_bytes, spool.thinned, dropped, sender.reconnects,
            commands.run if commands is not None else 0, commands.refused if commands is not None else 0,
            dict(sender.refused), sender.replies_lost, "; ".join(filter(None, limits)),
        )  # fmt: skip

    def _note_delivery(self, now_ns: int, sender: MqttSender) -> None:
        """Store the time of the newest delivery. A refused topic has its own problem in the status."""
        has_due = self._spool is not None and self._spool.messages > 0 and not sender.refused
        if sender.acknowledged != self._acknowledged or not has_due:
            self._acknowledged = sender.acknowledged
            self._delivery_ns = now_ns

    def _missing_delivery(self, now_ns: int) -> str:
        """Return the problem if messages wait and the broker has acknowledged none for a long time."""
        slowest_hz = self._settings.messages_per_s
        limit_ns = UNDELIVERED_NS if slowest_hz is None else max(UNDELIVERED_NS, round(3 * NS_PER_S / slowest_hz))
        silent_ns = now_ns - self._delivery_ns
        if silent_ns < limit_ns or self._spool is None:
            return ""
        return (
            f"no delivery for {silent_ns // NS_PER_S} s: {self._spool.messages} messages wait, and the broker has "
            "acknowledged none; check the broker"
        )

    # --- states ------------------------------------------------------------------------------------------------------

    def _send_states(self, now_ns: int) -> None:
        """Publish changed states of devices, and every `status_s` all states."""
        is_due = now_ns - self._all_ns >= self._settings.status_s * NS_PER_S
        self._is_changed = self._is_changed or self._has_changed_samples(now_ns)
        if not is_due and not self._is_changed:
            return
        self._is_changed = False
        statuses: dict[str, DeviceStatus] = {}
        other: dict[str, object] = {}
        if self._is_first:
            self._is_first = False
            other |= dict.fromkeys(self._left_over())
        for status in self._context.devices.status():
            sending = self._settings.sending(status.name)
            if status.name not in self._sent or sending is None:
                continue
            if sending.settings:
                other |= self._changed_settings(status)
            if not sending.status:
                continue
            is_without_samples = self._update_stale(status, now_ns)
            frame = status.frame
            known = (
                status.state.value, status.problem, repr(frame), signature(status.condition), is_without_samples,
            )  # fmt: skip
            if is_due or self._known.get(status.name) != known:
                current = without_values(status) if is_without_samples else status
                statuses[self._topic(status.name, STATUS)] = current
                other[self._topic(status.name, SCHEMA)] = schema_of(status)
                if self._settings.home_assistant:
                    other[discovery_topic(self._gateway, status.name)] = discovery_of(self._gateway, status, sending)
                self._known[status.name] = known
        if is_due:
            self._all_ns = now_ns
            state = msgspec.json.decode(self._state(online=True))
            other[self._topic("", STATE)] = state | {"mqtt": self.status(), "positions": self._positions()}
        if statuses or other:
            self._queue.put_state(SentState(statuses, other))

    def _has_changed_samples(self, now_ns: int) -> bool:
        """Return whether a device may have become stale, or sends samples again. Its status then decides."""
        return any(
            is_stale(arrival_ns, now_ns, 0) != (name in self._stale) for name, arrival_ns in self._arrivals_ns.items()
        )

    def _update_stale(self, status: DeviceStatus, now_ns: int) -> bool:
        """Return whether the values in the status of a device are stale."""
        arrival_ns = self._arrivals_ns.get(status.name)
        if arrival_ns is None:
            return False
        period_ns = round(NS_PER_S / status.expected_rate_hz) if status.expected_rate_hz > 0 else 0
        is_device_stale = is_stale(arrival_ns, now_ns, period_ns)
        if is_device_stale:
            self._stale.add(status.name)
        else:
            self._stale.discard(status.name)
        return is_device_stale

    def _left_over(self) -> set[str]:
        """Return the retained topics of this gateway from earlier runs that the configuration no longer contains."""
        mine = (self._topic("", STATE).removesuffix(STATE), f"{PREFIX}/device/imud_{self._gateway.gateway}_")
        wanted = {self._topic("", STATE)}
        for name in self._sent:
            sending = self._settings.sending(name)
            if sending is not None and sending.status:
                wanted |= {self._topic(name, STATUS), self._topic(name, SCHEMA)}
                wanted |= {discovery_topic(self._gateway, name)} if self._settings.home_assistant else set()
            if sending is not None and sending.settings:
                wanted.add(self._topic(name, SETTINGS))
        former = self._writer.former if self._writer is not None else ()
        return {topic for topic in former if topic.startswith(mine) and topic not in wanted}

    def _changed_settings(self, status: DeviceStatus) -> dict[str, object]:
        """Return the message about the settings of a device; empty if they did not change."""
        found = settings_of(status)
        if found is None or self._settings_known.get(status.name) == found:
            return {}
        self._settings_known[status.name] = found
        return {self._topic(status.name, SETTINGS): found}

    def _positions(self) -> list[object]:
        return list(self._writer.positions) if self._writer is not None else []

    def _topic(self, device: str, leaf: str) -> str:
        return topic_of(self._settings.site, self._gateway.gateway, device, leaf)

    def _state(self, *, online: bool, reason: str = "") -> bytes:
        """Return the state of the gateway: birth, death or last will."""
        found: dict[str, object] = {"v": VERSION, "online": online, "boot": boot_text(self._context.epoch)}
        if online:
            found |= {"imud": __version__, "devices": sorted(self._sent), "clock": gateway_clock(self._context.clock)}
            found["status_s"] = self._settings.status_s
        else:
            found["reason"] = reason
        return msgspec.json.encode(found)

    # --- problems -----------------------------------------------------------------------------------------------------

    def _report_problems(self, now_ns: int, writer: SpoolWriter, sender: MqttSender) -> None:
        """Report changes of the spool as events, and changes of the connection in the log."""
        if writer.problem != self._spool_problem:
            before, self._spool_problem = self._spool_problem, writer.problem
            if not before:
                self._raise(now_ns, f"the spool failed: {writer.problem}; the other outputs continue")
            elif not writer.problem:
                self._raise(now_ns, f"the spool works again after: {before}")
        spool = self._spool
        if spool is not None and spool.set_aside:
            self._raise(
                now_ns, f"the spool was damaged; imud created a new spool and renamed the old one to {spool.set_aside}"
            )
            spool.set_aside = ""
        before_refused, self._refused = self._refused, sender.refused
        for topic in sender.refused.keys() - before_refused.keys():
            self._raise(
                now_ns, f"the broker refuses messages of {topic}: {sender.refused[topic]}; imud sends all other "
                "messages and tries this topic again later",
            )  # fmt: skip
        for topic in before_refused.keys() - sender.refused.keys():
            self._raise(now_ns, f"the broker accepts messages of {topic} again")
        if sender.problem != self._problem:
            self._problem = sender.problem
            if sender.problem:
                log.warning("mqtt: cannot send: %s", sender.problem)
            else:
                log.info("mqtt: connected to %s", sender.broker)

    def _raise(self, now_ns: int, message: str) -> None:
        log.warning("mqtt: %s", message)
        self._context.owner.send_event(Event(now_ns, "", EventKind.MQTT, message))

    def _lock_spool(self, directory: Path) -> None:
        """Lock the spool against another daemon. Raises ServerError."""
        try:
            directory.mkdir(mode=0o750, parents=True, exist_ok=True)
            self._lock = os.open(directory / LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o640)
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._lock)
            self._lock = -1
            raise ServerError(
                f"{directory}: another imud process uses this spool; set mqtt.spool_directory to another folder"
            ) from None
        except OSError as error:
            raise ServerError(
                f"cannot use {directory}: {reason_of(error)}; expected a directory that imud can write; "
                f"set mqtt.spool_directory"
            ) from error


def without_values(status: DeviceStatus) -> DeviceStatus:
    """Return the status without the values of the newest sample, because they are stale."""
    return msgspec.structs.replace(
        status, rate_hz=0.0, temperature_c=None, status_bits=None, status_words=(), position=None
    )


def schema_of(status: DeviceStatus) -> Mapping[str, object]:
    """Return the description of samples and slots of a device for readers."""
    return {
        "v": VERSION,
        "device": status.name,
        "driver": status.driver,
        "identity": status.identity,
        "euler_convention": status.euler_convention,
        "navigation_frame": status.navigation_frame,
        "frame": status.frame,
        "fields": SAMPLE_SCHEMA,
        "slot": {
            "version": SLOT_LAYOUT_VERSION,
            "bytes": SLOT_BYTES,
            "byte_order": "little-endian",
            "fields": [
                {"name": one.name, "code": one.code, "count": one.count, "offset": one.offset} for one in SLOT_FIELDS
            ],
            "present_bits": PRESENT_BITS,
            "sync_codes": {sync.value: code for sync, code in SYNC_CODES.items()},
        },
    }


def settings_of(status: DeviceStatus) -> dict[str, object] | None:
    """Return the settings of a device and their differences from the declared settings; None if they are unknown."""
    declared = status.declared
    if declared is None and not status.settings:
        return None
    found: dict[str, object] = {"v": VERSION, "device": status.name, "actual": dict(status.settings)}
    if declared is not None:
        found |= {
            "state": declared.state,
            "on_difference": declared.on_difference,
            "differences": dict(declared.differences),
            "unverified": list(declared.unverified),
            "problem": declared.problem,
        }
    return found
