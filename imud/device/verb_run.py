"""Execution of verbs: the script of a command, and the evidence for its effect."""

import asyncio
from collections.abc import Mapping
from typing import Any, Final

from imud.contracts.command import Proof, Risk, Verb, VerbResult
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
            if verb.saves:
                settings.spend_flash()
            if verb.risk is Risk.RESET:
                await settings.back_up(name)
            before, was_unsaved = settings.values, settings.is_unsaved
            is_quiet = await self._samples.is_quiet() if verb.proof is Proof.ONE_SAMPLE else True
            self._samples.mark()
            restarts, unsaved = verb.effect_on_flash(arguments)
            answer = await self._changed(verb, arguments, restarts=restarts, unsaved=unsaved)
            verified: bool | None = True
            evidence = verb.evidence
            match verb.proof:
                case Proof.VALUE:
                    return answer
                case _ if isinstance(answer, VerbResult):  # the script has checked the effect
                    verified, evidence, answer = answer.verified, answer.evidence, answer.result
                    if restarts:
                        verified = verified or None  # changed settings can show the restart below
                    elif verified and await self._samples.has_restarted():
                        verified, evidence = False, "the device restarted during the command"
                case Proof.NONE:
                    verified = False
                case Proof.RESTART:
                    verified, evidence = await self._samples.evidence(verb.proof, is_quiet)
                case Proof.SETTINGS:
                    after = settings.values if settings.is_current else {}
                    verified, evidence = _reset(before, after, was_unsaved)
                case Proof.SAMPLES:
                    verified, evidence = await self._agrees(verb, arguments)
                case Proof.STREAM | Proof.ONE_SAMPLE:
                    verified, evidence = await self._samples.evidence(verb.proof, is_quiet)
            if restarts and before and verb.proof is not Proof.SETTINGS and (lost := _changes(before, settings.values)):
                verified, evidence = verified is not False, f"{evidence}; the restart changed settings: {lost}"
            return VerbResult(bool(verified), evidence, answer, settings.not_saved if unsaved else "")

    async def run_line(self, name: str, given: Mapping[str, Any], attachments: Attachments) -> VerbResult:
        """Run a verb of the GPIO lines and return its evidence. Raises BadArgument, CommandError."""
        proof = attachments.verbs[name].proof
        is_quiet = await self._samples.is_quiet() if proof is Proof.ONE_SAMPLE else True
        self._samples.mark()
        await attachments.run_verb(name, given)
        verified, evidence = await self._samples.evidence(proof, is_quiet)
        return VerbResult(bool(verified), evidence)

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

    # --- evidence ----------------------------------------------------------------------------------------------------

    async def _agrees(self, verb: Verb, arguments: Options) -> tuple[bool, str]:
        """Return whether the samples at rest have the values that the verb sets."""
        expected = verb.expected(arguments)
        if not expected:
            return False, "the device confirmed it, and no sample shows its effect"
        window, sample = RestWindow(), self._samples.newest
        while not window.full:
            sample = await self._samples.next(sample)
            if sample is None:
                return False, "the device confirmed it, and sends no samples that show its effect"
            window.add(sample)
            await asyncio.sleep(STEP_S)
        if moved := window.motion():
            return False, f"the device moves: {moved}"
        checks = [check(one, window.means()) for one in expected]
        words = ", ".join(
            f"{one.name} differs by " + ("an unknown angle" if one.value is None else f"{one.value / RAD_PER_DEG:.2f}°")
            for one in checks
        )
        return all(one.passed for one in checks), f"{words} from the set value"


def _changes(before: Values, after: Values) -> str:
    """Describe the settings with another value than before; empty if there are none."""
    changed = [name for name in after if as_json(after[name]) != as_json(before.get(name))]
    return ", ".join(
        f"{name} is {json_words(as_json(after[name]))}, was {json_words(as_json(before.get(name)))}"
        for name in changed[:CHANGES_MAX]
    )


def _reset(before: Values, after: Values, was_unsaved: bool) -> tuple[bool, str]:
    """Return whether a reset changed the settings. A restart alone changes only settings that were not saved."""
    changes = _changes(before, after)
    if not after:
        return False, "the device reports no settings after it"
    if not changes:
        return False, "the device reports the same settings before and after it"
    if was_unsaved:
        return False, f"a restart alone loses the settings that were not saved: {changes}"
    return True, changes
