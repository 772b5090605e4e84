"""The record of a run: files that are the truth, and Rerun as a view. Never slows training."""

from tom.record.reader import RunReader
from tom.record.recorder import Recorder
from tom.record.rerun.sink import Sink, open_sink
from tom.record.status import Status
from tom.record.store import Store
from tom.record.writer import RunWriter

__all__ = ["Recorder", "RunReader", "RunWriter", "Sink", "Status", "Store", "open_sink"]
