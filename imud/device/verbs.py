"""Execution of the verbs of one device, and the evidence for their effects."""

import asyncio
from collections.abc import Mapping
from typing import Any, Final

from msgspec.structs import replace as with_fields

from imud.contracts.command import (
    Proof,
    Risk,
    Verb,
    VerbResult,
)
from imud.device.attachments import Attachments
from imud.device.calibration import RestWindow, check
from imud.device.evidence import STEP_S
from imud.device.settings import DeviceSettings
from imud.device.settings_plan import Values, as_json
from imud.device.transport import Transport
from imud.model.errors import BadArgument, ImudError
from imud.model.options import Options
from imud.model.options import shown as json_words
from imud.model.units import RAD_PER_DEG

# Evidence that a device which sends samples anyway also causes
NEED_QUIET: Final = frozenset((Proof.STREAM, Proof.ONE_SAMPLE))
CHANGES_MAX: Final = 5  # maximum number of changed settings in the evidence of a reset


class VerbRun:
    """Execution of verbs. Synchronization: the loop's thread only."""

    def __init__(self, settings: DeviceSettings, transport: Transport) -> None:
        self._settings = settings
        self._transport = transport
        self._samples = transport.samples

    # --- a verb -----------------------------------------------------------------------------------------------------

    async def run(self, name: str, verb: Verb, given: Mapping[str, Any]) -> object:
        """Run a verb of the driver and return its result: a value, or a `VerbResult` if the verb has an effect.

        Raises CommandError, TransferError, DeviceRefused, LinkError.
        """
        settings, arguments = self._settings, verb.arguments(given)
        async with settings.lock.hold(f"the command {name}"):
            if verb.heading:
                arguments = self._with_device_yaw(verb, arguments)
            if verb.saves:
                settings.spend_flash()
            if verb.risk is Risk.RESET:
                await settings.back_up(name)
            before, was_unsaved = settings.values, settings.is_unsaved
            is_quiet = await self._samples.is_quiet() if verb.proof in NEED_QUIET else True
            agreed_before = verb.proof is Proof.SAMPLES and self._agrees_now(verb, arguments)
            self._samples.mark()
            restarts, unsaved = verb.effect_on_flash(arguments)
            answer = await self._changed(verb, arguments, restarts=restarts, unsaved=unsaved)
            if verb.proof is Proof.VALUE:
                return answer
            result = answer.result if isinstance(answer, VerbResult) else answer
            verified, evidence = await self._judge(verb, arguments, answer, restarts=restarts, is_quiet=is_quiet)
            if verb.proof is Proof.SETTINGS:
                after = settings.values if settings.is_current else {}
                verified, evidence = _reset(before, after, was_unsaved)
            if verified and agreed_before:
                verified = None
                evidence = f"{evidence}, as before the command, so the samples do not show its effect"
            if restarts and before and verb.proof is not Proof.SETTINGS and (lost := _changes(before, settings.values)):
                verified, evidence = verified is not False, f"{evidence}; the restart changed settings: {lost}"
            not_saved = settings.not_saved if unsaved else ""
            return VerbResult(verified is True, evidence, result, not_saved, failed=verified is False)

    async def _judge(
        self, verb: Verb, arguments: Options, answer: object, *, restarts: bool, is_quiet: bool
    ) -> tuple[bool | None, str]:
        """Return whether the verb had its effect, None: unknown, and the observation.

        `answer`: result of the script. `is_quiet`: whether no sample arrived before the verb.
        """
        if isinstance(answer, VerbResult):  # the script has checked the effect
            if answer.verified and not restarts and await self._samples.has_restarted():
                return False, "the device restarted during the command"
            return answer.verified or (False if answer.failed else None), answer.evidence
        match verb.proof:
            case Proof.SCRIPT:
                return True, verb.evidence
            case Proof.SAMPLES:
                return await self._agrees(verb, arguments)
            case Proof.RESTART | Proof.STREAM | Proof.ONE_SAMPLE:
                return await self._samples.evidence(verb.proof, is_quiet)
        return None, verb.evidence

    async def run_line(self, name: str, given: Mapping[str, Any], attachments: Attachments) -> VerbResult:
        """Run a verb of the GPIO lines and return its evidence. Raises BadArgument, CommandError."""
        proof = attachments.verbs[name].proof
        is_quiet = await self._samples.is_quiet() if proof in NEED_QUIET else True
        self._samples.mark()
        await attachments.run_verb(name, given)
        verified, evidence = await self._samples.evidence(proof, is_quiet)
        return VerbResult(verified is True, evidence, failed=verified is False)

    async def _changed(self, verb: Verb, arguments: Options, *, restarts: bool, unsaved: bool) -> object:
        """Run the script, and read the values that it can change."""
        settings = self._settings
        settings.script_follows(changes=verb.changes)
        try:
            answer: object = await self._transport.run_script(verb.script, arguments)
        except BadArgument:  # a script checks its arguments before it changes anything
            raise
        except BaseException as error:  # the state of the device is unknown
            settings.changed(unsaved=unsaved or verb.saves)
            if isinstance(error, ImudError):
                await settings.read_again(identity=True)
            raise
        if verb.saves or restarts:
            settings.flash_is_current(changed=restarts or verb.changes)
        if verb.changes:
            settings.changed(unsaved=unsaved)
            await settings.read_again(identity=restarts)
        return answer

    def _with_device_yaw(self, verb: Verb, arguments: Options) -> Options:
        """Return the arguments with the yaw of the device in place of the published heading.

        Convention, declination and mounting add a constant to the yaw, and can change its sense. The newest sample
        contains both values. Raises BadArgument if there is no sample with a heading.
        """
        path, newest = self._transport.path, self._samples.newest
        rotation = path.frame.rotation if path is not None else None
        if path is None or rotation is None:
            return arguments
        published = rotation.sample(newest) if newest is not None else None
        if newest is None or newest.euler_rad is None or published is None or published.euler_rad is None:
            raise BadArgument(f"{verb.heading}: expected a sample with a heading, got none; wait for samples")
        heading_deg, sense = getattr(arguments, verb.heading), path.frame.yaw_sense
        if getattr(arguments, "relative", False):
            yaw_deg = sense * heading_deg
        else:
            change_deg = heading_deg - published.euler_rad[2] / RAD_PER_DEG
            yaw_deg = newest.euler_rad[2] / RAD_PER_DEG + sense * change_deg
        return with_fields(arguments, **{verb.heading: yaw_deg})

    # --- evidence ----------------------------------------------------------------------------------------------------

    def _agrees_now(self, verb: Verb, arguments: Options) -> bool:
        """Return whether the newest sample already has the values that the verb sets."""
        newest, expected = self._samples.newest, verb.expected(arguments)
        if newest is None or not expected:
            return False
        window = RestWindow()
        window.add(newest)
        return all(check(expectation, window.means()).passed for expectation in expected)

    async def _agrees(self, verb: Verb, arguments: Options) -> tuple[bool | None, str]:
        """Return whether the samples at rest have the values that the verb sets, None: unknown, and the observation."""
        expected = verb.expected(arguments)
        if not expected:
            return None, "the device confirmed it, and no sample shows its effect"
        window, sample = RestWindow(), self._samples.newest
        while not window.full:
            sample = await self._samples.next(sample)
            if sample is None:
                return None, "the device confirmed it, and sends no samples that show its effect"
            window.add(sample)
            await asyncio.sleep(STEP_S)
        if moved := window.motion():
            return None, f"the device moves: {moved}"
        checks = [check(one, window.means()) for one in expected]
        words = ", ".join(
            f"{one.name} differs by " + ("an unknown angle" if one.value is None else f"{one.value / RAD_PER_DEG:.2f}°")
            for one in checks
        )
        if any(one.value is None for one in checks):
            return None, f"{words} from the set value"
        return all(one.passed for one in checks), f"{words} from the set value"


def _changes(before: Values, after: Values) -> str:
    """Describe the settings with another value than before; empty if there are none."""
    changed = [name for name in after if as_json(after[name]) != as_json(before.get(name))]
    return ", ".join(
        f"{name} is {json_words(as_json(after[name]))}, was {json_words(as_json(before.get(name)))}"
        for name in changed[:CHANGES_MAX]
    )


def _reset(before: Values, after: Values, was_unsaved: bool) -> tuple[bool | None, str]:
    """Return whether a reset changed the settings, None: unknown, and the observation.

    A restart alone changes only settings that were not saved.
    """
    changes = _changes(before, after)
    if not after:
        return None, "the device reports no settings after it"
    if not changes:
        return None, "the device reports the same settings before and after it"
    if was_unsaved:
        return None, f"a restart alone loses the settings that were not saved: {changes}"
    return True, changes
