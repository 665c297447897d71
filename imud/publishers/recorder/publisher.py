"""Table row of the output `recorder`."""

from pathlib import Path

from imud.contracts.publisher import PublisherContext, PublisherType
from imud.publishers.recorder.continuous import Recorder
from imud.publishers.recorder.directory import RecordingDirectory
from imud.publishers.recorder.settings import RecorderSettings


def _make(settings: RecorderSettings, context: PublisherContext) -> Recorder:
    return Recorder(settings, context, RecordingDirectory(Path(settings.directory), settings.keep_bytes))


PUBLISHER = PublisherType("recorder", RecorderSettings, _make, required=False)
