"""Both forms of a batch, its samples in a convention, and problems of outputs."""

from collections.abc import Sequence

import pytest

from imud.attitude.conventions import RFU_ENU, Convention
from imud.attitude.published import published_frame
from imud.contracts import publisher
from imud.contracts.publisher import Batch, OutputFacts, SlotBatch
from imud.contracts.status import OutputState, OutputStatus
from imud.formats.slot import encode_slot
from imud.publishers import PUBLISHERS
from tests.support.rings import DEVICE, make_sample

ENU, NED = Convention


@pytest.mark.parametrize("seqs", [(7,), (7, 8, 9)])
def test_a_batch_makes_the_other_form_at_its_first_use(monkeypatch: pytest.MonkeyPatch, seqs: Sequence[int]) -> None:
    samples = [make_sample(seq) for seq in seqs]
    slots = b"".join(encode_slot(sample, 3) for sample in samples)
    made, packed = Batch(DEVICE, 3, samples), SlotBatch(DEVICE, 3, slots)
    with monkeypatch.context() as patch:
        for name in ("decode_slots", "encode_slots"):  # these facts need no other form
            patch.setattr(publisher, name, None)
        for batch in (made, packed):
            assert (len(batch), batch.seqs, batch.is_packed) == (len(seqs), (seqs[0], seqs[-1]), batch is packed)
            assert list(batch.times_ns) == [seq * 1_000_000 for seq in seqs]
        assert (packed.packed, made.samples) == (slots, samples)
    assert (made.packed, packed.samples) == (slots, samples)
    assert (made.packed, packed.samples) == (slots, samples)


def test_a_batch_rotates_its_samples_once_for_each_convention() -> None:
    """The axes of the device are right, forward, up: x forward is its y, and y left is its -x."""
    batch = Batch(DEVICE, 3, [make_sample(2)])
    assert batch.converted(None) is batch
    enu, ned = batch.converted(ENU), batch.converted(NED)
    assert [one.samples[0].accel_m_s2 for one in (batch, enu, ned)] == [
        (2, 2.25, 2.5), (2.25, -2, 2.5), (2.25, 2, -2.5),
    ]  # fmt: skip
    assert (batch.converted(ENU), batch.converted(NED)) == (enu, ned)
    published = Batch(DEVICE, 3, [make_sample(2)], published_frame(None, NED, None, RFU_ENU))
    assert published.converted(NED) is published


def test_problems_of_outputs_and_of_their_ports() -> None:
    ports = [OutputStatus("tcp a", 0, 0, 0, "busy"), OutputStatus("tcp b", 0, 0, 1, "")]
    facts = OutputFacts(failed={"mqtt": "no broker"}, ports={"nmea0183": lambda: ports})
    assert facts.problems() == {"mqtt": "no broker", "nmea0183 tcp a": "busy"}
    assert PUBLISHERS["socket"].claims(None) == ()


def test_each_configured_output_has_a_state() -> None:
    """The status contained only outputs with a problem, so a configured output could be invisible."""
    ports = [OutputStatus("tcp a", 0, 0, 0, "busy"), OutputStatus("tcp b", 0, 0, 0, "no reader")]
    facts = OutputFacts(failed={"mqtt": "no broker"}, ports={"nmea0183": lambda: ports})
    facts.configured.update({"shm", "nmea0183", "mqtt"})
    assert facts.states() == [
        OutputState("mqtt", False, "no broker"),
        OutputState("nmea0183", True, "busy; no reader"),
        OutputState("shm", True),
    ]  # fmt: skip
